"""IoU and VPQ of instances over time, seen from above, as UniAD counts them.

Video panoptic quality is that of FIERY (Hu et al., ICCV 2021) and its public code.
"""

import dataclasses
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int, Int64
from numpy import ndarray
from torch import Tensor

from foredrive.errors import InputError
from foredrive.metrics.footprint import box_quads, cells_in_quads
from foredrive.metrics.obstacles import boxes_at_now, future_obstacles
from foredrive.metrics.voxels.protocols import InstanceProtocol
from foredrive.scene import Boxes, Clip


@dataclass(frozen=True)
class InstanceCounts:
    """Counts of cells and of instances in frames, within one range. Those of samples add up."""

    cells_hit: int
    cells_false: int
    cells_missed: int
    pairs: int
    iou_sum: float
    """Of the pairs."""
    false: int
    missed: int

    def __add__(self, other: "InstanceCounts") -> "InstanceCounts":
        return InstanceCounts(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))

    @property
    def iou(self) -> float:
        """Intersection over union of the cells of all instances; NaN without any."""
        return _ratio(self.cells_hit, self.cells_hit + self.cells_false + self.cells_missed)

    @property
    def vpq(self) -> float:
        """Video panoptic quality: the pairs' IoU over pairs + false / 2 + missed / 2; NaN without any."""
        return _ratio(self.iou_sum, self.pairs + 0.5 * self.false + 0.5 * self.missed)


def _ratio(part: float | int, whole: float | int) -> float:
    return part / whole if whole > 0 else float("nan")


def count_instances(
    predicted: Int[ndarray, "T R C"], true: Int[ndarray, "T R C"], protocol: InstanceProtocol
) -> dict[str, InstanceCounts]:
    """Count one sample, now and its future frames, in each range of a protocol.

    Args:
        predicted: the instance of each cell, the same over time; 0 is none.
        true: likewise. Numbers of prediction and truth need not be related.

    Raises:
        InputError: negative numbers, other frames or cells than those of the protocol.
    """
    cells = round(2 * protocol.grid.reach_m / protocol.grid.cell_m)
    for name, instances in (("predicted", predicted), ("true", true)):
        if instances.shape != (1 + protocol.future_frames, cells, cells):
            raise InputError(
                f"expected {name} instances of shape {(1 + protocol.future_frames, cells, cells)}, "
                f"got {instances.shape}"
            )
        if instances.min() < 0:
            raise InputError(f"{name} instances have numbers below 0: {int(instances.min())}")
    return {
        name: _count_range(
            predicted[:, first:end, first:end], true[:, first:end, first:end], protocol.min_iou
        )
        for name, (first, end) in protocol.ranges.items()
    }


def _count_range(
    predicted: Int[ndarray, "T R C"], true: Int[ndarray, "T R C"], min_iou: float
) -> InstanceCounts:
    """Count one sample. A true instance keeps the number of its last partner over frames without any.

    Where a partner has another number, the pair is a false and a missed instance; from then on the new
    number is the right one.
    """
    pairs, iou_sum, false, missed = 0, 0.0, 0, 0
    partner: dict[int, int] = {}
    for predicted_frame, true_frame in zip(predicted, true, strict=True):
        predicted_id, true_id, iou = _ious(predicted_frame, true_frame)
        rows, columns = np.nonzero(iou > min_iou)
        false += len(predicted_id) - len(columns)
        missed += len(true_id) - len(rows)
        for row, column in zip(rows, columns, strict=True):
            instance, found = int(true_id[row]), int(predicted_id[column])
            if partner.setdefault(instance, found) == found:
                pairs += 1
                iou_sum += float(iou[row, column])
            else:
                false, missed = false + 1, missed + 1
                partner[instance] = found
    return InstanceCounts(
        cells_hit=int(((predicted > 0) & (true > 0)).sum()),
        cells_false=int(((predicted > 0) & (true == 0)).sum()),
        cells_missed=int(((predicted == 0) & (true > 0)).sum()),
        pairs=pairs,
        iou_sum=iou_sum,
        false=false,
        missed=missed,
    )


def _ious(
    predicted: Int[ndarray, "R C"], true: Int[ndarray, "R C"]
) -> tuple[Int[ndarray, "P"], Int[ndarray, "N"], Float64[ndarray, "N P"]]:
    """Return the numbers of predicted and of true instances, and their IoU."""
    predicted_id, predicted_at = np.unique(predicted, return_inverse=True)
    true_id, true_at = np.unique(true, return_inverse=True)
    pair = true_at.ravel() * len(predicted_id) + predicted_at.ravel()
    shared = np.bincount(pair, minlength=len(true_id) * len(predicted_id)).reshape(len(true_id), -1)
    either = shared.sum(axis=1, keepdims=True) + shared.sum(axis=0) - shared
    return (
        predicted_id[predicted_id > 0],
        true_id[true_id > 0],
        (shared / either)[np.ix_(true_id > 0, predicted_id > 0)],
    )


def true_instances(
    clip: Clip, protocol: InstanceProtocol
) -> tuple[Int64[Tensor, "b T R C"], Bool[Tensor, "b"]]:
    """Return the instances of annotated boxes, now and at the protocol's future frames, and what counts.

    An item counts if now and every future frame are annotated, and the clip shows as many key frames before
    now as the protocol asks for.
    """
    future = future_obstacles(clip, protocol.future_frames, protocol.step_s)
    now = boxes_at_now(clip)[:, clip.now : clip.now + 1]
    now = dataclasses.replace(now, valid=now.valid & future.annotated_now[:, None, None])
    cells = torch.cat([draw_instances(now, protocol), draw_instances(future.boxes, protocol)], dim=1)
    counted = future.annotated_now & future.annotated.all(dim=1)
    return cells, counted & (clip.now >= protocol.past_frames)


def draw_instances(boxes: Boxes, protocol: InstanceProtocol) -> Int64[Tensor, "b T R C"]:
    """Draw boxes [b T M], in the ego frame at now, as cells of their track number + 1; 0 is none.

    Rows count forward, columns as the protocol's grid has them. The cells are those of OpenCV's `fillPoly`
    with corners rounded to cells; a later box is drawn over an earlier one. Boxes of low visibility are drawn
    too, as in UniAD.
    """
    ahead = torch.tensor([protocol.point_forward_m, 0.0, 0.0]).to(boxes.centre)
    quads = box_quads(dataclasses.replace(boxes, centre=boxes.centre - ahead), protocol.grid)
    wanted = torch.tensor(sorted(protocol.categories), device=boxes.category.device)
    drawn = boxes.valid & torch.isin(boxes.category, wanted)
    last = round(2 * protocol.grid.reach_m / protocol.grid.cell_m) - 1
    out = torch.zeros((*boxes.valid.shape[:2], last + 1, last + 1), dtype=torch.int64, device=quads.device)
    for item, step, box in drawn.nonzero().tolist():
        quad = quads[item, step, box]
        low, high = quad.amin(dim=0).clamp_min(0), quad.amax(dim=0).clamp_max(last)
        if (low > high).any():
            continue
        cells = torch.cartesian_prod(*(torch.arange(a, b + 1) for a, b in zip(low, high, strict=True)))
        cells = cells[cells_in_quads(cells.to(quad)[None], quad[None])[0].cpu()]
        out[item, step, cells[:, 0], cells[:, 1]] = boxes.track_id[item, step, box] + 1
    return out
