"""Voxel labels from the sweeps of several frames: denser than those of one sweep, and still without boxes."""

import dataclasses

import numpy as np
import torch
from jaxtyping import UInt8

from foredrive.data.beam_casting import FREE, OCCUPIED, UNKNOWN
from foredrive.data.boxes import read_boxes
from foredrive.data.labels import Beams, VoxelLabels, beams_of, nothing_known, observed_state, voxel_labels
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.geometry.se3 import transform_points
from foredrive.scene import VoxelSpec

REACH_S = 3.0
"""Maximum time between a frame and the neighbours whose sweeps are added to its own."""
STEP_S = 0.5
"""Time between two neighbours."""


def accumulated_labels(log: Log, frame: int, spec: VoxelSpec) -> VoxelLabels:
    """Return the labels of one frame. Voxels that its own sweep has not observed take those of neighbours.

    A voxel that neighbours have observed is occupied if at least half of them found a return in it, and free
    if none did. All others are unknown: something has moved there, or beams only graze a surface. Static
    things are so labelled behind obstacles and between beams. What moves is labelled by the own sweep alone.

    Raises:
        InputError: a sweep cannot be read.
    """
    read = read_sweep(log, frame)
    if read is None:
        return nothing_known(spec)
    own = voxel_labels(read[0], spec, read_boxes(log, frame), log.ego_box)
    found = np.zeros(spec.shape_zyx, dtype=np.int64)
    crossed = np.zeros_like(found)
    for neighbour in _neighbours(log, frame):
        state = _state_from(log, neighbour, frame, spec)
        found += state == OCCUPIED
        crossed += state == FREE
    added = np.full(spec.shape_zyx, UNKNOWN)
    added[(crossed > 0) & (found == 0)] = FREE
    added[(found > 0) & (found >= crossed)] = OCCUPIED
    unseen = ~own.known.numpy()
    return dataclasses.replace(
        own,
        occupied=own.occupied | torch.from_numpy(unseen & (added == OCCUPIED)),
        known=own.known | torch.from_numpy(unseen & (added != UNKNOWN)),
    )


def _neighbours(log: Log, frame: int) -> list[int]:
    """Return the frames nearest to the multiples of `STEP_S` before and after a frame, without itself."""
    offset_s = np.arange(-REACH_S, REACH_S + 0.5 * STEP_S, STEP_S)
    frames, there = log.nearest_frames(log.t_us[frame] + 1e6 * offset_s)
    return [int(other) for other in np.unique(frames[there]) if other != frame]


def _state_from(log: Log, neighbour: int, frame: int, spec: VoxelSpec) -> UInt8[np.ndarray, "Z Y X"]:
    """Return what the sweep of `neighbour` has observed of the grid of `frame`."""
    read = read_sweep(log, neighbour)
    if read is None:
        return np.full(spec.shape_zyx, UNKNOWN, dtype=np.uint8)
    T = np.linalg.inv(log.T_world_ego[frame]) @ log.T_world_ego[neighbour]
    beams = beams_of(read[0], log.ego_box)
    origin, ends = (
        transform_points(torch.from_numpy(T), torch.from_numpy(points)).numpy()
        for points in (beams.origin, beams.ends)
    )
    moved = Beams(origin, ends, beams.range_m, beams.returned)
    return observed_state(moved, spec)
