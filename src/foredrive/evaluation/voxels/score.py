"""Score folders of semantic voxels under every protocol of their data set."""

import operator
from collections.abc import Callable
from functools import reduce

import numpy as np
from numpy import ndarray

from foredrive.evaluation.summary import Figures
from foredrive.evaluation.voxels.files import VoxelFiles, VoxelFrame, read_frame
from foredrive.metrics.voxels.protocols import RAY_PROTOCOLS, VOXEL_PROTOCOLS, RayProtocol
from foredrive.metrics.voxels.rays import RayCounts, cast_rays, count_rays, score_rays
from foredrive.metrics.voxels.semantic import count_voxels, mean_iou, voxel_ious
from foredrive.ops.threads import prefetched


def score_voxels(files: VoxelFiles, on_frame: Callable[[], None] = lambda: None) -> Figures:
    """Return the figures over all frames, under `occupancy.PROTOCOL.`; NaN where nothing could be counted.

    `on_frame` is called after each frame. Without poses there are no figures of rays.
    """
    classes = files.classes
    ray_protocols = {name: p for name, p in RAY_PROTOCOLS.items() if p.classes == classes}
    voxels = np.zeros((2, 2, len(classes), len(classes)), np.int64)
    rays: dict[str, list[RayCounts]] = {name: [] for name in ray_protocols}
    without_velocity = 0
    frames = (read_frame(files, token) for token in files.truth)
    for token, frame in zip(files.truth, prefetched(frames), strict=True):
        voxels += count_voxels(
            frame.predicted, frame.true, frame.seen_by_camera, frame.seen_by_lidar, len(classes)
        )
        without_velocity += not frame.states_velocity
        if files.origins_m is not None:
            _add_rays(rays, frame, files.origins_m[token], ray_protocols)
        on_frame()
    number = len(files.truth)
    figures: Figures = {"data_set": files.data_set, "frames": number}
    if files.data_set == "openocc":
        figures["frames_without_velocity"] = without_velocity
    for name, protocol in VOXEL_PROTOCOLS.items():
        if protocol.classes == classes:
            found = {"frames_counted": number} | _voxel_figures(voxel_ious(voxels, protocol), classes)
            figures |= {f"occupancy.{name}.{key}": value for key, value in found.items()}
    for name, counts in rays.items():
        if counts:
            found = {"frames_counted": number} | _ray_figures(
                reduce(operator.add, counts), ray_protocols[name]
            )
            figures |= {f"occupancy.{name}.{key}": value for key, value in found.items()}
    return figures


def _add_rays(
    rays: dict[str, list[RayCounts]],
    frame: VoxelFrame,
    origins_m: ndarray,
    protocols: dict[str, RayProtocol],
) -> None:
    """Cast the rays of one frame once, and count them under each protocol."""
    free = len(next(iter(protocols.values())).classes) - 1
    predicted = cast_rays(origins_m, frame.predicted, free, frame.predicted_mps)
    true = cast_rays(origins_m, frame.true, free, frame.true_mps)
    for name, protocol in protocols.items():
        rays[name].append(count_rays(predicted, true, protocol))


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
