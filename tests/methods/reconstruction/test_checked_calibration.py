"""Edges of lidar sweeps: where one object ends in front of another, between two beams."""

import math

import pytest
import torch

from foredrive.methods.reconstruction.sweep_edges import sweep_edges
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.methods.reconstruction.views import SweepView
from foredrive.scene import LidarSweep

STEP_RAD = math.radians(0.5)
PANEL_M, WALL_M = 8.0, 20.0


def panel_before_wall() -> SweepView:
    """Nine channels of 41 beams ahead; a panel fills 13 beams of three channels in the middle."""
    channel, beam = torch.meshgrid(torch.arange(9), torch.arange(41), indexing="ij")
    elevation, azimuth = (STEP_RAD * (n.flatten() - n.max() / 2) for n in (channel.float(), beam.float()))
    direction = torch.stack(
        [elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()], dim=-1
    )
    on_panel = (azimuth.abs() < 6.1 * STEP_RAD) & (elevation.abs() < 1.1 * STEP_RAD)
    count = len(azimuth)
    beams = LidarSweep(
        origin_ego=torch.tensor([1.0, 0.0, 1.8]).expand(count, 3),
        dir_ego=direction,
        range_m=torch.where(on_panel, PANEL_M, WALL_M),
        returned=torch.ones(count, dtype=torch.bool),
        intensity=torch.zeros(count),
        dt_s=torch.zeros(count),
        beam=channel.flatten(),
        valid=torch.ones(count, dtype=torch.bool),
    )
    return SweepView(beams, True, torch.eye(4), torch.zeros(6), 0.0)


def test_edges_lie_between_the_beams_of_both_surfaces() -> None:
    """At the panel's range. The last beams on it are 6 steps to the side, and one step up or down."""
    none, nobody = torch.zeros(0, dtype=torch.int64), torch.zeros(0, 1, 4, 4)
    tracks = ActorTracks(none, none, torch.zeros(0, 3), torch.zeros(1), nobody, nobody[..., 0, 0] > 0)
    (edges,) = sweep_edges([panel_before_wall()], tracks)
    offset = edges.points_ego - torch.tensor([1.0, 0.0, 1.8])
    assert offset.norm(dim=-1).tolist() == pytest.approx([PANEL_M] * len(offset), rel=1e-4)
    azimuth = torch.atan2(offset[:, 1], offset[:, 0]) / STEP_RAD
    elevation = (offset[:, 2] / PANEL_M).asin() / STEP_RAD
    beside, above = azimuth[~edges.horizontal], elevation[edges.horizontal]
    assert sorted(beside.tolist()) == pytest.approx([-6.5] * 3 + [6.5] * 3, abs=1e-3)
    assert sorted(above.tolist()) == pytest.approx([-1.5] * 13 + [1.5] * 13, abs=1e-3)
