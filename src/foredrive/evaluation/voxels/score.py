"""Score folders of semantic voxels under every protocol of their data set."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from foredrive.evaluation.summary import Figures
from foredrive.evaluation.voxels.files import VoxelFiles, VoxelFrame, read_frame
from foredrive.metrics.voxels.protocols import GRID, RAY_PROTOCOLS, VOXEL_PROTOCOLS, RayProtocol
from foredrive.metrics.voxels.rays import RayCounts, cast_rays, count_rays, score_rays
from foredrive.metrics.voxels.semantic import count_voxels, mean_iou, voxel_ious
from foredrive.ops.threads import prefetched
from foredrive.scene import VoxelSpec


class VoxelCounts:
    """Counts of frames under every protocol of a data set's classes.

    Args:
        data_set: occ3d or openocc.
        spec: grid of the frames.
    """

    def __init__(self, data_set: str, spec: VoxelSpec = GRID) -> None:
        self.data_set, self._spec = data_set, spec
        self._classes = VOXEL_PROTOCOLS[data_set].classes
        self._voxels = np.zeros((2, 2, len(self._classes), len(self._classes)), np.int64)
        self._rays: dict[str, RayCounts] = {}
        self._frames = self._ray_frames = 0

    def add(self, frame: VoxelFrame, origins_m: Float64[ndarray, "O 3"] | None) -> None:
        """Add a frame. Without places of the lidar it has no rays."""
        known = slice(None) if frame.known is None else frame.known
        self._voxels += count_voxels(
            _as_grid(frame.predicted[known]),
            _as_grid(frame.true[known]),
            _as_grid(frame.seen_by_camera[known]),
            _as_grid(frame.seen_by_lidar[known]),
            len(self._classes),
        )
        self._frames += 1
        if origins_m is not None and len(origins_m):
            self._add_rays(frame, origins_m)
            self._ray_frames += 1

    def _add_rays(self, frame: VoxelFrame, origins_m: Float64[ndarray, "O 3"]) -> None:
        """Cast the rays of one frame once, and count them under each protocol. Unknown voxels are free."""
        free = len(self._classes) - 1
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
                found = _voxel_figures(voxel_ious(self._voxels, protocol), self._classes)
                figures |= {f"{name}.{key}": value for key, value in found.items()}
                figures[f"{name}.frames_counted"] = self._frames
        for name, counts in self._rays.items():
            found = {"frames_counted": self._ray_frames} | _ray_figures(counts, RAY_PROTOCOLS[name])
            figures |= {f"{name}.{key}": value for key, value in found.items()}
        return figures


def score_voxels(files: VoxelFiles, on_frame: Callable[[], None] = lambda: None) -> Figures:
    """Return the figures over all frames, under `occupancy.PROTOCOL.`; NaN where nothing could be counted.

    `on_frame` is called after each frame. Without poses there are no figures of rays.
    """
    counts, without_velocity = VoxelCounts(files.data_set), 0
    frames = (read_frame(files, token) for token in files.truth)
    for token, frame in zip(files.truth, prefetched(frames), strict=True):
        counts.add(frame, None if files.origins_m is None else files.origins_m[token])
        without_velocity += not frame.states_velocity
        on_frame()
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
