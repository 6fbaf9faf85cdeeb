"""Occupancy of vehicles over time under UniAD's protocol, beside detected boxes that drive on or stay.

IoU and video panoptic quality are counted from above, as UniAD does. The latter is that of FIERY (Hu et al.,
ICCV 2021) and its public code.
"""

from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Float64, Int
from numpy import ndarray
from torch import Tensor

from foredrive.data.truth.raster import fill_polygon
from foredrive.errors import InputError
from foredrive.geometry.boxes import box_corners
from foredrive.heads.plane import cell_middles
from foredrive.scene import Example, VoxelSpec
from foredrive.scene.agents import Agents
from foredrive.scene.boxes import VEHICLES
from foredrive.scene.map_elements import InstanceRaster
from foredrive.tasks.metric import CEILING, STEADY, EvaluationContext, Figures, Shown
from foredrive.tasks.occupancy.protocols import UNIAD_INSTANCES, InstanceProtocol
from foredrive.tasks.predictor import Part, Prediction


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
    shape = (1 + protocol.future_frames, protocol.cells, protocol.cells)
    for name, instances in (("predicted", predicted), ("true", true)):
        if instances.shape != shape:
            raise InputError(f"expected {name} instances of shape {shape}, got {instances.shape}")
        if instances.min() < 0:
            raise InputError(f"{name} instances have numbers below 0: {int(instances.min())}")
    return {
        name: _count_range(
            predicted[:, first:end, first:end], true[:, first:end, first:end], protocol.min_iou
        )
        for name, (first, end) in protocol.ranges.items()
    }


def count_rasters(
    predicted: Int[Tensor, "b S Y X"], truth: InstanceRaster, past_frames: int, protocol: InstanceProtocol
) -> dict[str, InstanceCounts]:
    """Count the samples of a batch that the protocol counts, in each range; empty if it counts none.

    Args:
        predicted: as for `count_instances`, on the grid of the truth.
        truth: vehicles [b S Y X] now and later.
        past_frames: number of key frames of the drives before now.
        protocol: of the truth's grid and steps.

    Raises:
        InputError: the truth has other steps or cells than those of the protocol.
    """
    if (truth.spec.cell_m, truth.dt_s) != (protocol.cell_m, protocol.step_s):
        raise InputError(
            f"{protocol.title} counts cells of {protocol.cell_m} m and steps of {protocol.step_s} s, "
            f"the truth has {truth.spec.cell_m} m and {truth.dt_s} s"
        )
    total: dict[str, InstanceCounts] = {}
    # Samples at the start of a drive do not count
    if past_frames < protocol.past_frames:
        return total
    # All future steps must be annotated
    for item in truth.valid.all(dim=1).nonzero().flatten().tolist():
        predicted_id, true = (part[item].cpu().numpy() for part in (predicted, truth.track_id))
        for name, counts in count_instances(predicted_id, true, protocol).items():
            total[name] = total[name] + counts if name in total else counts
    return total


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
        # Pairs with an IoU above 0.5 are unique in rows and columns
        predicted_id, true_id, iou = _ious(predicted_frame, true_frame)
        rows, columns = np.nonzero(iou > min_iou)
        false += len(predicted_id) - len(columns)
        missed += len(true_id) - len(rows)
        for row, column in zip(rows, columns, strict=True):
            instance, candidate = int(true_id[row]), int(predicted_id[column])
            # The first partner of an instance is remembered; a later
            # partner with another number is an error
            if partner.setdefault(instance, candidate) == candidate:
                pairs += 1
                iou_sum += float(iou[row, column])
            else:
                false, missed = false + 1, missed + 1
                partner[instance] = candidate
    # Cells count over all frames, whatever their instance
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
    # Numbers of instances, and the index of each cell's number
    predicted_id, predicted_at = np.unique(predicted, return_inverse=True)
    true_id, true_at = np.unique(true, return_inverse=True)
    # Joint histogram: cells of each pair of numbers
    pair = true_at.ravel() * len(predicted_id) + predicted_at.ravel()
    shared = np.bincount(pair, minlength=len(true_id) * len(predicted_id)).reshape(len(true_id), -1)
    # Union of a pair: both areas less the intersection
    either = shared.sum(axis=1, keepdims=True) + shared.sum(axis=0) - shared
    return (
        predicted_id[predicted_id > 0],
        true_id[true_id > 0],
        (shared / either)[np.ix_(true_id > 0, predicted_id > 0)],
    )


PERSISTENCE = "persistence"
MIN_SCORE = 0.3
"""Score of the detections that the baselines draw, the same as that of the head's agents."""


class InstanceMetric:
    """Keys: `uniad.iou_near_pct`, `uniad.vpq_far_pct`, `….constant_velocity`, `….persistence`.

    The baselines draw the same detections as boxes, moved at their predicted velocity, or left where they
    are. `….ceiling` is that of the true vehicles with a cell above the clips' voxels now. Frames without
    annotated future are skipped, as in UniAD; those at the start of a drive count here.
    """

    name = "occupancy"
    title = "Instances"
    shown: tuple[Shown, ...] = (
        Shown("UniAD, IoU near, %", "uniad.iou_near_pct", STEADY),
        Shown("UniAD, IoU far, %", "uniad.iou_far_pct", STEADY),
        Shown("UniAD, VPQ near, %", "uniad.vpq_near_pct", STEADY),
        Shown("UniAD, VPQ far, %", "uniad.vpq_far_pct", STEADY),
    )
    needs: frozenset[Part] = frozenset({"instances", "agents"})

    def __init__(self, context: EvaluationContext) -> None:
        self._counts: dict[tuple[str, str], InstanceCounts] = {}
        self._frames = 0

    def update(self, prediction: Prediction, truth: Example) -> None:
        """Add b clips."""
        true = None if truth.truth is None else truth.truth.instances
        if true is None or prediction.instances is None or prediction.agents is None:
            return
        true, agents = true.to("cpu"), prediction.agents.to("cpu")
        shown = {"": prediction.instances.cpu()}
        # Baselines: the same detections, moved or left where they are
        for name, moves in ((STEADY, 1.0), (PERSISTENCE, 0.0)):
            drawn = [drawn_boxes(agents[item], true, moves) for item in range(len(true.valid))]
            shown[f".{name}"] = torch.from_numpy(np.stack(drawn))
        shown[f".{CEILING}"] = seen_above(true, truth.occupancy.spec)
        past = UNIAD_INSTANCES.past_frames
        for suffix, raster in shown.items():
            for name, counts in count_rasters(raster, true, past, UNIAD_INSTANCES).items():
                key = (name, suffix)
                self._counts[key] = self._counts[key] + counts if key in self._counts else counts
        self._frames += int(true.valid.all(dim=1).sum())

    def result(self) -> Figures:
        """Return the figures over all frames with an annotated future."""
        out: Figures = {}
        for (name, suffix), counts in self._counts.items():
            out[f"uniad.iou_{name}_pct{suffix}"] = 100 * counts.iou
            out[f"uniad.vpq_{name}_pct{suffix}"] = 100 * counts.vpq
        return out | {"uniad.frames_counted": self._frames}


def seen_above(true: InstanceRaster, voxels: VoxelSpec) -> Int[Tensor, "b S Y X"]:
    """Return the vehicles that have a cell above a voxel grid now, with all of their cells."""
    spec = true.spec
    middle_m = cell_middles(spec.lower_m, spec.cell_m, spec.shape_yx)
    above = voxels.covers(middle_m).view(spec.shape_yx)
    shown = torch.zeros_like(true.track_id)
    for item, now in enumerate(true.track_id[:, 0]):
        vehicles = torch.isin(true.track_id[item], now[above].unique())
        shown[item] = true.track_id[item] * vehicles
    return shown


def drawn_boxes(agents: Agents, like: InstanceRaster, moves: float) -> Int[ndarray, "S Y X"]:
    """Draw unbatched vehicles as the truth is drawn, the best scored on top: number + 1 of the agent.

    Args:
        agents: detections.
        like: grid and steps of the truth.
        moves: share of the predicted velocity at which they move.
    """
    steps = like.track_id.shape[-3]
    drawn = np.zeros((steps, *like.spec.shape_yx), dtype=np.int32)
    kinds = torch.tensor(sorted(int(kind) for kind in VEHICLES))
    kept = (torch.isin(agents.category, kinds) & (agents.score >= MIN_SCORE)).nonzero()[:, 0]
    # Draw the best scored last, on top
    order = kept[agents.score[kept].argsort()]
    corners = box_corners(agents.centre, agents.size_lwh, agents.yaw)[:, :4, :2].double()
    # The footprint of each box moves by its velocity
    for step in range(steps):
        shift = moves * step * like.dt_s * agents.velocity.double()
        for row in order.tolist():
            quad = (corners[row] + shift[row]).numpy()
            fill_polygon([quad], row + 1, like.spec, drawn[step])
    return drawn
