"""Occupancy now and in the future, beside the occupancy prior and persistence."""

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from foredrive.errors import InputError
from foredrive.geometry.se3 import inverse_se3
from foredrive.scene import Clip, Example, VoxelGrid, VoxelSpec, last_frames
from foredrive.scene.ego_motion import continued_motion
from foredrive.scene.voxels import MOVING_MPS
from foredrive.tasks.metric import (
    CEILING,
    PRIOR,
    EvaluationContext,
    Figures,
    Shown,
    labels_from_now,
)
from foredrive.tasks.occupancy.forecasts import carried_by_flow, ego_compensated, swept_by_motion
from foredrive.tasks.occupancy.scores import OccupancyCounts, above_ground, count_occupancy
from foredrive.tasks.predictor import Part, Prediction

PERSISTENCE, EGO_COMPENSATED, CONTINUED = ".copy", ".carried_copy", ".continued_copy"
"""Suffixes of persistence: the predicted present in place of the future, the same moved along the driven
path, and the same moved as if the vehicle went on as measured. The last uses all that a model knows."""
PERSISTENT = (PERSISTENCE, EGO_COMPENSATED, CONTINUED)


class OccupancyMetric:
    """IoU, precision and recall over all voxels and over those above the ground; IoU alone of persistence.

    Keys: `iou_now`, `above_ground.iou_now.best_constant`, `iou_future_1s.copy` and so on. `moving.iou_now`
    is over the voxels above the ground that moving things fill at the frames up to then, and their
    neighbours, `standing.` over the others; frames whose flow is unknown count in neither. `….ceiling` is the
    true present, moved along with its true flow and the driven path: about the best that a forecast can do
    which moves the present. It is given where all occupancy and its flow are known.
    """

    name = "occupancy"
    title = "Occupancy"
    shown: tuple[Shown, ...] = ()
    needs: frozenset[Part] = frozenset({"occupancy_logit"})

    def __init__(self, context: EvaluationContext) -> None:
        self._context = context
        self._regions: dict[str, Tensor | None] = {}
        self._priors: dict[str, tuple[Tensor, Tensor]] = {}
        self._counts: dict[tuple[str, str], OccupancyCounts] = {}
        self._exact = True
        """True while all occupancy at now, and its flow, are known in every clip: the ceiling needs them."""

    def update(self, prediction: Prediction, truth: Example) -> None:
        """Count hits and misses of b clips.

        Raises:
            InputError: if the clips or the occupancy prior have other frames than the prediction.
        """
        assert prediction.occupancy_logit is not None
        # A positive logit is a probability above 1/2
        predicted, clip = prediction.occupancy_logit > 0, truth.clip
        frames = predicted.shape[1]
        labels = labels_from_now(truth.occupancy, clip, frames)
        if not self._regions:
            self._begin(labels.spec, frames)
        flow = labels_from_now(truth.flow, clip, frames)
        occupied = labels.values[:, :, 0] > 0.5
        # Driven poses relative to now
        T_world_ego = clip.T_world_ego[:, clip.now : clip.now + frames]
        T_now_ego = inverse_se3(T_world_ego[:, :1]) @ T_world_ego
        shown = {"": predicted}
        if frames > 1:
            shown[PERSISTENCE] = predicted[:, :1].expand_as(predicted)
            shown[EGO_COMPENSATED] = _moved(predicted[:, 0], T_now_ego, labels.spec)
            # A clip without past frames has no measured motion to continue
            if clip.now > 0:
                continued = _continued_path(clip, frames - 1)
                shown[CONTINUED] = _moved(predicted[:, 0], continued, labels.spec)
            self._exact &= bool(labels.known[:, 0].all() & (flow.known | ~occupied)[:, 0].all())
            if self._exact:
                t_s = clip.t_s[:, clip.now : clip.now + frames].double()
                shown[f".{CEILING}"] = _carried(labels, flow, T_now_ego, t_s - t_s[:, :1])
        # What moves, and what stands
        moving = occupied & flow.known & (flow.values.norm(dim=2) > MOVING_MPS)
        swept = swept_by_motion(moving, T_now_ego, labels.spec)
        annotated = flow.known.flatten(2).any(-1)[..., None, None, None]
        above = above_ground(labels.spec).to(swept.device) & annotated
        regions = {**self._regions, "moving.": above & swept, "standing.": above & ~swept}
        for scope, region in regions.items():
            priors = {}
            if scope in self._priors:
                priors[f".{PRIOR}"] = self._priors[scope][0].to(predicted.device).expand_as(predicted)
            for suffix, voxels in (shown | priors).items():
                counts = count_occupancy(voxels, labels, region)
                key = (scope, suffix)
                self._counts[key] = self._counts[key] + counts if key in self._counts else counts

    def _begin(self, spec: VoxelSpec, frames: int) -> None:
        """Prepare what does not change from batch to batch."""
        prior = self._context.prior
        if prior is not None and len(prior.occupied) != frames:
            raise InputError(
                f"the occupancy prior is for {len(prior.occupied)} frames, the model predicts {frames}"
            )
        self._regions = {"": None, "above_ground.": above_ground(spec)}
        if prior is not None:
            self._priors = {scope: prior.best_grid(region) for scope, region in self._regions.items()}

    def result(self) -> Figures:
        """Return the ratios of the sums, and the thresholds at which the prior is cut."""
        out: Figures = {}
        for (scope, suffix), counts in self._counts.items():
            if suffix == f".{CEILING}" and not self._exact:
                continue
            names = self._context.frame_names(len(counts.iou))
            # At now, persistence is the prediction itself, and the ceiling the truth: both are left out
            persists = suffix in (*PERSISTENT, f".{CEILING}")
            for kind in ("iou",) if persists else ("iou", "precision", "recall"):
                for name, value in zip(names, getattr(counts, kind).tolist(), strict=True):
                    if not (persists and name == "now"):
                        out[f"{scope}{kind}_{name}{suffix}"] = value
        for scope, (_, thresholds) in self._priors.items():
            names = self._context.frame_names(len(thresholds))
            for name, value in zip(names, thresholds.tolist(), strict=True):
                out[f"{scope}iou_{name}.{PRIOR}_threshold"] = value
        return out


def _moved(
    now: Bool[Tensor, "b Z Y X"], T_now_ego: Float64[Tensor, "b F 4 4"], spec: VoxelSpec
) -> Bool[Tensor, "b F Z Y X"]:
    """Return the present occupancy as seen from F poses."""
    frames = [ego_compensated(now, T_now_ego[:, k], spec) for k in range(T_now_ego.shape[1])]
    return torch.stack(frames, dim=1)


def _carried(
    labels: VoxelGrid,
    flow: VoxelGrid,
    T_now_ego: Float64[Tensor, "b F 4 4"],
    after_s: Float64[Tensor, "b F"],
) -> Bool[Tensor, "b F Z Y X"]:
    """Return the true present as seen from F poses at later times, moved along with its true flow."""
    now, velocity = labels.values[:, 0, 0] > 0.5, flow.values[:, 0]
    frames = [
        carried_by_flow(now, velocity, T_now_ego[:, k], after_s[:, k], labels.spec)
        for k in range(T_now_ego.shape[1])
    ]
    return torch.stack(frames, dim=1)


def _continued_path(clip: Clip, steps: int) -> Float64[Tensor, "b F 4 4"]:
    """Return the poses now and at the next key frames if the vehicle goes on as measured, F = steps + 1."""
    # Poses accumulate step by step
    T = [torch.eye(4, dtype=torch.float64, device=clip.t_s.device).expand(len(clip.t_s), 4, 4)]
    for T_prev_next in continued_motion(last_frames(clip.observed(), 1), steps).double().unbind(dim=1):
        T.append(T[-1] @ T_prev_next)
    return torch.stack(T, dim=1)
