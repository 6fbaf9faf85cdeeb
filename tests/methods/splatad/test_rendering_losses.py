"""Losses of rendered sweeps by hand."""

import pytest
import torch

from foredrive.methods.splatad.losses import (
    drop_loss,
    intensity_loss,
    line_of_sight_loss,
    published_lidar_losses,
    range_loss,
)


def test_the_worst_twentieth_of_ranges_does_not_count() -> None:
    real, returned = torch.full((41,), 10.0), torch.ones(41, dtype=torch.bool)
    rendered = real + 0.5
    rendered[:2] = 200.0
    returned[-1], rendered[-1] = False, 1e6
    assert float(range_loss(rendered, real, returned, 0.95)) == pytest.approx(0.5)
    assert float(range_loss(rendered, real, returned & False, 0.95)) == 0.0


def test_beams_that_return_are_compared_alone() -> None:
    returned = torch.tensor([True, True, False])
    assert float(intensity_loss(torch.tensor([0.5, 0.2, 1]), torch.tensor([0.1, 0.2, 0]), returned)) == (
        pytest.approx(0.08)
    )
    assert float(line_of_sight_loss(torch.tensor([0.4, 0.2, 0.9]), returned)) == pytest.approx(0.3)
    assert float(drop_loss(torch.zeros(3), returned)) == pytest.approx(0.693147)
    assert float(drop_loss(torch.tensor([-9.0, -9, 9]), returned)) < 1e-3


def test_published_losses_count_the_worst_beams_as_zero_everywhere() -> None:
    """Errors of five returned beams: 1, 2, 3, 4 and 90 m. The .8 quantile is 4 + .2 · 86 = 21.2 m."""
    returned = torch.tensor([True, True, True, True, True, False])
    alpha = torch.tensor([0.9, 1.0, 1.0, 1.0, 0.1, 0.3], requires_grad=True)
    range_m, real_m = torch.tensor([10.0, 8.0, 13.0, 6.0, 100, 5]), torch.tensor([10.0, 10, 10, 10, 100, 50])
    found = published_lidar_losses(
        weighted_range_m=alpha * range_m,
        intensity=torch.tensor([0.5, 0.5, 0.5, 0.5, 1.0, 1.0]),
        opacity_before_hit=torch.tensor([0.1, 0.2, 1.5, 0.2, 3.0, 9.0]),
        real_range_m=real_m,
        real_intensity=torch.tensor([0.4, 0.5, 0.5, 0.8, 0.0, 0.0]),
        returned=returned,
        quantile=0.8,
    )
    assert found["depth"].item() == pytest.approx((1 + 2 + 3 + 4) / 5)
    assert float(found["intensity"]) == pytest.approx((0.01 + 0.09) / 5, rel=1e-5)
    assert float(found["line_of_sight"]) == pytest.approx(2.0 / 5)
    (grad,) = torch.autograd.grad(found["depth"], alpha)
    torch.testing.assert_close(grad, torch.tensor([-10.0, -8.0, 13.0, -6.0, 0.0, 0.0]) / 5)


def test_published_losses_of_a_sweep_without_returns_are_zero() -> None:
    nothing = published_lidar_losses(*torch.ones(5, 3), torch.zeros(3, dtype=torch.bool), 0.95)
    assert [float(value) for value in nothing.values()] == [0.0, 0.0, 0.0]


def test_ranges_count_up_to_the_quantile_of_their_errors() -> None:
    rendered, real = torch.tensor([11.0, 8.0, 13.0, 6.0, 20.0]), torch.full((5,), 10.0)
    assert float(range_loss(rendered, real, torch.ones(5, dtype=torch.bool), 0.8)) == (1 + 2 + 3 + 4) / 4
