"""Tests of the true surroundings of virtual egos, drawn from above."""

import dataclasses
import math
from pathlib import Path

import pytest
import torch
from small_drives import drives

from benchmarks.common.true_planes import (
    LIGHTS,
    LINES,
    PAST,
    SPEC,
    TruePlanes,
    draw,
    joined,
    kept,
    read_planes,
)
from foredrive.runs.drive.recording import EgosPlan, record_egos
from foredrive.runs.recipes.known import find_recipe
from foredrive.scene import Category, Command, MapKind, MapPatch
from foredrive.scene.traffic_light import LightState
from foredrive.sensors.rigs import SURROUND, RigPlan

PLANS = [EgosPlan("Town02", 7, 6, ()), EgosPlan("Town02", 8, 2, ())]
RIG = RigPlan((4, 6), dict(list(SURROUND.cameras.items())[:1]))
"""The planes need no images, but a log has a camera."""
CENTRES, VEHICLES = LINES.index(MapKind.LANE_CENTRE), len(LINES) + len(LIGHTS)


@pytest.fixture(scope="module")
def planes(tmp_path_factory: pytest.TempPathFactory) -> TruePlanes:
    logs, failed = record_egos(PLANS, tmp_path_factory.mktemp("planes"), RIG, 1)
    assert not failed
    return read_planes(logs, find_recipe("nemo_town").clips)


def test_lanes_lie_under_the_driven_path(planes: TruePlanes) -> None:
    """Egos drive in lanes, along them, and so do their mirror images."""
    assert len(planes.window) > 5
    assert planes.now.min() == PAST
    for seen in (planes, planes.mirrored()):
        assert beneath(seen, CENTRES).mean() > 0.2
        heading = seen.driven[..., 2]
        along = heading.cos() * beneath(seen, -2) + heading.sin() * beneath(seen, -1)
        assert (along > 0).sum() > 5 * (along < 0).sum()


def test_a_car_a_lane_and_a_light_by_hand() -> None:
    """A car across the road at x = 10 m, y = 6 m that moves to the left; a red light at its front."""
    clip = drives(1).clip[0]
    boxes = clip.boxes
    boxes.valid[:], boxes.valid[clip.now, 0] = False, True
    boxes.centre[clip.now, 0, :2], boxes.yaw[clip.now, 0] = torch.tensor([10.0, 6.0]), math.pi / 2
    boxes.size_lwh[clip.now, 0, :2] = torch.tensor([6.0, 2.0])
    boxes.velocity[clip.now, 0, :2] = torch.tensor([0.0, 5.0])
    boxes.category[clip.now, 0] = int(Category.CAR)
    line = MapPatch(
        torch.tensor([[[-8.0, 6.0, 0.0], [20.0, 6.0, 0.0]]]),
        torch.ones(1, 2, dtype=torch.bool),
        torch.tensor([int(MapKind.LANE_CENTRE)]),
    )
    stop = (LightState.RED, torch.tensor([[8.0, 9.0], [12.0, 9.0]]))
    plane = draw(dataclasses.replace(clip, map=line), [stop])
    middle = SPEC.centres_m()[0]
    weight = plane[VEHICLES]
    assert weight.sum() * SPEC.voxel_m**2 == pytest.approx(12.0)
    centre_m = (weight[..., None] * middle).sum((0, 1)) / weight.sum()
    assert centre_m[:2].tolist() == pytest.approx([10.0, 6.0])
    torch.testing.assert_close(plane[VEHICLES + 2], 0.5 * weight)
    assert not plane[VEHICLES + 1].any()
    assert not plane[VEHICLES + 3 : VEHICLES + 6].any()
    along, across = plane[-2], plane[-1]
    assert (along > 0).sum() == 28 / SPEC.voxel_m
    assert not across.any()
    red = plane[len(LINES) + LIGHTS.index(LightState.RED)] > 0
    assert middle[red][:, 0].min() > 7
    assert middle[red][:, 1].tolist() == [9.0] * int(red.sum())


def test_egos_of_one_seed_see_the_same_traffic(planes: TruePlanes) -> None:
    assert set(planes.log.tolist()) >= {0, 6}
    assert torch.equal(planes.window, (planes.log >= 6).long())


def test_commands_and_past_are_mirrored_too(planes: TruePlanes) -> None:
    mirrored = planes.mirrored()
    assert torch.equal(mirrored.mirrored().planes, planes.planes)
    left, right = int(Command.LEFT), int(Command.RIGHT)
    assert torch.equal(mirrored.command == left, planes.command == right)
    assert torch.equal(mirrored.poses[..., 1:], -planes.poses[..., 1:])
    assert planes.poses.shape[1:] == (PAST, 3)


def test_planes_are_kept(planes: TruePlanes, tmp_path: Path) -> None:
    file = tmp_path / "kept" / "planes.safetensors"
    for makes in (lambda: joined([planes, planes]), pytest.fail):
        again = kept(TruePlanes, file, makes)
        assert torch.equal(again.planes, torch.cat([planes.planes, planes.planes]))


def beneath(planes: TruePlanes, channel: int) -> torch.Tensor:
    """The values of a channel in the cells of the driven waypoints."""
    cells = ((planes.driven[..., :2] - torch.tensor(SPEC.lower_m[:2])) / SPEC.voxel_m).floor().long()
    x, y = cells.unbind(-1)
    x, y = x.clamp(0, SPEC.shape_zyx[2] - 1), y.clamp(0, SPEC.shape_zyx[1] - 1)
    rows = torch.arange(len(x))[:, None]
    return planes.volumes()[:, channel, 0][rows, y, x]
