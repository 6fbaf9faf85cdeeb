"""Voxel labels from lidar beams (pseudo-occupancy) and from tracks (flow)."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64, UInt8
from torch import Tensor

from foredrive.data.beam_casting import FREE, OCCUPIED, UNKNOWN, box_of_points, cast_beams
from foredrive.data.boxes import read_boxes
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.scene import Boxes, LidarSweep, VoxelSpec

FREE_MARGIN_VOXELS = 0.5
"""Distance before a return within which a beam does not mark voxels as free, in voxels. Ranges are noisy. A
surface on the border of two voxels occupies both: a return in the rear one must not free the front one."""
EGO_MARGIN_M = 0.2
"""Margin around the ego vehicle's box. Returns inside (e.g. mirrors) are dropped."""
BOX_MARGIN_M = 0.1
"""Margin around annotated boxes when points are assigned to them."""


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
    beams = beams_of(sweep, ego_box)
    state = observed_state(beams, spec)
    points = beams.ends[beams.returned]
    voxel = _voxels(points, spec)
    inside = voxel >= 0
    occupied = state == OCCUPIED
    flow_mps, flow_known = _flow(points[inside], voxel[inside], occupied, boxes)
    return VoxelLabels(
        occupied=torch.from_numpy(occupied),
        known=torch.from_numpy(state >= FREE),
        flow_mps=torch.from_numpy(flow_mps),
        flow_known=torch.from_numpy(flow_known),
    )


@dataclass(frozen=True)
class Beams:
    """Beams of a sweep, in m. The ego vehicle's own returns are left out."""

    origin: Float64[np.ndarray, "N 3"]
    ends: Float64[np.ndarray, "N 3"]
    """Returns, or the points up to which misses are known to be free."""
    range_m: Float64[np.ndarray, "N"]
    returned: Bool[np.ndarray, "N"]


def beams_of(
    sweep: LidarSweep, ego_box: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None
) -> Beams:
    """Return the valid beams of an unbatched sweep, in its ego frame, without those that hit the ego vehicle.

    Args:
        ego_box: centre and size (length, width, height) of the ego vehicle in its frame, m.
    """
    beams = sweep if bool(sweep.valid.all()) else sweep[sweep.valid]
    origin = beams.origin_ego.numpy().astype(np.float64)
    range_m = beams.range_m.numpy().astype(np.float64)
    ends = origin + beams.dir_ego.numpy().astype(np.float64) * range_m[:, None]
    returned = beams.returned.numpy()
    if ego_box is None:
        return Beams(origin, ends, range_m, returned)
    kept = ~(returned & _on_ego(ends, origin, *ego_box))
    return Beams(origin[kept], ends[kept], range_m[kept], returned[kept])


def observed_state(beams: Beams, spec: VoxelSpec) -> UInt8[np.ndarray, "Z Y X"]:
    """Return UNKNOWN, FREE or OCCUPIED for each voxel of a grid in the frame of the beams."""
    state = np.full(spec.shape_zyx, UNKNOWN, dtype=np.uint8)
    voxel = _voxels(beams.ends[beams.returned], spec)
    # Returns come first: beams change only unknown voxels, so a voxel with a return stays occupied
    state.reshape(-1)[voxel[voxel >= 0]] = OCCUPIED
    lower = np.asarray(spec.lower_m)
    margin_m = np.where(beams.returned, FREE_MARGIN_VOXELS * spec.voxel_m, 0.0)
    # The fraction of the beam that is free; a miss of range 0 says nothing
    free_until = np.where(beams.range_m > 0, 1.0 - margin_m / np.maximum(beams.range_m, 1e-6), 0.0)
    cast_beams((beams.origin - lower) / spec.voxel_m, (beams.ends - lower) / spec.voxel_m, free_until, state)
    return state


def _on_ego(
    points: Float[np.ndarray, "N 3"],
    origin: Float[np.ndarray, "N 3"],
    centre: Float[np.ndarray, "3"],
    size_lwh: Float[np.ndarray, "3"],
) -> Bool[np.ndarray, "N"]:
    """Return whether points are on the ego vehicle: in its box, or above it up to its highest sensor."""
    offset, reach = points - centre, 0.5 * size_lwh + EGO_MARGIN_M
    # Up to the highest sensor, which may be above the box
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
    # In an annotated frame, occupied voxels outside of all boxes are static
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
    # Voxels in boxes without a velocity are occupied, but their flow is unknown
    known.reshape(-1)[voxel[in_box]] = np.isfinite(velocity).all(-1)
    return flow, known


def make_labels(log: Log, frame: int, spec: VoxelSpec) -> VoxelLabels:
    """Read a frame's sweep and boxes and compute its labels.

    Raises:
        InputError: data cannot be read.
    """
    read = read_sweep(log, frame)
    if read is None:
        return nothing_known(spec)
    return voxel_labels(read[0], spec, read_boxes(log, frame), log.ego_box)


def nothing_known(spec: VoxelSpec) -> VoxelLabels:
    """Return labels of which all voxels are unknown."""
    nothing = torch.zeros(spec.shape_zyx, dtype=torch.bool)
    return VoxelLabels(nothing, nothing, torch.zeros(3, *spec.shape_zyx), nothing)
