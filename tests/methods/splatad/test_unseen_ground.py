"""Ground that is made up where none was seen, on planes with holes."""

import dataclasses
import math

import pytest
import torch
from methods.reconstruction.test_reconstructed import FORWARD, scene_of, view
from methods.reconstruction.test_scene_graph import two_actors

from foredrive.geometry.se3 import exp_se3
from foredrive.methods.splatad import Gaussians
from foredrive.methods.splatad.unseen_ground import WITHIN_M, add_unseen_ground, extrapolated_ground

WAY = torch.eye(4).repeat(21, 1, 1)
WAY[:, 0, 3] = torch.arange(21.0)
RISE = 0.02


def plane(hole: tuple[float, float, float, float], rise: float = 0.0) -> Gaussians:
    """Ground every 0.25 m that rises along x, dark left of the way and bright right of it; but for a hole."""
    x, y = torch.meshgrid(torch.arange(-30, 51, 0.25), torch.arange(-30, 30.1, 0.25), indexing="ij")
    x0, y0, x1, y1 = hole
    there = ~((x > x0) & (x < x1) & (y > y0) & (y < y1))
    xy = torch.stack([x[there], y[there]], -1)
    count = len(xy)
    shade = torch.where(xy[:, 1] > 0, 0.2, 0.6)
    return Gaussians(
        mean_m=torch.cat([xy, rise * xy[:, :1]], -1),
        quaternion=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scale=torch.full((count, 3), 0.1).log(),
        opacity_logit=torch.full((count,), 2.0),
        feature=shade[:, None].repeat(1, 5),
    )


def test_a_hole_is_filled_like_what_is_around() -> None:
    """4.6 × 1.8 m under a parked vehicle; next to the rim there is ground already."""
    added = extrapolated_ground(plane((8.0, 3.0, 12.6, 4.8)), WAY, 0.4)
    x, y, z = added.mean_m.unbind(-1)
    assert float(x.min()) > 8.0
    assert float(x.max()) < 12.6
    assert float(y.min()) > 3.0
    assert float(y.max()) < 4.8
    assert float(z.abs().max()) < 1e-5
    inner = (4.6 - 0.8) * (1.8 - 0.8) / 0.4**2
    assert 0.6 * inner < len(z) < 2.0 * inner
    assert torch.allclose(added.feature, torch.full_like(added.feature, 0.2))
    assert float(added.log_scale[:, 2].exp().max()) < 0.02


def test_it_rises_with_the_road() -> None:
    slope = math.atan(RISE)
    rising = exp_se3(torch.tensor([0.0, 0, 0, 0, -slope, 0])) @ WAY
    added = extrapolated_ground(plane((8.0, -5.0, 12.0, -3.0), RISE), rising)
    assert len(added.mean_m) > 10
    assert torch.allclose(added.mean_m[:, 2], RISE * added.mean_m[:, 0], atol=0.02)
    assert torch.allclose(added.feature, torch.full_like(added.feature, 0.6))


def test_nothing_is_made_up_far_from_known_ground_or_from_the_way() -> None:
    """A hole of 14 m stays open in its middle, one beyond the reach altogether."""
    added = extrapolated_ground(plane((2.0, 3.0, 16.0, 17.0)), WAY)
    middle = ((added.mean_m[:, :2] - torch.tensor([9.0, 10.0])).abs() < 1.0).all(-1)
    assert len(added.mean_m) > 100
    assert not bool(middle.any())
    assert len(extrapolated_ground(plane((5.0, WITHIN_M + 1, 9.0, WITHIN_M + 4)), WAY).mean_m) == 0


@pytest.mark.parametrize("height_m", [3.0, -2.0])
def test_what_is_no_ground_is_left_alone(height_m: float) -> None:
    roof = plane((8.0, 3.0, 12.6, 4.8))
    roof.mean_m[:, 2] = height_m
    assert len(extrapolated_ground(roof, WAY).mean_m) == 0


def test_a_colour_that_nobody_has_checked_does_not_spread() -> None:
    """Hidden Gaussians at the rim may be of any colour."""
    ground = plane((8.0, 3.0, 12.6, 4.8))
    rim = ((ground.mean_m[:, :2] - torch.tensor([10.0, 2.9])).abs() < 0.3).all(-1)
    ground.feature[rim] = 9.0
    assert 0 < int(rim.sum()) < 16
    assert float(extrapolated_ground(ground, WAY).feature.max()) < 0.3


@torch.no_grad()
def test_what_a_camera_sees_is_not_made_up() -> None:
    """Of two holes in the ground ahead a wall hides the one on the left."""
    x, y = torch.meshgrid(torch.arange(2, 20, 0.2), torch.arange(-6, 6.1, 0.2), indexing="ij")
    holes = (x > 9) & (x < 11) & (y.abs() > 1) & (y.abs() < 4)
    ground = torch.stack([x, y, torch.zeros_like(x)], -1)[~holes]
    across, up = torch.meshgrid(torch.arange(0, 7, 0.15), torch.arange(0, 4, 0.15), indexing="ij")
    wall = torch.stack([torch.full_like(across, 6.0), across, up], -1).flatten(0, 1)
    scene = scene_of(torch.cat([ground, wall]), two_actors().only(torch.tensor([False, False])))
    raised = FORWARD.clone()
    raised[2, 3] = 4.0
    camera = dataclasses.replace(view([0.0] * 6, readout_s=0.0), T_scene_cam=raised)
    add_unseen_ground(scene, WAY, [camera])
    added = scene.mean_m[len(ground) + len(wall) :]
    assert len(scene.actor) == len(scene.mean_m) == len(scene.albedo)
    hidden = (added - torch.tensor([10.0, 2.5, 0])).abs()
    assert int((hidden < torch.tensor([1.0, 1.5, 0.1])).all(-1).sum()) > 8
    shown = (added - torch.tensor([10.0, -2.5, 0])).abs()
    assert int((shown < torch.tensor([1.0, 1.5, 0.1])).all(-1).sum()) == 0
