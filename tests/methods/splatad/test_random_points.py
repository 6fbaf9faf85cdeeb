"""Random points around a drive whose bounds are known."""

import pytest
import torch

from foredrive.methods.splatad.initial import drive_bounds, random_points


def test_bounds_hold_the_padded_poses() -> None:
    """A drive of 40 m along x, then a last pose to the left: 80 m along its axis and 60 m across."""
    poses = torch.eye(4).repeat(3, 1, 1)
    poses[1, 0, 3] = poses[2, 0, 3] = 40.0
    poses[2, :2, :2] = torch.tensor([[0.0, -1], [1, 0]])
    bounds = drive_bounds(poses)
    assert bounds.centre_m.tolist() == pytest.approx([80 / 3, 0, 0])
    assert bounds.size_m.tolist() == pytest.approx([2 * (80 + 80 / 3), 160, 50])


def test_far_points_are_above_and_even_in_inverse_distance() -> None:
    bounds = drive_bounds(torch.eye(4)[None])
    points = random_points(bounds, 4000, 2000, 0.2, torch.Generator().manual_seed(0))
    far, near = points.xyz_m[:4000], points.xyz_m[4000:]
    distance_m = far.norm(dim=-1)
    assert bool((far[:, 2] >= 0).all())
    assert float(distance_m.min()) + 1e-3 >= 60
    assert float(distance_m.max()) <= 1e4
    assert float(distance_m.median()) == pytest.approx(2 / (1 / 60 + 1e-4), rel=0.05)
    assert bool((near.abs() <= bounds.size_m / 2).all())
    assert near.std(0).tolist() == pytest.approx((bounds.size_m / 12**0.5).tolist(), rel=0.05)
    assert points.rgb.mean(0).tolist() == pytest.approx([0.5] * 3, abs=0.02)
    apart_m = torch.cdist(points.xyz_m[:1], points.xyz_m)[0].sort().values[1:4].mean()
    assert float(points.scale_m[0]) == pytest.approx(0.2 * float(apart_m), rel=1e-3)
