"""Running sums over a data set, and the flat figures they give."""

import torch
from torch import Tensor

from foredrive.errors import InputError
from foredrive.geometry.se3 import inverse_se3
from foredrive.metrics import (
    PROTOCOLS,
    FlowErrors,
    FuturesCounts,
    Obstacles,
    OccupancyCounts,
    PlanScores,
    VoxelPrior,
    above_ground,
    carried_along,
    count_futures,
    count_occupancy,
    flow_errors,
    psnr_db,
    score_plan,
    ssim,
)
from foredrive.metrics.protocols import HORIZON_NAMES
from foredrive.scene import Clip, Trajectory, VoxelGrid, VoxelSpec

Figures = dict[str, float | int | str]
COPIES = (".copy", ".carried_copy")
"""Of a predicted present: as it is, and carried along the driven path."""


def frame_names(frames: int, frame_dt_s: float) -> list[str]:
    """Names of now and the key frames after it: now, future_500ms, future_1s, …"""
    milliseconds = [round(1000 * k * frame_dt_s) for k in range(1, frames)]
    return ["now", *(f"future_{ms}ms" if ms % 1000 else f"future_{ms // 1000}s" for ms in milliseconds)]


class PlanningTotals:
    """Open-loop scores of one planner under every protocol."""

    def __init__(self) -> None:
        self._l2_m = {name: torch.zeros(len(HORIZON_NAMES), dtype=torch.float64) for name in PROTOCOLS}
        self._collisions = {
            name: torch.zeros(3, len(HORIZON_NAMES), dtype=torch.float64) for name in PROTOCOLS
        }
        self._frames = dict.fromkeys(PROTOCOLS, 0)
        self._frames_with_boxes = dict.fromkeys(PROTOCOLS, 0)
        self._frames_invalid = 0

    def add(self, plan: Trajectory, driven: Trajectory, obstacles: Obstacles) -> None:
        """Score a batch of plans [b 1 T]."""
        scores: PlanScores | None = None
        for name, protocol in PROTOCOLS.items():
            scores = score_plan(plan, driven, obstacles, protocol)
            self._l2_m[name] += scores.l2_m.sum(dim=0).cpu()
            kinds = (scores.collision, scores.collision_centre, scores.driven_collision)
            self._collisions[name] += torch.stack([kind.sum(dim=0) for kind in kinds]).cpu()
            self._frames[name] += int(scores.counted.sum())
            self._frames_with_boxes[name] += int(scores.collision_counted.sum())
        if scores is not None:
            self._frames_invalid += int((scores.planned & ~scores.complete).sum())

    def figures(self, prefix: str) -> Figures:
        """`PREFIX.PROTOCOL.l2_1s_m` and so on; NaN where nothing could be counted."""
        out: Figures = {}
        for name in PROTOCOLS:
            key = f"{prefix}.{name}"
            out |= _by_horizon(f"{key}.l2", "m", self._l2_m[name] / self._frames[name])
            shares = 100 * self._collisions[name] / self._frames_with_boxes[name]
            kinds = ("collision", "collision_centre", "driven_collision")
            for kind, share in zip(kinds, shares, strict=True):
                out |= _by_horizon(f"{key}.{kind}", "pct", share)
            out[f"{key}.frames_counted"] = self._frames[name]
            out[f"{key}.frames_invalid"] = self._frames_invalid
            out[f"{key}.frames_without_boxes"] = self._frames[name] - self._frames_with_boxes[name]
        return out


def _by_horizon(key: str, unit: str, values: Tensor) -> Figures:
    out: Figures = {f"{key}_{h}_{unit}": float(v) for h, v in zip(HORIZON_NAMES, values, strict=True)}
    return out | {f"{key}_avg_{unit}": float(values.mean())}


class OccupancyTotals:
    """Occupancy of a model, of the best constant and of copies of the model's own present, over all voxels
    and over those above the ground."""

    def __init__(self, spec: VoxelSpec, frames: int, frame_dt_s: float, prior: VoxelPrior | None) -> None:
        if prior is not None and len(prior.occupied) != frames:
            raise InputError(
                f"the voxel prior is for {len(prior.occupied)} frames, the model predicts {frames}"
            )
        self._names = frame_names(frames, frame_dt_s)
        self._regions = {"": None, "above_ground.": above_ground(spec)}
        self._constants = {
            scope: prior.best_constant(region) for scope, region in self._regions.items() if prior is not None
        }
        self._counts: dict[tuple[str, str], OccupancyCounts] = {}

    def add(self, predicted: Tensor, labels: VoxelGrid, T_world_ego: Tensor) -> None:
        """Compare a batch of predicted occupancy (bool [b F Z Y X]) with labels [b F 1 Z Y X].

        Args:
            T_world_ego: of the frames, driven: by them the predicted present is carried into the future.
        """
        said = {"": predicted} | _copies(predicted, T_world_ego, labels.spec)
        for scope, region in self._regions.items():
            for suffix, occupied in said.items():
                self._add(scope, suffix, count_occupancy(occupied, labels, region))
            if scope in self._constants:
                constant = self._constants[scope][0].to(predicted.device).expand_as(predicted)
                self._add(scope, ".best_constant", count_occupancy(constant, labels, region))

    def _add(self, scope: str, suffix: str, counts: OccupancyCounts) -> None:
        so_far = self._counts.get((scope, suffix))
        self._counts[scope, suffix] = counts if so_far is None else so_far + counts

    def figures(self, prefix: str) -> Figures:
        """`PREFIX.iou_now`, `PREFIX.above_ground.iou_now.best_constant`, `PREFIX.iou_future_1s.copy` …"""
        out: Figures = {}
        for (scope, suffix), counts in self._counts.items():
            copied = suffix in COPIES
            for kind in ("iou",) if copied else ("iou", "precision", "recall"):
                for name, value in zip(self._names, getattr(counts, kind).tolist(), strict=True):
                    if not (copied and name == "now"):
                        out[f"{prefix}.{scope}{kind}_{name}{suffix}"] = value
        for scope, (_, thresholds) in self._constants.items():
            for name, value in zip(self._names, thresholds.tolist(), strict=True):
                out[f"{prefix}.{scope}iou_{name}.best_constant_threshold"] = value
        return out


def _copies(predicted: Tensor, T_world_ego: Tensor, spec: VoxelSpec) -> dict[str, Tensor]:
    """The predicted present in place of the predicted future: as it is, and as if nothing but the ego
    vehicle moved, whose driven path is given away."""
    frames = predicted.shape[1]
    if frames == 1:
        return {}
    now = predicted[:, 0]
    T_now_frame = inverse_se3(T_world_ego[:, :1]) @ T_world_ego
    carried = [carried_along(now, T_now_frame[:, k], spec) for k in range(frames)]
    return dict(zip(COPIES, (now[:, None].expand_as(predicted), torch.stack(carried, dim=1)), strict=True))


class FuturesTotals:
    """Futures drawn by chance: the best of K, all of them, and how far they are apart."""

    def __init__(self, spec: VoxelSpec, count: int, frames: int, frame_dt_s: float) -> None:
        self._count, self._names = count, frame_names(frames + 1, frame_dt_s)[1:]
        self._regions = {"": None, "above_ground.": above_ground(spec)}
        self._counts: dict[str, FuturesCounts] = {}

    def add(self, futures: Tensor, labels: VoxelGrid) -> None:
        """Compare futures [b K P Z Y X] with labels [b P 1 Z Y X] of the same frames."""
        for scope, region in self._regions.items():
            counts = count_futures(futures, labels, region)
            so_far = self._counts.get(scope)
            self._counts[scope] = counts if so_far is None else so_far + counts

    def figures(self, prefix: str) -> Figures:
        """`PREFIX.iou_future_1s.best_of_5`, `….mean_of_5` and `PREFIX.spread_future_1s`."""
        out: Figures = {}
        for scope, counts in self._counts.items():
            spread = counts.spread / counts.items
            columns = (counts.best.iou.tolist(), counts.mean.iou.tolist(), spread.tolist())
            for name, best, mean, apart in zip(self._names, *columns, strict=True):
                key = f"{prefix}.{scope}iou_{name}"
                out |= {f"{key}.best_of_{self._count}": best, f"{key}.mean_of_{self._count}": mean}
                out[f"{prefix}.{scope}spread_{name}"] = apart
        return out


class FlowTotals:
    """End-point errors on moving voxels, against predicting no motion."""

    def __init__(self, frames: int, frame_dt_s: float) -> None:
        self._names = frame_names(frames, frame_dt_s)
        self._errors: FlowErrors | None = None

    def add(self, predicted_mps: Tensor, labels: VoxelGrid) -> None:
        """Compare predicted flow [b F 3 Z Y X] with labels of the same frames."""
        errors = flow_errors(predicted_mps, labels)
        self._errors = errors if self._errors is None else self._errors + errors

    def figures(self, prefix: str) -> Figures:
        """`PREFIX.epe_moving_now_mps` and `PREFIX.epe_moving_now_mps.no_motion`."""
        if self._errors is None:
            return {}
        out: Figures = {}
        for k, name in enumerate(self._names):
            voxels = self._errors.voxels[k]
            out[f"{prefix}.epe_moving_{name}_mps"] = float(self._errors.error_mps[k] / voxels)
            out[f"{prefix}.epe_moving_{name}_mps.no_motion"] = float(self._errors.speed_mps[k] / voxels)
        return out


class ImageTotals:
    """PSNR and SSIM, averaged over images."""

    def __init__(self, frames: int, frame_dt_s: float) -> None:
        self._names = frame_names(frames, frame_dt_s)
        self._sums = torch.zeros(frames, 2, dtype=torch.float64)
        self._images = torch.zeros(frames, 1, dtype=torch.int64)

    def add(self, rendered: Tensor, known: Tensor | None, stride: int, clip: Clip) -> None:
        """Compare rendered views [b F C 3 h w] with the images of the clip's frames from now on."""
        frames = slice(clip.now, clip.now + rendered.shape[1])
        real = clip.images[:, frames, :, :, stride // 2 :: stride, stride // 2 :: stride].float() / 255
        shown = clip.image_valid[:, frames, :, None, None].expand_as(real[:, :, :, 0])
        known = shown if known is None else known & shown
        for k in range(rendered.shape[1]):
            there = known[:, k].flatten(2).any(dim=-1)  # [b, C]
            views = (rendered[:, k][there], real[:, k][there], known[:, k][there])
            scores = torch.stack([psnr_db(*views), ssim(*views)], dim=-1)
            self._sums[k] += scores.double().sum(dim=0).cpu()
            self._images[k] += len(scores)

    def figures(self, prefix: str) -> Figures:
        """`PREFIX.psnr_db` and `PREFIX.ssim` at now, `PREFIX.future_1s.psnr_db` and so on after it."""
        out: Figures = {}
        for name, (psnr, similarity) in zip(self._names, (self._sums / self._images).tolist(), strict=True):
            key = prefix if name == "now" else f"{prefix}.{name}"
            out |= {f"{key}.psnr_db": psnr, f"{key}.ssim": similarity}
        return out
