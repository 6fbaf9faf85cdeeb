"""Voxel labels from the exact occupancy that a recording carries, on any grid."""

import numpy as np
import torch
from jaxtyping import Bool, Int

from foredrive.data.labels import VoxelLabels
from foredrive.data.logs import Log
from foredrive.data.modalities import FULL_OCCUPANCY, FullOccupancy
from foredrive.data.recorded import read_occupancy
from foredrive.errors import InputError
from foredrive.scene import VoxelSpec

NOTHING = -1
SLACK = 1e-4
"""Of a voxel: borders this close to each other coincide."""


def check_recorded_occupancy(log: Log) -> None:
    """The log must carry its exact occupancy.

    Raises:
        InputError: it does not.
    """
    if not log.file(f"custom.{FULL_OCCUPANCY}").is_file():
        raise InputError(f"{log.path.folder}: no recorded occupancy; take its labels from lidar")


def recorded_labels(log: Log, frame: int, spec: VoxelSpec) -> VoxelLabels:
    """Labels of one frame, of all of space and not of what lidar has seen of it.

    Raises:
        InputError: the frame has no recorded occupancy, or one that cannot be read.
    """
    recorded = read_occupancy(log, frame)
    if recorded is None:
        raise InputError(f"{log.path.folder}: no recorded occupancy at frame {frame}")
    return resampled_labels(recorded, spec)


def resampled_labels(recorded: FullOccupancy, spec: VoxelSpec) -> VoxelLabels:
    """Recorded occupancy on another grid of the same ego frame.

    A voxel is occupied if the middle of an occupied recorded voxel lies in it, or its own middle lies in one.
    Where the grids coincide, or one's voxels are made of whole ones of the other, that is exactly what holds
    matter; elsewhere surfaces are off by up to half a recorded voxel. A voxel moves as the fastest of what it
    holds. All voxels are known that lie within the recorded grid; what lies under the ground, which is a
    surface, is free.
    """
    fastest_last = np.argsort((recorded.velocity_mps**2).sum(axis=-1), kind="stable")
    index, velocity = recorded.index_zyx[fastest_last], recorded.velocity_mps[fastest_last]
    which = np.full(np.add(recorded.spec.shape_zyx, 1), NOTHING)  # a layer more, for what lies beyond
    which[tuple(index.T)] = np.arange(len(index))
    held = which[np.ix_(*_voxels_at_middles(spec, recorded.spec))]
    middles = _voxels_at_middles(recorded.spec, spec)
    z, y, x = (of_axis[index[:, axis]] for axis, of_axis in enumerate(middles))
    within = np.flatnonzero((z >= 0) & (y >= 0) & (x >= 0))
    np.maximum.at(held, (z[within], y[within], x[within]), within)

    known = _within(spec, recorded.spec)
    occupied = known & (held != NOTHING)
    flow_mps = np.zeros((3, *spec.shape_zyx), dtype=np.float32)
    flow_mps[:, occupied] = velocity[held[occupied]].T
    return VoxelLabels(
        occupied=torch.from_numpy(occupied),
        known=torch.from_numpy(known),
        flow_mps=torch.from_numpy(flow_mps),
        flow_known=torch.from_numpy(occupied.copy()),
    )


def _voxels_at_middles(spec: VoxelSpec, grid: VoxelSpec) -> list[Int[np.ndarray, "_"]]:
    """Along z, y and x: which of the grid's layers the middle of each of the spec's lies in, -1 beyond it."""
    found = []
    for axis, count in enumerate(spec.shape_zyx):
        middle_m = spec.lower_m[2 - axis] + (np.arange(count) + 0.5) * spec.voxel_m
        layer = np.floor((middle_m - grid.lower_m[2 - axis]) / grid.voxel_m).astype(np.int64)
        found.append(np.where((layer >= 0) & (layer < grid.shape_zyx[axis]), layer, -1))
    return found


def _within(spec: VoxelSpec, grid: VoxelSpec) -> Bool[np.ndarray, "Z Y X"]:
    """Voxels of the spec that lie wholly within the grid."""
    slack_m = SLACK * grid.voxel_m
    along = []
    for axis, count in enumerate(spec.shape_zyx):
        low_m = spec.lower_m[2 - axis] + np.arange(count) * spec.voxel_m
        starts = low_m >= grid.lower_m[2 - axis] - slack_m
        along.append(starts & (low_m + spec.voxel_m <= grid.upper_m[2 - axis] + slack_m))
    return along[0][:, None, None] & along[1][:, None] & along[2]
