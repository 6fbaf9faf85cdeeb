"""Forecasts of detected road users under every protocol, beside constant velocity."""

import dataclasses

import numpy as np
import torch
from jaxtyping import Float64
from numpy import ndarray
from torch import Tensor

from foredrive.scene import Example
from foredrive.tasks.metric import STEADY, EvaluationContext, Figures, Shown
from foredrive.tasks.motion.agents import PredictedAgents, TrueAgents
from foredrive.tasks.motion.protocols import PROTOCOLS, STEP_S
from foredrive.tasks.motion.scores import score_motion
from foredrive.tasks.objects.in_world import futures_in_world, levelled
from foredrive.tasks.predictor import Part, Prediction

FIGURES = ("min_ade_m", "min_fde_m", "miss_rate", "epa")
_PREDICTED = tuple(field.name for field in dataclasses.fields(PredictedAgents))
_TRUE = tuple(field.name for field in dataclasses.fields(TrueAgents))


class MotionMetric:
    """Keys: `uniad.car.min_ade_m`, `uniad.car.min_ade_m.constant_velocity`, `uniad.car.matched` and so on.

    The baseline moves the same detections by their predicted velocities. Frames without annotation do not
    count, and neither do forecasts in other steps than 0.5 s.
    """

    name = "motion"
    title = "Motion"
    shown: tuple[Shown, ...] = (
        Shown("UniAD, minADE of cars, m", "uniad.car.min_ade_m", STEADY),
        Shown("UniAD, EPA of cars", "uniad.car.epa", STEADY),
        Shown("UniAD, minADE of people, m", "uniad.pedestrian.min_ade_m", STEADY),
    )
    needs: frozenset[Part] = frozenset({"agents"})

    def __init__(self, context: EvaluationContext) -> None:
        self._predicted: list[dict[str, ndarray]] = []
        self._true: list[dict[str, ndarray]] = []
        self._steady: list[ndarray] = []

    def update(self, prediction: Prediction, truth: Example) -> None:
        """Add b clips; those without forecasts or without futures are left out."""
        agents, clip = prediction.agents, truth.clip
        if agents is None or agents.future_xy is None or truth.truth is None or truth.truth.futures is None:
            return
        if agents.dt_s != STEP_S or truth.truth.futures.dt_s != STEP_S:
            return
        for item in clip.boxes_valid[:, clip.now].nonzero()[:, 0].tolist():
            predicted, frame = agents[item].to("cpu"), len(self._true)
            assert predicted.future_xy is not None
            assert predicted.log_prob is not None
            t_s = STEP_S * torch.arange(1, predicted.future_xy.shape[-2] + 1)
            # Baseline: the same detections moved by their predicted velocities
            steady = predicted.centre[:, None, :2] + predicted.velocity[:, None] * t_s[:, None]
            pose = clip.T_world_ego[item, clip.now].cpu().numpy()
            self._steady.append(_placed(steady[:, None], predicted.centre, pose))
            self._predicted.append(
                {
                    "frame": np.full(len(predicted.score), frame),
                    "category": predicted.category.numpy(),
                    "score": predicted.score.double().numpy(),
                    "xy": _placed(predicted.centre[:, :2], predicted.centre, pose),
                    "future_xy": _placed(predicted.future_xy, predicted.centre, pose),
                    "probability": predicted.log_prob.double().exp().numpy(),
                }
            )
            boxes, futures = clip.boxes[item, clip.now].to("cpu"), truth.truth.futures[item].to("cpu")
            # A batch may pad boxes and futures to different lengths
            rows = min(len(boxes.valid), len(futures.valid))
            valid = boxes.valid[:rows]
            boxes, futures = boxes[:rows][valid], futures[:rows][valid]
            self._true.append(
                {
                    "frame": np.full(len(boxes.valid), frame),
                    "category": boxes.category.numpy(),
                    "xy": _placed(boxes.centre[:, :2], boxes.centre, pose),
                    "future_xy": _placed(futures.xy, boxes.centre, pose),
                    "future_valid": futures.valid.numpy(),
                    "seen": (boxes.num_points != 0).numpy(),
                }
            )

    def result(self) -> Figures:
        """Return the figures of every protocol that the horizon suffices for."""
        if not self._true:
            return {}
        predicted = PredictedAgents(*(_column(self._predicted, name) for name in _PREDICTED))
        true = TrueAgents(*(_column(self._true, name) for name in _TRUE))
        steady = dataclasses.replace(
            predicted,
            future_xy=np.concatenate(self._steady),
            probability=np.ones((len(predicted.frame), 1)),
        )
        # Protocols that judge more steps than are known are left out
        horizon = min(predicted.future_xy.shape[2], true.future_xy.shape[1])
        out: Figures = {"frames_counted": len(self._true)}
        for name, protocol in PROTOCOLS.items():
            if protocol.steps > horizon:
                continue
            for suffix, forecasts in (("", predicted), (f".{STEADY}", steady)):
                for kind, scores in score_motion(forecasts, true, protocol).items():
                    out |= {f"{name}.{kind}.{key}{suffix}": getattr(scores, key) for key in FIGURES}
                    if not suffix:
                        out[f"{name}.{kind}.matched"] = scores.matched
        return out


def _placed(xy: Tensor, centre: Tensor, T_world_ego: ndarray) -> Float64[ndarray, "n *s 2"]:
    """Return places of the ego frame over ground, as files state them: without pitch and roll of the ego."""
    world = futures_in_world(xy.double().numpy(), centre.double().numpy(), T_world_ego)
    return levelled(world, T_world_ego)


def _column(rows: list[dict[str, ndarray]], name: str) -> ndarray:
    return np.concatenate([row[name] for row in rows])
