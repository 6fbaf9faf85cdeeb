"""A disk cache of voxel labels."""

import dataclasses
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from py123d.common.utils.msgpack_utils import msgpack_decode_with_numpy, msgpack_encode_with_numpy

from foredrive.data.beam_casting import FREE, OCCUPIED, UNKNOWN
from foredrive.data.boxes import read_boxes
from foredrive.data.clip_config import OccupancySource
from foredrive.data.disk_cache import DiskCache
from foredrive.data.labels import (
    Beams,
    VoxelLabels,
    beams_of,
    make_labels,
    nothing_known,
    observed_state,
    voxel_labels,
)
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.data.modalities import expand_array, squeeze_array
from foredrive.data.recorded_labels import recorded_labels
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
    hits = np.zeros(spec.shape_zyx, dtype=np.int64)
    crossed = np.zeros_like(hits)
    for neighbour in _neighbours(log, frame):
        state = _state_from(log, neighbour, frame, spec)
        hits += state == OCCUPIED
        crossed += state == FREE
    added = np.full(spec.shape_zyx, UNKNOWN)
    added[(crossed > 0) & (hits == 0)] = FREE
    added[(hits > 0) & (hits >= crossed)] = OCCUPIED
    unseen = ~own.known.numpy()
    return dataclasses.replace(
        own,
        occupied=own.occupied | torch.from_numpy(unseen & (added == OCCUPIED)),
        known=own.known | torch.from_numpy(unseen & (added != UNKNOWN)),
    )


def _neighbours(log: Log, frame: int) -> list[int]:
    """Return the frames nearest to the multiples of `STEP_S` before and after a frame, without itself."""
    offset_s = np.arange(-REACH_S, REACH_S + 0.5 * STEP_S, STEP_S)
    frames, valid = log.nearest_frames(log.t_us[frame] + 1e6 * offset_s)
    return [int(other) for other in np.unique(frames[valid]) if other != frame]


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


LABEL_VERSION = 2
"""Version in every cache key. Increase it when the labels change."""

_MAKERS = {"lidar": make_labels, "accumulated": accumulated_labels, "recorded": recorded_labels}


class LabelStore:
    """A disk cache of the labels of a log's frames.

    Args:
        cache_dir: folder of the cache. None disables it.
        spec: grid of the labels.
        source: what the labels are made from: the frame's sweep, those of its neighbours too, or the recorded
            occupancy.
    """

    def __init__(self, cache_dir: Path | None, spec: VoxelSpec, source: OccupancySource = "lidar") -> None:
        self._cache = DiskCache(None if cache_dir is None else Path(cache_dir) / "labels", "labels")
        self._spec, self._source = spec, source

    def labels(self, log: Log, frame: int) -> VoxelLabels:
        """Return the labels of one frame. Without a sweep there, labels from lidar are all unknown.

        Raises:
            InputError: there is no recorded occupancy, or the log cannot be read.
        """
        return self._cache.get(
            self._key(log, frame),
            lambda: _MAKERS[self._source](log, frame, self._spec),
            _encode,
            lambda body: _decode(body, self._spec),
        )

    def _key(self, log: Log, frame: int) -> tuple[object, ...]:
        return (LABEL_VERSION, log.fingerprint, int(log.t_us[frame]), self._spec, self._source)


def _encode(labels: VoxelLabels) -> bytes:
    """Encode bit masks of the grids and velocities of moving voxels."""
    occupied = labels.occupied.numpy()
    moving = np.flatnonzero(labels.flow_mps.numpy().any(0))
    arrays: dict[str, np.ndarray] = {
        "occupied": np.packbits(occupied),
        "known": np.packbits(labels.known.numpy()),
        "flow_known": np.packbits(labels.flow_known.numpy()[occupied]),
        "moving": moving.astype(np.uint32),
        "velocity_mps": labels.flow_mps.numpy().reshape(3, -1)[:, moving].astype(np.float16),
    }
    body: bytes = msgpack_encode_with_numpy({name: squeeze_array(array) for name, array in arrays.items()})
    return body


def _decode(data: bytes, spec: VoxelSpec) -> VoxelLabels:
    arrays = {name: expand_array(packed) for name, packed in msgpack_decode_with_numpy(data).items()}
    count = int(np.prod(spec.shape_zyx))
    occupied = np.unpackbits(arrays["occupied"], count=count).astype(bool)
    flow_known = np.zeros(count, dtype=bool)
    flow_known[occupied] = np.unpackbits(arrays["flow_known"], count=int(occupied.sum())).astype(bool)
    flow = np.zeros((3, count), dtype=np.float32)
    flow[:, arrays["moving"]] = arrays["velocity_mps"]
    grid = spec.shape_zyx
    return VoxelLabels(
        occupied=torch.from_numpy(occupied.reshape(grid)),
        known=torch.from_numpy(np.unpackbits(arrays["known"], count=count).astype(bool).reshape(grid)),
        flow_mps=torch.from_numpy(flow.reshape(3, *grid)),
        flow_known=torch.from_numpy(flow_known.reshape(grid)),
    )
