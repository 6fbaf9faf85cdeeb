"""Persistence moved by the measured motion, which needs nothing but what a model sees."""

import dataclasses
from collections.abc import Callable

import pytest
import torch

from foredrive.geometry.se3 import exp_se3, transform_points
from foredrive.scene import Example, VoxelGrid, VoxelSpec
from foredrive.tasks.metric import EvaluationContext
from foredrive.tasks.occupancy.forecasts import ego_compensated
from foredrive.tasks.occupancy.occupancy_metric import OccupancyMetric
from foredrive.tasks.predictor import Prediction

SPEC = VoxelSpec((-8.0, -12.0, -1.0), 1.0, (3, 24, 32))
TWIST = torch.tensor([3.0, 0.0, 0.0, 0.0, 0.0, 0.3], dtype=torch.float64)
"""Motion in one key frame: three voxels ahead, on a curve."""


def standing_scene(example: Example, turn: float) -> tuple[Example, Prediction]:
    """A standing scene, seen perfectly now and later. After now the vehicle turns by `turn` times as much."""
    clip, count = example.clip, example.clip.t_s.shape[1]
    steps = torch.arange(count, dtype=torch.float64)[:, None] - clip.now
    T = exp_se3(steps * TWIST * torch.where(steps > 0, TWIST.new_tensor([1, 1, 1, 1, 1, turn]), 1.0))
    T_world_ego = T.expand(len(clip.t_s), -1, 4, 4)
    now = torch.rand((len(clip.t_s), *SPEC.shape_zyx), generator=torch.Generator().manual_seed(0)) < 0.3
    seen = [ego_compensated(now, T_world_ego[:, k], SPEC) for k in range(clip.now, count)]
    whole = torch.stack([torch.zeros_like(now)] * clip.now + seen, dim=1)
    truth = VoxelGrid(SPEC, whole[:, :, None].float(), torch.ones_like(whole))
    clip = dataclasses.replace(
        clip,
        T_world_ego=T_world_ego,
        ego_speed_mps=torch.full_like(clip.ego_speed_mps, 6.0),
        ego_speed_valid=torch.ones_like(clip.ego_speed_valid),
    )
    logit = torch.where(torch.stack(seen, dim=1), 1.0, -1.0)
    return dataclasses.replace(example, clip=clip, occupancy=truth), Prediction(occupancy_logit=logit)


@pytest.mark.parametrize("turn", [1.0, -2.0])
def test_it_is_perfect_while_the_vehicle_goes_on_as_before(
    turn: float, make_example: Callable[..., Example]
) -> None:
    truth, perfect = standing_scene(make_example(batch=2, spec=SPEC), turn)
    metric = OccupancyMetric(EvaluationContext(0.5))
    metric.update(perfect, truth)
    found = metric.result()
    for when in ("future_500ms", "future_1s"):
        assert found[f"iou_{when}"] == 1.0
        assert found[f"iou_{when}.carried_copy"] == 1.0
        assert found[f"iou_{when}.copy"] < 0.5
        continued = found[f"iou_{when}.continued_copy"]
        assert (continued > 0.99) if turn == 1.0 else (continued < 0.8)


def street(example: Example, turn_rad: float) -> Example:
    """A car goes to the left by two voxels a key frame, past a wall, while the vehicle drives on."""
    clip, count = example.clip, example.clip.t_s.shape[1]
    steps = torch.arange(count, dtype=torch.float64)[:, None] - clip.now
    T_world_ego = exp_se3(steps * TWIST * TWIST.new_tensor([1, 1, 1, 1, 1, turn_rad / 0.3]))
    # In the world, on a grid that is finer than the model's
    wall = torch.cartesian_prod(torch.arange(0, 9, 0.5), torch.tensor([-6.2]), torch.tensor([0.5, 1.5]))
    car = (
        torch.cartesian_prod(torch.arange(9, 12, 0.5), torch.arange(-1, 1, 0.5), torch.tensor([0.5, 1.5]))
        + 0.2
    )
    occupied = torch.zeros(count, *SPEC.shape_zyx)
    flow = torch.zeros(count, 3, *SPEC.shape_zyx)
    for frame in range(count):
        T_ego_world = torch.linalg.inv(T_world_ego[frame])
        velocity = T_ego_world[:3, :3] @ TWIST.new_tensor([0.0, 4.0, 0.0])
        moved = car + torch.tensor([0.0, 2.0, 0.0]) * float(steps[frame])
        for points, of_points in ((wall, torch.zeros(3)), (moved, velocity.float())):
            place = transform_points(T_ego_world, points.double())
            x, y, z = (place - place.new_tensor(SPEC.lower_m)).floor().long().unbind(-1)
            occupied[frame, z, y, x] = 1.0
            flow[frame, :, z, y, x] = of_points[:, None]
    batch = len(clip.t_s)
    known = torch.ones(batch, count, *SPEC.shape_zyx, dtype=torch.bool)
    return dataclasses.replace(
        example,
        clip=dataclasses.replace(clip, T_world_ego=T_world_ego.expand(batch, -1, 4, 4)),
        occupancy=VoxelGrid(SPEC, occupied[None, :, None].expand(batch, -1, -1, -1, -1, -1), known),
        flow=VoxelGrid(SPEC, flow[None].expand(batch, -1, -1, -1, -1, -1), known),
    )


@pytest.mark.parametrize("turn_rad", [0.0, 0.3])
def test_what_moves_is_judged_apart(turn_rad: float, make_example: Callable[..., Example]) -> None:
    """Moved along the driven path alone, the car is lost and the wall is not; with true flow both stay.

    In a turn, a wall of one voxel does not fit the next grid.
    """
    truth = street(make_example(batch=2, spec=SPEC), turn_rad)
    now = truth.clip.now
    present = truth.occupancy.values[:, now, 0] > 0.5
    T_now_ego = torch.linalg.inv(truth.clip.T_world_ego[:, now, None]) @ truth.clip.T_world_ego[:, now:]
    seen = [ego_compensated(present, T_now_ego[:, k], SPEC) for k in range(T_now_ego.shape[1])]
    metric = OccupancyMetric(EvaluationContext(0.5))
    metric.update(Prediction(occupancy_logit=torch.where(torch.stack(seen, dim=1), 1.0, -1.0)), truth)
    found = metric.result()
    exact = turn_rad == 0
    assert found["moving.iou_now"] == found["standing.iou_now"] == 1
    for when in ("future_500ms", "future_1s"):
        assert found[f"moving.iou_{when}"] == found[f"moving.iou_{when}.carried_copy"] < 0.35
        assert found[f"moving.iou_{when}.ceiling"] > (0.99 if exact else 0.5)
        assert found[f"standing.iou_{when}"] > (0.99 if exact else 0.3)
        assert found[f"standing.iou_{when}.ceiling"] >= found[f"standing.iou_{when}"]
