"""Voxel labels from lidar beams (pseudo-occupancy) and from tracks (flow), with a disk cache."""

import hashlib
import logging
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from py123d.common.utils.msgpack_utils import msgpack_decode_with_numpy, msgpack_encode_with_numpy
from torch import Tensor

from foredrive.data.beam_casting import FREE, OCCUPIED, UNKNOWN, box_of_points, cast_beams
from foredrive.data.boxes import read_boxes
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.data.modalities import expand_array, squeeze_array
from foredrive.files import atomic_path
from foredrive.scene import Boxes, LidarSweep, VoxelSpec

LABEL_VERSION = 2
"""Version in every cache key. Increase it when the labels change."""
FREE_MARGIN_VOXELS = 0.5
"""Distance before a return within which a beam frees no voxel. Ranges are noisy, and a surface at the border
of a voxel must not free the voxel in front of it, which it also occupies."""
EGO_MARGIN_M = 0.2
"""Margin around the ego vehicle's box. Returns inside (e.g. mirrors) are dropped."""
BOX_MARGIN_M = 0.1
"""Margin around annotated boxes when points are assigned to them."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class VoxelLabels:
    """Voxel labels of one frame in its own ego frame."""

    occupied: Bool[Tensor, "Z Y X"]
    known: Bool[Tensor, "Z Y X"]
    """True where the voxel is occupied or a beam passed through it."""
    flow_mps: Float[Tensor, "3 Z Y X"]
    """Velocity over ground in the ego axes. 0 where not known."""
    flow_known: Bool[Tensor, "Z Y X"]
    """Occupied voxels of annotated frames, without those in boxes of unknown velocity."""


def voxel_labels(
    sweep: LidarSweep,
    spec: VoxelSpec,
    boxes: Boxes | None,
    ego_box: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None,
) -> VoxelLabels:
    """Compute the labels of one sweep.

    A voxel is occupied if it contains a return. Otherwise it is free if a beam passes through it before the
    return (without the last `FREE_MARGIN_VOXELS`) or, for a miss, within the range known to be free. All
    other voxels are unknown.

    Args:
        sweep: unbatched, in the ego frame.
        boxes: unbatched, in the ego frame. None if the frame is not annotated; then the flow is unknown.
        ego_box: centre and size (length, width, height) of the ego vehicle in its frame, m.
    """
    beams = sweep if bool(sweep.valid.all()) else sweep[sweep.valid]
    origin = beams.origin_ego.numpy().astype(np.float64)
    direction = beams.dir_ego.numpy().astype(np.float64)
    range_m = beams.range_m.numpy().astype(np.float64)
    returned = beams.returned.numpy()
    ends = origin + direction * range_m[:, None]
    if ego_box is not None:
        on_ego = returned & _on_ego(ends, origin, *ego_box)
        origin, range_m, returned, ends = (a[~on_ego] for a in (origin, range_m, returned, ends))

    state = np.full(spec.shape_zyx, UNKNOWN, dtype=np.uint8)
    points = ends[returned]
    voxel = _voxels(points, spec)
    inside = voxel >= 0
    state.reshape(-1)[voxel[inside]] = OCCUPIED
    lower = np.asarray(spec.lower_m)
    margin_m = np.where(returned, FREE_MARGIN_VOXELS * spec.voxel_m, 0.0)
    free_until = np.where(range_m > 0, 1.0 - margin_m / np.maximum(range_m, 1e-6), 0.0)
    cast_beams((origin - lower) / spec.voxel_m, (ends - lower) / spec.voxel_m, free_until, state)

    occupied = state == OCCUPIED
    flow_mps, flow_known = _flow(points[inside], voxel[inside], occupied, boxes)
    return VoxelLabels(
        occupied=torch.from_numpy(occupied),
        known=torch.from_numpy(state >= FREE),
        flow_mps=torch.from_numpy(flow_mps),
        flow_known=torch.from_numpy(flow_known),
    )


def _on_ego(
    points: Float[np.ndarray, "N 3"],
    origin: Float[np.ndarray, "N 3"],
    centre: Float[np.ndarray, "3"],
    size_lwh: Float[np.ndarray, "3"],
) -> Bool[np.ndarray, "N"]:
    """Return whether points are on the ego vehicle: in its box, or above it up to its highest sensor."""
    offset, reach = points - centre, 0.5 * size_lwh + EGO_MARGIN_M
    top = max(reach[2], float(origin[:, 2].max(initial=-np.inf)) - centre[2] + EGO_MARGIN_M)
    footprint = (np.abs(offset[:, :2]) <= reach[:2]).all(-1)
    return footprint & (offset[:, 2] >= -reach[2]) & (offset[:, 2] <= top)


def _voxels(points: Float[np.ndarray, "N 3"], spec: VoxelSpec) -> Int64[np.ndarray, "N"]:
    """Return the flat ZYX index of the voxel of each point, -1 outside the grid."""
    x, y, z = np.floor((points - np.asarray(spec.lower_m)) / spec.voxel_m).astype(np.int64).T
    nz, ny, nx = spec.shape_zyx
    inside = (x >= 0) & (x < nx) & (y >= 0) & (y < ny) & (z >= 0) & (z < nz)
    return np.where(inside, (z * ny + y) * nx + x, -1)


def _flow(
    points: Float[np.ndarray, "N 3"],
    voxel: Int64[np.ndarray, "N"],
    occupied: Bool[np.ndarray, "Z Y X"],
    boxes: Boxes | None,
) -> tuple[Float[np.ndarray, "3 Z Y X"], Bool[np.ndarray, "Z Y X"]]:
    """Compute the flow of occupied voxels.

    A voxel has the velocity of the box that contains one of its points. It is static if no box contains any.
    """
    flow = np.zeros((3, *occupied.shape), dtype=np.float32)
    if boxes is None:
        return flow, np.zeros_like(occupied)
    known = occupied.copy()
    boxes = boxes[boxes.valid]
    box = box_of_points(
        points,
        boxes.centre.numpy().astype(np.float64),
        0.5 * boxes.size_lwh.numpy().astype(np.float64) + BOX_MARGIN_M,
        boxes.yaw.numpy().astype(np.float64),
    )
    in_box = box >= 0
    velocity = boxes.velocity.numpy()[box[in_box]]
    flow.reshape(3, -1)[:2, voxel[in_box]] = np.nan_to_num(velocity).T
    known.reshape(-1)[voxel[in_box]] = np.isfinite(velocity).all(-1)
    return flow, known


class LabelStore:
    """A disk cache of the labels of a log's frames.

    The name of an entry is a hash of everything that the labels depend on: the log's files (name, size,
    modification time), the frame's time, the grid and `LABEL_VERSION`. Entries are written atomically.
    Damaged entries are replaced.
    """

    def __init__(self, cache_dir: Path | None, spec: VoxelSpec) -> None:
        self._folder = None if cache_dir is None else Path(cache_dir) / "labels"
        self._spec = spec

    def labels(self, log: Log, frame: int) -> VoxelLabels:
        """Return the labels of one frame. All voxels are unknown if the log has no sweep there."""
        file = self._file(log, frame)
        if file is not None:
            kept = _read_entry(file, self._spec)
            if kept is not None:
                return kept
        labels = make_labels(log, frame, self._spec)
        if file is None:
            return labels
        entry = _encode(labels)
        with atomic_path(file) as temporary:
            temporary.write_bytes(entry)
        return _decode(entry, self._spec)  # velocities are rounded here as in later reads

    def _file(self, log: Log, frame: int) -> Path | None:
        if self._folder is None:
            return None
        key = (LABEL_VERSION, log.fingerprint, int(log.t_us[frame]), self._spec)
        name = hashlib.blake2b(repr(key).encode(), digest_size=16).hexdigest()
        return self._folder / name[:2] / f"{name}.labels"


def make_labels(log: Log, frame: int, spec: VoxelSpec) -> VoxelLabels:
    """Read a frame's sweep and boxes and compute its labels.

    Raises:
        InputError: data cannot be read.
    """
    read = read_sweep(log, frame)
    if read is None:
        nothing = torch.zeros(spec.shape_zyx, dtype=torch.bool)
        return VoxelLabels(nothing, nothing, torch.zeros(3, *spec.shape_zyx), nothing)
    return voxel_labels(read[0], spec, read_boxes(log, frame), log.ego_box)


def _encode(labels: VoxelLabels) -> bytes:
    """Encode bit masks of the grids and velocities of moving voxels, with a checksum in front."""
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
    return zlib.crc32(body).to_bytes(4, "little") + body


def _decode(data: bytes, spec: VoxelSpec) -> VoxelLabels:
    if zlib.crc32(data[4:]).to_bytes(4, "little") != data[:4]:
        raise ValueError("checksum")
    arrays = {name: expand_array(packed) for name, packed in msgpack_decode_with_numpy(data[4:]).items()}
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


def _read_entry(file: Path, spec: VoxelSpec) -> VoxelLabels | None:
    try:
        data = file.read_bytes()
    except FileNotFoundError:
        return None
    try:
        return _decode(data, spec)
    except Exception as error:  # any damaged entry can be computed again
        _log.warning("%s is damaged (%s) and is made anew", file, error)
        return None
