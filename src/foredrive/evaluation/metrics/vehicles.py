"""Recall of the columns that hold a car, in the predicted occupancy of now."""

import torch

from foredrive.evaluation.metric import EvaluationContext, Figures, labels_from_now
from foredrive.evaluation.predictor import Part, Prediction
from foredrive.metrics.vehicles import count_car_columns
from foredrive.scene import Example

RANGES_M = (10.0, 20.0, 30.0)


class VehicleMetric:
    """Keys: `car_recall_20m` and so on, and `car_columns_20m`, the number of columns counted.

    Clips whose present frame is not annotated are left out.
    """

    name = "vehicles"
    needs: frozenset[Part] = frozenset({"occupancy_logit"})

    def __init__(self, context: EvaluationContext) -> None:
        self._hits = torch.zeros(len(RANGES_M), dtype=torch.long)
        self._columns = torch.zeros_like(self._hits)

    def update(self, prediction: Prediction, truth: Example) -> None:
        """Count the columns of b clips."""
        assert prediction.occupancy_logit is not None
        clip = truth.clip
        boxes, labels = clip.boxes[:, clip.now], labels_from_now(truth.occupancy, clip, 1)[:, 0]
        annotated = clip.boxes_valid[:, clip.now]
        hits, columns = count_car_columns(
            prediction.occupancy_logit[annotated, 0] > 0,
            boxes[annotated],
            labels[annotated],
            torch.tensor(RANGES_M),
        )
        self._hits += hits
        self._columns += columns

    def result(self) -> Figures:
        """Return recall and number of columns by range; NaN where no column holds a car."""
        out: Figures = {}
        for limit_m, hits, columns in zip(RANGES_M, self._hits, self._columns, strict=True):
            out[f"car_recall_{limit_m:.0f}m"] = float(hits / columns)
            out[f"car_columns_{limit_m:.0f}m"] = int(columns)
        return out
