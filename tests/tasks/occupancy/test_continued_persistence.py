"""Persistence moved by the measured motion, which needs nothing but what a model sees."""

import dataclasses
from collections.abc import Callable

import pytest
import torch

from foredrive.geometry.se3 import exp_se3
from foredrive.scene import Example, VoxelGrid, VoxelSpec
from foredrive.tasks.evaluation.metric import EvaluationContext
from foredrive.tasks.evaluation.predictor import Prediction
from foredrive.tasks.occupancy.forecasts import ego_compensated
from foredrive.tasks.occupancy.occupancy_metric import OccupancyMetric

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
