"""Recall of the columns that hold a car, in the predicted occupancy of now."""

import torch

from foredrive.evaluation.metric import EvaluationContext, Figures, labels_from_now
from foredrive.evaluation.predictor import Part, Prediction
from foredrive.metrics.vehicles import count_car_columns, count_found_columns
from foredrive.scene import Example

RANGES_M = (10.0, 20.0, 30.0)


class VehicleMetric:
    """Keys: `car_recall_20m` and so on; `car_columns_20m`, the number of columns counted; and
    `column_precision_20m`, the share of truly occupied ones among all predicted columns.

    Clips whose present frame is not annotated are left out.
    """

    name = "vehicles"
    needs: frozenset[Part] = frozenset({"occupancy_logit"})

    def __init__(self, context: EvaluationContext) -> None:
        self._hits = torch.zeros(len(RANGES_M), dtype=torch.long)
        self._columns = torch.zeros_like(self._hits)
        self._true, self._found = torch.zeros_like(self._hits), torch.zeros_like(self._hits)

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
        true, found = count_found_columns(
            prediction.occupancy_logit[annotated, 0] > 0, labels[annotated], torch.tensor(RANGES_M)
        )
        self._true += true
        self._found += found

    def result(self) -> Figures:
        """Return the figures by range; NaN where no column holds a car or is predicted."""
        out: Figures = {}
        for k, limit_m in enumerate(RANGES_M):
            out[f"car_recall_{limit_m:.0f}m"] = float(self._hits[k] / self._columns[k])
            out[f"car_columns_{limit_m:.0f}m"] = int(self._columns[k])
            out[f"column_precision_{limit_m:.0f}m"] = float(self._true[k] / self._found[k])
        return out
