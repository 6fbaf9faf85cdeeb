"""Figures of rendered sweeps by hand."""

import math

import pytest
import torch

from foredrive.tasks.rendering.lidar_scores import chamfer_m2, score_sweep


def test_chamfer_is_over_the_real_points() -> None:
    cloud = torch.tensor([[0.0, 0, 0], [3.0, 0, 0]])
    real = torch.tensor([[0.0, 1, 0]])
    assert chamfer_m2(cloud, real) == pytest.approx((1 + 10) + 1)
    assert chamfer_m2(real, cloud) == pytest.approx((1 + 1 + 10) / 2)
    assert math.isnan(chamfer_m2(cloud, real[:0]))
    assert chamfer_m2(cloud[:0], real) > 1e4


def test_a_sweep_of_four_beams() -> None:
    """Two beams return and are said to, off by 0.1 and 2 m; one is lost wrongly, one rightly."""
    scores = score_sweep(
        range_m=torch.tensor([10.1, 22.0, 5.3, 50.0]),
        intensity=torch.tensor([0.5, 0.5, 0.0, 0.9]),
        dropped=torch.tensor([False, False, True, True]),
        real_range_m=torch.tensor([10.0, 20.0, 5.0, 0.0]),
        real_intensity=torch.tensor([0.3, 0.5, 0.0, 0.0]),
        returned=torch.tensor([True, True, True, False]),
        origin=torch.zeros(4, 3),
        direction=torch.tensor([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    )
    assert scores.depth_median_sq_m2 == pytest.approx(0.09, rel=1e-4)  # of 0.01, 0.09 and 4
    assert scores.intensity_rmse == pytest.approx(0.2 / math.sqrt(3))
    assert scores.drop_accuracy == pytest.approx(0.75)
    # there: 0.1² + 2²; back: 0.1² + 2² + (5 m to the point at 10.1 m, the nearest, is 15.1²)
    assert scores.chamfer_m2 == pytest.approx((0.01 + 4 + 0.01 + 4 + 15.1**2) / 3, rel=1e-4)
