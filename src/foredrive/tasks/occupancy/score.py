"""Score folders of semantic voxels under every protocol of their data set.

RayIoU compares what a lidar at several places would see in predicted and in true voxels: Liu et al., Fully
Sparse 3D Occupancy Prediction (SparseOcc), section 4. Every number is rounded where the public code rounds
it, so that rays end in the same voxels.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from numpy import ndarray
from torch import Tensor

from foredrive.engine.summary import Figures
from foredrive.errors import InputError
from foredrive.ops.threads import prefetched
from foredrive.ops.voxel_rays import RayEnds, first_hits
from foredrive.scene import VoxelSpec
from foredrive.scene.semantics import VOXEL_CLASSES, SemanticVoxels
from foredrive.tasks.objects.matching import mean_of_valid
from foredrive.tasks.occupancy.files import VoxelFiles, VoxelFrame, read_frame
from foredrive.tasks.occupancy.protocols import (
    GRID,
    RAY_PROTOCOLS,
    VOXEL_PROTOCOLS,
    RayProtocol,
    VoxelProtocol,
)
from foredrive.tasks.occupancy.turned import TurnedVoxels

MAX_ELEVATION_RAD = 0.21


@lru_cache(maxsize=1)
def lidar_rays() -> Float32[ndarray, "14040 3"]:
    """Return unit vectors of the rays from one origin: 39 elevations, 360 azimuths each.

    Ten elevations meet the ground at 1, 2 … 10 sensor heights; the last step between them is repeated
    until the first elevation above 0.21 rad, about the upper end of nuScenes' lidar.
    """
    # Elevations at which a ray meets the ground at k sensor heights: -45° for k = 1, flatter for larger k
    elevation = [np.arctan(k) - np.pi / 2 for k in range(1, 11)]
    while elevation[-1] < MAX_ELEVATION_RAD:
        elevation.append(elevation[-1] + (elevation[-1] - elevation[-2]))
    up, around = np.meshgrid(np.array(elevation), np.deg2rad(np.arange(360)), indexing="ij")
    rays = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=-1)
    rays = rays.reshape(-1, 3).astype(np.float32)
    rays.flags.writeable = False
    return rays


class Seen(NamedTuple):
    """What the rays of a frame see in one grid."""

    label: UInt8[ndarray, "N"]
    range_m: Float32[ndarray, "N"]
    velocity_mps: Float32[ndarray, "N 2"] | None


def cast_rays(
    origins_m: Float64[ndarray, "O 3"],
    labels: UInt8[ndarray, "Z Y X"],
    free: int,
    velocity_mps: Float32[ndarray, "Z Y X 2"] | None = None,
    *,
    spec: VoxelSpec = GRID,
) -> Seen:
    """Return label, range and velocity at the end of each ray, origin by origin.

    The range is that at which the ray leaves the voxel that it hits, or the grid if it hits none. A ray that
    passes beside the grid has range -0.4 m and reads the grid's first voxel, as in the public code.

    Raises:
        InputError: an origin is not finite.
    """
    origin, direction = _in_voxels(origins_m, spec)
    ends: RayEnds = first_hits(origin, direction, labels != free)
    # A ray that hits nothing reads the voxel 0
    voxel = np.maximum(ends.voxel, 0)
    return Seen(
        labels.reshape(-1)[voxel],
        ends.distance.astype(np.float32) * np.float32(spec.voxel_m),
        None if velocity_mps is None else velocity_mps.reshape(-1, 2)[voxel],
    )


def _in_voxels(
    origins_m: Float64[ndarray, "O 3"], spec: VoxelSpec
) -> tuple[Float64[ndarray, "N 3"], Float64[ndarray, "N 3"]]:
    """Return origin and unit direction of each ray in voxels; ends are rounded to single precision."""
    if not np.isfinite(origins_m).all():
        raise InputError(
            f"origin {int(np.argwhere(~np.isfinite(origins_m))[0, 0])} of the rays is not finite"
        )
    lower_m, voxel_m = np.array(spec.lower_m), np.float64(np.float32(spec.voxel_m))
    rays = lidar_rays()
    # Single precision where the public code has it, so that rays end in the same voxels
    end = ((rays + origins_m[:, None] - lower_m) / voxel_m).astype(np.float32).reshape(-1, 3)
    origin = ((origins_m - lower_m) / voxel_m).astype(np.float32)
    # The direction is that between the rounded ends, computed in double precision
    origin = np.repeat(origin, len(rays), axis=0).astype(np.float64)
    step = end.astype(np.float64) - origin
    x, y, z = step.T
    return origin, step / np.sqrt(x * x + y * y + z * z)[:, None]


@dataclass(frozen=True)
class RayCounts:
    """Numbers of rays whose truth is not free, and sums of velocity errors. Those of frames add up."""

    true: Int64[ndarray, "C"]
    predicted: Int64[ndarray, "C"]
    hits: Int64[ndarray, "T C"]
    """By threshold and class."""
    velocity_error_mps: Float64[ndarray, "C"]
    velocity_rays: Int64[ndarray, "C"]

    def __add__(self, other: "RayCounts") -> "RayCounts":
        return RayCounts(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


def count_rays(predicted: Seen, true: Seen, protocol: RayProtocol) -> RayCounts:
    """Count the rays of one frame under a protocol.

    Without velocities in either, no velocity errors are summed.
    """
    classes = len(protocol.classes)
    # Rays whose truth is free are dropped first
    valid = true.label != classes - 1
    label, true_label = predicted.label[valid], true.label[valid]
    precision = np.float16 if protocol.stored == "half" else np.float32
    # The server stores ranges in half precision
    ranges_m = (seen.range_m[valid].astype(precision).astype(np.float32) for seen in (predicted, true))
    error_m = np.abs(np.subtract(*ranges_m))
    # A hit has the true class and nearly the true range
    same = label == true_label

    def by_class(rays: ndarray) -> Int64[ndarray, "C"]:
        return np.bincount(rays, minlength=classes).astype(np.int64)

    error_mps, counted = np.zeros(classes), np.zeros(classes, np.int64)
    if predicted.velocity_mps is not None and true.velocity_mps is not None:
        hit = same & (error_m < protocol.velocity_threshold_m)
        stored = (v[valid].astype(precision) for v in (predicted.velocity_mps, true.velocity_mps))
        difference = np.subtract(*(v.astype(np.float32) for v in stored))
        errors = np.linalg.norm(difference, axis=1).astype(np.float64)
        error_mps, counted = _velocity_errors(errors, true_label, hit, protocol)
    return RayCounts(
        true=by_class(true_label),
        predicted=by_class(label),
        hits=np.stack([by_class(label[same & (error_m < limit)]) for limit in protocol.thresholds_m]),
        velocity_error_mps=error_mps,
        velocity_rays=counted,
    )


def _velocity_errors(
    error_mps: Float64[ndarray, "n"], true_label: UInt8[ndarray, "n"], hit: ndarray, protocol: RayProtocol
) -> tuple[Float64[ndarray, "C"], Int64[ndarray, "C"]]:
    """Return sums of errors, and numbers of rays, of the classes that move."""
    classes = len(protocol.classes)
    # Rays of each class that hit
    number = np.bincount(true_label[hit], minlength=classes).astype(np.int64)
    if protocol.velocity_rays == "hits":
        total = np.bincount(true_label[hit], weights=error_mps[hit], minlength=classes)
    else:
        # The server averages over all rays of a frame that has a hit of the class
        total = np.where(number > 0, error_mps.sum(), 0.0)
        number = np.where(number > 0, len(error_mps), 0)
    moving = np.array([name in protocol.moving for name in protocol.classes])
    return np.where(moving, total, 0.0), np.where(moving, number, 0)


@dataclass(frozen=True)
class RayScores:
    """The figures over a data set. NaN: nothing could be counted."""

    iou: Float64[ndarray, "T C"]
    """By threshold and class; NaN for a class that neither truth nor prediction has on the counted rays."""
    ave_mps: Float64[ndarray, "C"]
    """Mean velocity error; NaN for a class without hits."""
    rayiou: float
    mave_mps: float
    occ_score: float
    """NaN without velocities, as in the public code."""


def score_rays(counts: RayCounts, protocol: RayProtocol) -> RayScores:
    """Return RayIoU, velocity errors and OccScore of the summed counts."""
    # Union: true and predicted rays, less those counted twice
    either = counts.true + counts.predicted - counts.hits
    iou = np.divide(counts.hits, either, out=np.full(either.shape, np.nan), where=either > 0)
    rays = counts.velocity_rays
    ave = np.divide(counts.velocity_error_mps, rays, out=np.full(len(rays), np.nan), where=rays > 0)
    rayiou, mave = mean_iou(iou), mean_of_valid(ave.tolist())
    # OccScore: RayIoU and the velocity score, weighted
    still = protocol.range_weight * rayiou
    score = still + (1.0 - protocol.range_weight) * float(np.maximum(1.0 - mave, 0.0))
    return RayScores(iou, ave, rayiou, mave, score)


class VoxelCounts:
    """Counts of frames under every protocol of a data set's classes.

    Args:
        data_set: occ3d or openocc.
        spec: grid of the frames.
    """

    def __init__(self, data_set: str, spec: VoxelSpec = GRID) -> None:
        self.data_set, self._spec = data_set, spec
        self._classes = VOXEL_PROTOCOLS[data_set].classes
        # Voxels by camera mask, lidar mask, true class, predicted class
        self._voxels = np.zeros((2, 2, len(self._classes), len(self._classes)), np.int64)
        self._rays: dict[str, RayCounts] = {}
        self._frames = self._ray_frames = 0

    def add(self, frame: VoxelFrame, origins_m: Float64[ndarray, "O 3"] | None) -> None:
        """Add a frame. Without places of the lidar it has no rays."""
        # A mask turns the grid into a list of known voxels
        judged = slice(None) if frame.known is None else frame.known
        self._voxels += count_voxels(
            _as_grid(frame.predicted[judged]),
            _as_grid(frame.true[judged]),
            _as_grid(frame.seen_by_camera[judged]),
            _as_grid(frame.seen_by_lidar[judged]),
            len(self._classes),
        )
        self._frames += 1
        if origins_m is not None and len(origins_m):
            self._add_rays(frame, origins_m)
            self._ray_frames += 1

    def _add_rays(self, frame: VoxelFrame, origins_m: Float64[ndarray, "O 3"]) -> None:
        """Cast the rays of one frame once, and count them under each protocol. Unknown voxels are free."""
        free = len(self._classes) - 1
        # Rays pass through what has no truth
        voxels = frame.predicted if frame.known is None else np.where(frame.known, frame.predicted, free)
        predicted = cast_rays(origins_m, voxels.astype(np.uint8), free, frame.predicted_mps, spec=self._spec)
        true = cast_rays(origins_m, frame.true, free, frame.true_mps, spec=self._spec)
        for name, protocol in RAY_PROTOCOLS.items():
            if protocol.classes == self._classes:
                counts = count_rays(predicted, true, protocol)
                self._rays[name] = self._rays[name] + counts if name in self._rays else counts

    def figures(self) -> Figures:
        """Return `occ3d.miou_pct`, `occ3d.rayiou_1m_pct`, `occ3d.iou_pct.car`, …; NaN if nothing counts."""
        figures: Figures = {}
        for name, protocol in VOXEL_PROTOCOLS.items():
            if protocol.classes == self._classes:
                of_protocol = _voxel_figures(voxel_ious(self._voxels, protocol), self._classes)
                figures |= {f"{name}.{key}": value for key, value in of_protocol.items()}
                figures[f"{name}.frames_counted"] = self._frames
        for name, counts in self._rays.items():
            of_protocol = {"frames_counted": self._ray_frames} | _ray_figures(counts, RAY_PROTOCOLS[name])
            figures |= {f"{name}.{key}": value for key, value in of_protocol.items()}
        return figures


def score_voxels(files: VoxelFiles, on_frame: Callable[[], None] = lambda: None) -> Figures:
    """Return the figures over all frames, under `occupancy.PROTOCOL.`; NaN where nothing could be counted.

    `on_frame` is called after each frame. Without poses there are no figures of rays. One line says so if the
    results seem to have other axes.
    """
    counts, without_velocity = VoxelCounts(files.data_set), 0
    folder = next(iter(files.results.values())).parent
    turned = TurnedVoxels(folder, free=len(VOXEL_PROTOCOLS[files.data_set].classes) - 1)
    frames = (read_frame(files, token) for token in files.truth)
    # Frames are read ahead while earlier ones are counted
    for token, frame in zip(files.truth, prefetched(frames), strict=True):
        counts.add(frame, None if files.origins_m is None else files.origins_m[token])
        turned.add(frame.predicted, frame.true, frame.seen_by_camera)
        without_velocity += not frame.states_velocity
        on_frame()
    turned.tell()
    figures: Figures = {"data_set": files.data_set, "frames": len(files.truth)}
    if files.data_set == "openocc":
        figures["frames_without_velocity"] = without_velocity
    return figures | {f"occupancy.{key}": value for key, value in counts.figures().items()}


def _as_grid(voxels: ndarray) -> ndarray:
    """Return voxels, of which a mask may have made a list, as a grid."""
    return voxels if voxels.ndim == 3 else voxels[None, None]


def _voxel_figures(ious: ndarray, classes: tuple[str, ...]) -> Figures:
    named = zip(classes[:-1], ious.tolist(), strict=False)
    return {"miou_pct": 100 * mean_iou(ious)} | {f"iou_pct.{name}": 100 * iou for name, iou in named}


def _ray_figures(counts: RayCounts, protocol: RayProtocol) -> Figures:
    scores = score_rays(counts, protocol)
    figures: Figures = {"rayiou_pct": 100 * scores.rayiou}
    for threshold_m, ious in zip(protocol.thresholds_m, scores.iou, strict=True):
        figures[f"rayiou_{threshold_m:g}m_pct"] = 100 * mean_iou(ious)
    if protocol.moving:
        figures |= {"mave_mps": scores.mave_mps, "occ_score": scores.occ_score}
    for k, name in enumerate(protocol.classes[:-1]):
        figures[f"rayiou_pct.{name}"] = 100 * float(scores.iou[:, k].mean())
        if name in protocol.moving:
            figures[f"ave_mps.{name}"] = float(scores.ave_mps[k])
    return figures


def count_voxels(
    predicted: UInt8[ndarray, "*voxels"],
    true: UInt8[ndarray, "*voxels"],
    seen_by_camera: Bool[ndarray, "*voxels"],
    seen_by_lidar: Bool[ndarray, "*voxels"],
    classes: int,
) -> Int64[ndarray, "2 2 C C"]:
    """Count voxels by: seen by a camera, seen by the lidar, true class, predicted class.

    The counts of frames add up, and every protocol sums those of its masks.
    """
    # One number for each combination of masks and classes
    cell = (seen_by_camera.astype(np.int64) * 2 + seen_by_lidar) * classes + true
    counts = np.bincount((cell * classes + predicted).ravel(), minlength=4 * classes * classes)
    return counts.astype(np.int64).reshape(2, 2, classes, classes)


def count_semantics(predicted: UInt8[Tensor, "*b Z Y X"], truth: SemanticVoxels) -> Int64[ndarray, "2 2 C C"]:
    """Count the known voxels of a batch likewise. Where there is no truth, no protocol can judge."""
    known_voxels = truth.known.cpu().numpy()
    labels, true, camera, lidar = (
        part.cpu().numpy()[known_voxels]
        for part in (predicted, truth.index, truth.camera_mask, truth.lidar_mask)
    )
    return count_voxels(labels, true, camera, lidar, len(VOXEL_CLASSES[truth.taxonomy]))


def voxel_ious(counts: Int64[ndarray, "2 2 C C"], protocol: VoxelProtocol) -> Float64[ndarray, "C"]:
    """Return the IoU of each class, free among them; NaN for classes that the protocol leaves out."""
    # A protocol without a mask sums over both values of it
    by_camera = counts[1:] if "camera" in protocol.masks else counts
    counted = by_camera[:, 1:] if "lidar" in protocol.masks else by_camera
    table = counted.sum(axis=(0, 1))
    # Diagonal: right voxels; rows: truth; columns: prediction
    hits, true, predicted = np.diag(table), table.sum(axis=1), table.sum(axis=0)
    either = true + predicted - hits
    judged_classes = true > 0 if protocol.absent == "in truth" else either > 0
    return np.divide(hits, either, out=np.full(len(hits), np.nan), where=judged_classes)


def mean_iou(ious: Float64[ndarray, "*T C"]) -> float:
    """Return the mean over all classes but the last, which is free, and over thresholds; without NaN."""
    return mean_of_valid(ious[..., :-1].ravel().tolist())
