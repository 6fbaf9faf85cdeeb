"""Plans under every open-loop protocol."""

import torch
from torch import Tensor

from foredrive.scene import Example
from foredrive.tasks.metric import EvaluationContext, Figures, Shown
from foredrive.tasks.planning.obstacles import future_obstacles
from foredrive.tasks.planning.protocols import HORIZON_NAMES, PROTOCOLS, STEP_S, STEPS
from foredrive.tasks.planning.scores import score_plan
from foredrive.tasks.predictor import Part, Prediction

COLLISIONS = ("collision", "collision_centre", "driven_collision")


class PlanningMetric:
    """L2 and collisions. Keys: `PROTOCOL.l2_1s_m`, `PROTOCOL.collision_avg_pct`, `PROTOCOL.frames_counted`.

    For collisions up to 3 s the clips need boxes of the six key frames after now.
    """

    name = "planning"
    title = "Planning"
    shown: tuple[Shown, ...] = ()
    needs: frozenset[Part] = frozenset({"plan"})

    def __init__(self, context: EvaluationContext) -> None:
        horizons = len(HORIZON_NAMES)
        self._l2_m = {name: torch.zeros(horizons, dtype=torch.float64) for name in PROTOCOLS}
        self._collisions = {
            name: torch.zeros(len(COLLISIONS), horizons, dtype=torch.float64) for name in PROTOCOLS
        }
        self._frames = dict.fromkeys(PROTOCOLS, 0)
        self._frames_with_boxes = dict.fromkeys(PROTOCOLS, 0)
        self._frames_invalid = 0

    def update(self, prediction: Prediction, truth: Example) -> None:
        """Score the plans of b clips."""
        assert prediction.plan is not None
        driven = truth.clip.future
        # Boxes of the future, in the ego frame at now
        obstacles = future_obstacles(truth.clip, STEPS, STEP_S)
        invalid = 0
        for name, protocol in PROTOCOLS.items():
            scores = score_plan(prediction.plan, driven, obstacles, protocol)
            # Sums over frames; means are taken at the end
            self._l2_m[name] += scores.l2_m.sum(dim=0).cpu()
            kinds = [getattr(scores, kind).sum(dim=0) for kind in COLLISIONS]
            self._collisions[name] += torch.stack(kinds).cpu()
            self._frames[name] += int(scores.counted.sum())
            self._frames_with_boxes[name] += int(scores.collision_counted.sum())
            invalid = int(
                (scores.plan_complete & ~scores.future_complete).sum()
            )  # the same under every protocol
        self._frames_invalid += invalid

    # Frames with boxes are fewer than frames with a driven path
    def result(self) -> Figures:
        """Return the means over counted frames."""
        out: Figures = {}
        for name in PROTOCOLS:
            out |= _by_horizon(f"{name}.l2", "m", self._l2_m[name] / self._frames[name])
            shares = 100 * self._collisions[name] / self._frames_with_boxes[name]
            for kind, share in zip(COLLISIONS, shares, strict=True):
                out |= _by_horizon(f"{name}.{kind}", "pct", share)
            out[f"{name}.frames_counted"] = self._frames[name]
            out[f"{name}.frames_invalid"] = self._frames_invalid
            out[f"{name}.frames_without_boxes"] = self._frames[name] - self._frames_with_boxes[name]
        return out


def _by_horizon(key: str, unit: str, values: Tensor) -> Figures:
    out: Figures = {f"{key}_{h}_{unit}": float(v) for h, v in zip(HORIZON_NAMES, values, strict=True)}
    return out | {f"{key}_avg_{unit}": float(values.mean())}
