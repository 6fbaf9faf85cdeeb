"""Voxel labels from recorded exact occupancy, resampled to any grid."""

import numpy as np
import torch
from jaxtyping import Bool, Int, Shaped

from foredrive.data.labels import VoxelLabels
from foredrive.data.logs import Log
from foredrive.data.modalities import FULL_OCCUPANCY, FullOccupancy
from foredrive.data.recorded import read_occupancy
from foredrive.errors import InputError
from foredrive.scene import VoxelSpec

NOTHING = -1
SLACK = 1e-4
"""Tolerance in voxels within which two borders coincide."""


def check_recorded_occupancy(log: Log) -> None:
    """Check that the log has recorded occupancy.

    Raises:
        InputError: it has none.
    """
    if not log.file(f"custom.{FULL_OCCUPANCY}").is_file():
        raise InputError(
            f"{log.path.folder}: no recorded occupancy; record virtual egos with --occupancy, or use "
            "the labels from lidar (--occupancy lidar)"
        )


def recorded_labels(log: Log, frame: int, spec: VoxelSpec) -> VoxelLabels:
    """Return the labels of one frame for the whole space, not only for the part that lidar has observed.

    Raises:
        InputError: the frame has no recorded occupancy, or it cannot be read.
    """
    recorded = read_occupancy(log, frame)
    if recorded is None:
        raise InputError(f"{log.path.folder}: no recorded occupancy at frame {frame}")
    return resampled_labels(recorded, spec)


def resampled_labels(recorded: FullOccupancy, spec: VoxelSpec) -> VoxelLabels:
    """Resample recorded occupancy to another grid of the same ego frame.

    A voxel is occupied if it contains the centre of an occupied recorded voxel, or if its own centre is in
    one. The result is exact if the grids coincide, or if the voxels of one consist of whole voxels of the
    other. Otherwise surfaces are displaced by up to half a recorded voxel. A voxel has the largest velocity
    of its content. All voxels inside the recorded grid are known. Voxels under the ground are free, because
    the ground is a surface.
    """
    squared_speed = np.einsum("kc,kc->k", recorded.velocity_mps, recorded.velocity_mps)
    held, known = held_voxels(recorded, squared_speed, spec)
    occupied = known & (held != NOTHING)
    flow_mps = np.zeros((3, *spec.shape_zyx), dtype=np.float32)
    flow_mps[:, occupied] = recorded.velocity_mps[held[occupied]].T
    return VoxelLabels(
        occupied=torch.from_numpy(occupied),
        known=torch.from_numpy(known),
        flow_mps=torch.from_numpy(flow_mps),
        flow_known=torch.from_numpy(occupied.copy()),
    )


def held_voxels(
    recorded: FullOccupancy, priority: Shaped[np.ndarray, "K"], spec: VoxelSpec
) -> tuple[Int[np.ndarray, "Z Y X"], Bool[np.ndarray, "Z Y X"]]:
    """Return the recorded voxel that each voxel of another grid holds, and the voxels inside the recording.

    A voxel holds the recorded voxels whose centres it contains, and the one in which its own centre lies. Of
    several it takes the one with the highest priority.

    Returns:
        Index of a recorded voxel, or NOTHING; True for voxels that are completely inside the recorded grid.
    """
    holders, middles = _voxels_at_middles(recorded.spec, spec), _voxels_at_middles(spec, recorded.spec)
    # Most of the recording is far outside: only layers that the other grid reads are looked at
    read = [
        (holder >= 0) | np.isin(np.arange(len(holder)), middle)
        for holder, middle in zip(holders, middles, strict=True)
    ]
    z, y, x = recorded.index_zyx.T
    near = np.flatnonzero(read[0][z] & read[1][y] & read[2][x])
    order = near[np.argsort(priority[near], kind="stable")]
    # From here a recorded voxel is its rank by priority, so that the maximum is the one to keep
    index = recorded.index_zyx[order]
    # One more layer on each axis holds NOTHING: index -1, for places outside, reads it
    which = np.full(np.add(recorded.spec.shape_zyx, 1), NOTHING, dtype=np.int32)
    which[tuple(index.T)] = np.arange(len(index))
    # First the recorded voxel at the centre of each voxel, then the recorded centres inside each voxel
    held = which[np.ix_(*middles)]
    z, y, x = (holder[index[:, axis]] for axis, holder in enumerate(holders))
    within = np.flatnonzero((z >= 0) & (y >= 0) & (x >= 0))
    inside = np.full_like(held, NOTHING)
    inside[z[within], y[within], x[within]] = within  # ranks ascend, and the last one stays
    held = np.maximum(held, inside)
    # Rank -1 reads the appended NOTHING
    return np.append(order, NOTHING)[held], _within(spec, recorded.spec)


def _voxels_at_middles(spec: VoxelSpec, grid: VoxelSpec) -> list[Int[np.ndarray, "_"]]:
    """Return, along z, y and x, the layer of `grid` at the centre of each layer of `spec`; -1 if outside."""
    voxels = []
    for axis, count in enumerate(spec.shape_zyx):
        middle_m = spec.lower_m[2 - axis] + (np.arange(count) + 0.5) * spec.voxel_m
        layer = np.floor((middle_m - grid.lower_m[2 - axis]) / grid.voxel_m).astype(np.int64)
        voxels.append(np.where((layer >= 0) & (layer < grid.shape_zyx[axis]), layer, -1))
    return voxels


def _within(spec: VoxelSpec, grid: VoxelSpec) -> Bool[np.ndarray, "Z Y X"]:
    """Return the voxels of `spec` that are completely inside `grid`."""
    slack_m = SLACK * grid.voxel_m
    along = []
    for axis, count in enumerate(spec.shape_zyx):
        low_m = spec.lower_m[2 - axis] + np.arange(count) * spec.voxel_m
        starts = low_m >= grid.lower_m[2 - axis] - slack_m
        along.append(starts & (low_m + spec.voxel_m <= grid.upper_m[2 - axis] + slack_m))
    return along[0][:, None, None] & along[1][:, None] & along[2]
