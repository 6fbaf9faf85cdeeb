"""What a driver must see: the next light, the lead vehicle, people who will cross."""

from collections import Counter

import torch
from torch import Tensor

from foredrive.evaluation.metric import EvaluationContext, Figures
from foredrive.evaluation.predictor import Part, Prediction
from foredrive.metrics.affordances import LEAD_M, LIGHT_M, crossing_counts, lead_error_m, light_right
from foredrive.scene import Example
from foredrive.scene.traffic_light import LightState

FRONT_M = 1.64855 + 0.5 * 4.89238
"""Distance from the rear axle to the front bumper of the recording vehicle, m."""
NAN = float("nan")


class AffordanceMetric:
    """Keys: `light_accuracy_40m`, `lead_error_m`, `lead_recall`, `crossing_recall_20m`, and so on.

    `light_accuracy_40m.commonest` is the accuracy of always naming the commonest state within 40 m, and
    `false_lights` the share of the frames without a light within 60 m in which one is named. Frames whose
    logs do not tell do not count.
    """

    name = "affordances"
    needs: frozenset[Part] = frozenset({"affordances"})

    def __init__(self, context: EvaluationContext) -> None:
        self._counts = Counter[str]()
        self._states = Counter[int]()
        self._error_m: list[Tensor] = []
        self._error_mps: list[Tensor] = []
        self._light_error_m: list[Tensor] = []

    def update(self, prediction: Prediction, truth: Example) -> None:
        """Add b clips."""
        estimate, true = prediction.affordances, None if truth.truth is None else truth.truth.affordances
        if estimate is None or true is None:
            return
        counts = self._counts
        none = true.light == LightState.NONE
        near = true.light_known & ~none & (true.light_m <= LIGHT_M)
        named = estimate.light.argmax(-1) != LightState.NONE
        counts["lights"] += int(near.sum())
        counts["lights_right"] += int((light_right(estimate, true) & near).sum())
        counts["no_lights"] += int((true.light_known & none).sum())
        counts["lights_false"] += int((named & true.light_known & none).sum())
        self._states.update(true.light[near].tolist())
        self._light_error_m.append((estimate.light_m - true.light_m).abs()[near & named])
        lead, seen = true.lead_known & true.lead & (true.lead_m <= LEAD_M), estimate.lead >= 0.5
        counts["leads"] += int(lead.sum())
        counts["leads_found"] += int((lead & seen).sum())
        counts["leads_named"] += int((true.lead_known & seen).sum())
        counts["leads_right"] += int((true.lead_known & seen & true.lead).sum())
        self._error_m.append(lead_error_m(estimate, true)[lead])
        self._error_mps.append((estimate.lead_mps - true.lead_mps).abs()[lead & true.lead_mps.isfinite()])
        for key, value in vars(crossing_counts(estimate, true, FRONT_M)).items():
            counts[f"crossing_{key}"] += value

    def result(self) -> Figures:
        """Return the figures over all frames."""
        c = self._counts
        return {
            "light_accuracy_40m": _share(c["lights_right"], c["lights"]),
            "light_accuracy_40m.commonest": _share(max(self._states.values(), default=0), c["lights"]),
            "lights_counted": c["lights"],
            "false_lights": _share(c["lights_false"], c["no_lights"]),
            "light_error_m": _mean(self._light_error_m),
            "lead_recall": _share(c["leads_found"], c["leads"]),
            "lead_precision": _share(c["leads_right"], c["leads_named"]),
            "lead_error_m": _mean(self._error_m),
            "lead_error_mps": _mean(self._error_mps),
            "leads_counted": c["leads"],
            "crossing_recall_20m": _share(c["crossing_found"], c["crossing_true"]),
            "crossing_precision_20m": _share(c["crossing_right"], c["crossing_estimated"]),
            "crossing_counted": c["crossing_true"],
        }


def _share(count: int, of: int) -> float:
    return count / of if of else NAN


def _mean(errors: list[Tensor]) -> float:
    together = torch.cat(errors) if errors else torch.zeros(0)
    return float(together.mean()) if len(together) else NAN
