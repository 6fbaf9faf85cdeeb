"""Copies of the present carried along, and futures by chance, on grids small enough to count."""

import math

import torch

from foredrive.geometry.se3 import matrix_from_yaw
from foredrive.scene import VoxelGrid, VoxelSpec
from foredrive.tasks.occupancy.forecasts import count_futures, ego_compensated
from foredrive.tasks.occupancy.scores import count_occupancy

SPEC = VoxelSpec(lower_m=(-2.0, -2.0, 0.0), voxel_m=1.0, shape_zyx=(1, 4, 4))


def grid(*cells: tuple[int, int]) -> torch.Tensor:
    """Occupied (y, x)."""
    found = torch.zeros(SPEC.shape_zyx, dtype=torch.bool)
    for y, x in cells:
        found[0, y, x] = True
    return found


def labels(*frames: torch.Tensor) -> VoxelGrid:
    values = torch.stack(frames)[None, :, None].float()
    return VoxelGrid(SPEC, values, torch.ones_like(values[:, :, 0], dtype=torch.bool))


def test_driving_on_brings_what_stands_nearer() -> None:
    T = torch.eye(4, dtype=torch.float64)
    T[0, 3] = 1.0  # the vehicle has gone 1 m ahead
    carried = ego_compensated(grid((1, 3), (2, 0))[None], T[None], SPEC)[0]
    assert torch.equal(carried, grid((1, 2)))  # what was beside the rear is out of the grid


def test_turning_left_turns_what_stands_right() -> None:
    T = matrix_from_yaw(torch.tensor(math.pi / 2), torch.zeros(3)).double()
    ahead_left = grid((2, 3))  # centre at x = 1.5, y = 0.5
    assert torch.equal(ego_compensated(ahead_left[None], T[None], SPEC)[0], grid((0, 2)))  # x 0.5, y -1.5


def test_the_best_future_is_the_best_as_a_whole() -> None:
    truth = labels(grid((0, 0), (0, 1)), grid((1, 0), (1, 1)))
    begins_well = torch.stack([grid((0, 0), (0, 1)), grid((3, 3), (3, 2))])
    fair = torch.stack([grid((0, 0)), grid((1, 0), (1, 1))])
    counts = count_futures(torch.stack([begins_well, fair])[None], truth)
    assert counts.best.iou.tolist() == [0.5, 1.0]
    assert counts.mean.true_positive.tolist() == [3, 2]
    # In the first frame one of two voxels differs; in the second none is shared.
    assert counts.spread.tolist() == [0.5, 1.0]
    assert counts.items == 1
    twice = counts + counts
    assert twice.best.iou.tolist() == [0.5, 1.0]
    assert (twice.spread / twice.items).tolist() == [0.5, 1.0]


def test_alike_futures_are_one_future() -> None:
    truth = labels(grid((0, 0), (0, 1)))
    futures = torch.stack([grid((0, 0))[None]] * 3)[None]
    counts = count_futures(futures, truth, region=grid((0, 0), (0, 1)))
    assert counts.spread.tolist() == [0.0]
    alone = count_occupancy(futures[:, 0], truth)
    assert counts.best.iou.tolist() == counts.mean.iou.tolist() == alone.iou.tolist()
