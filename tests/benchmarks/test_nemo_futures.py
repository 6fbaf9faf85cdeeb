"""Tests of the share of moving voxels in the study of NeMo's futures."""

import dataclasses
from collections.abc import Callable

import pytest
import torch

from benchmarks.nemo_futures import MovingShareMetric
from foredrive.scene import Example, VoxelGrid, VoxelSpec
from foredrive.tasks.metric import EvaluationContext
from foredrive.tasks.occupancy.scores import above_ground
from foredrive.tasks.predictor import Prediction


def test_what_moves_now_above_the_ground_is_counted(make_example: Callable[..., Example]) -> None:
    spec = VoxelSpec(lower_m=(-4.0, -3.0, -1.0), voxel_m=1.0, shape_zyx=(4, 6, 8))
    example = make_example(spec=spec)
    now = example.clip.now
    occupied = torch.zeros_like(example.occupancy.values)
    known = torch.ones_like(example.occupancy.known)
    flow_mps = torch.zeros_like(example.flow.values)
    top = spec.shape_zyx[0] - 1
    assert above_ground(spec)[top].all()
    assert not above_ground(spec)[0].any()
    # Now: four voxels of both clips, of which one moves in the first clip; one more is not known to move
    occupied[:, now, 0, top, 1, 1:5] = 1.0
    flow_mps[0, now, 1, top, 1, 1] = -3.0
    flow_mps[1, now, 0, top, 1, 2] = 3.0
    # On the ground and in other frames everything moves
    occupied[:, now, 0, 0] = 1.0
    flow_mps[:, now, 0, 0] = 9.0
    others = [frame for frame in range(occupied.shape[1]) if frame != now]
    occupied[:, others, 0, top], flow_mps[:, others, 0, top] = 1.0, 9.0
    flow_known = known.clone()
    flow_known[1, now, top, 1, 2] = False
    truth = dataclasses.replace(
        example,
        occupancy=VoxelGrid(spec, occupied, known),
        flow=VoxelGrid(spec, flow_mps, flow_known),
    )
    metric = MovingShareMetric(EvaluationContext(0.5))
    for _ in range(2):
        metric.update(Prediction(), truth)
    assert metric.result()["moving_pct"] == pytest.approx(100 / 8)
