"""Recall of the columns that hold a car, in the predicted occupancy of now.

IoU hardly counts cars: they are few of the occupied voxels. A planner needs them most. A model that predicts
everything to be occupied has a recall of 1, so the precision of all predicted columns stands beside it.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.scene import Boxes, Category, Example, VoxelGrid, VoxelSpec
from foredrive.tasks.metric import EvaluationContext, Figures, Shown, labels_from_now
from foredrive.tasks.occupancy.scores import above_ground
from foredrive.tasks.predictor import Part, Prediction

CARS = (Category.CAR, Category.TRUCK, Category.BUS, Category.TRAILER, Category.CONSTRUCTION_VEHICLE)


def car_columns(boxes: Boxes, labels: VoxelGrid, range_m: float) -> Bool[Tensor, "b Y X"]:
    """Return the columns that hold a car: observed as occupied above the ground, and inside a car's box.

    A column is inside a box if the box, half a voxel wider on each side, contains its centre. The voxel of
    a return from a car's side is then inside.

    Args:
        boxes: [b] of one frame.
        labels: [b 1 Z Y X] of the same frame, on the same ego frame.
        range_m: maximum distance of the column's centre from the ego frame's origin.
    """
    spec = labels.spec
    # Columns that were observed as occupied above the ground
    observed = (labels.values[:, 0] > 0.5) & labels.known & above_ground(spec).to(labels.known.device)
    centre = spec.centres_m()[0, ..., :2].to(boxes.centre)  # [Y, X, 2]
    # Offset of each column from each box, turned to the box's axes
    offset = centre[:, :, None] - boxes.centre[:, None, None, :, :2]  # [b, Y, X, M, 2]
    cos, sin = boxes.yaw.cos()[:, None, None], boxes.yaw.sin()[:, None, None]
    along = cos * offset[..., 0] + sin * offset[..., 1]
    across = cos * offset[..., 1] - sin * offset[..., 0]
    # Half a voxel of margin on each side, so that returns from a car's side lie inside
    half = 0.5 * (boxes.size_lwh[:, None, None, :, :2] + spec.voxel_m)
    is_car = boxes.valid & torch.isin(boxes.category, torch.tensor(CARS).to(boxes.category))
    inside = (along.abs() <= half[..., 0]) & (across.abs() <= half[..., 1]) & is_car[:, None, None]
    return observed.any(1) & inside.any(-1) & (centre.norm(dim=-1) <= range_m)


def found_columns(predicted: Bool[Tensor, "b Z Y X"], spec: VoxelSpec) -> Bool[Tensor, "b Y X"]:
    """Return the columns with any predicted voxel above the ground."""
    return (predicted & above_ground(spec).to(predicted.device)).any(1)


def count_car_columns(
    predicted: Bool[Tensor, "b Z Y X"], boxes: Boxes, labels: VoxelGrid, range_m: Float[Tensor, "R"]
) -> tuple[Int[Tensor, "R"], Int[Tensor, "R"]]:
    """Return the numbers of found columns and of all columns that hold a car, within each range.

    Args:
        predicted: occupancy of one frame.
        boxes, labels: ground truth of that frame, see `car_columns`.
        range_m: maximum distances.
    """
    predicted_columns = found_columns(predicted, labels.spec)
    truth = [car_columns(boxes, labels, float(limit)) for limit in range_m]
    hits = torch.stack([(predicted_columns & columns).sum() for columns in truth])
    return hits.cpu(), torch.stack([columns.sum() for columns in truth]).cpu()


def count_found_columns(
    predicted: Bool[Tensor, "b Z Y X"], labels: VoxelGrid, range_m: Float[Tensor, "R"]
) -> tuple[Int[Tensor, "R"], Int[Tensor, "R"]]:
    """Return the numbers of truly occupied and of all predicted columns, within each range.

    Only voxels count that were observed: a column is predicted if one of its known voxels above the ground
    is, and truly occupied if one of them is occupied.

    Args:
        predicted: occupancy of one frame.
        labels: ground truth of that frame, [b 1 Z Y X].
        range_m: maximum distances of the columns' centres.
    """
    spec = labels.spec
    # Unobserved voxels count as not predicted
    predicted_columns = found_columns(predicted & labels.known, spec)
    true = found_columns((labels.values[:, 0] > 0.5) & labels.known, spec)
    near = spec.centres_m()[0, ..., :2].norm(dim=-1)[None] <= range_m[:, None, None]  # [R, Y, X]
    near = near.to(predicted_columns.device)
    hits = torch.stack([(predicted_columns & true & within).sum() for within in near])
    return hits.cpu(), torch.stack([(predicted_columns & within).sum() for within in near]).cpu()


RANGES_M = (10.0, 20.0, 30.0)


class VehicleMetric:
    """Keys: `car_recall_20m` and so on; `car_columns_20m`, the number of columns counted; and
    `column_precision_20m`, the share of truly occupied ones among all predicted columns.

    Clips whose present frame is not annotated are left out.
    """

    name = "vehicles"
    title = "Vehicles"
    shown: tuple[Shown, ...] = ()
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
        true, predicted_counts = count_found_columns(
            prediction.occupancy_logit[annotated, 0] > 0, labels[annotated], torch.tensor(RANGES_M)
        )
        self._true += true
        self._found += predicted_counts

    def result(self) -> Figures:
        """Return the figures by range; NaN where no column holds a car or is predicted."""
        out: Figures = {}
        for k, limit_m in enumerate(RANGES_M):
            out[f"car_recall_{limit_m:.0f}m"] = float(self._hits[k] / self._columns[k])
            out[f"car_columns_{limit_m:.0f}m"] = int(self._columns[k])
            out[f"column_precision_{limit_m:.0f}m"] = float(self._true[k] / self._found[k])
        return out
