"""Targets of the task heads for one frame, made from its boxes and its task truth."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.geometry.polylines import arc_lengths, points_at
from foredrive.heads.agents_head import AGENT_CLASSES
from foredrive.heads.map_losses import equivalent_orders
from foredrive.scene import Boxes, Category, VoxelSpec
from foredrive.scene.agent_futures import AgentFutures
from foredrive.scene.map_elements import MapElements
from foredrive.scene.record import Record
from foredrive.sets import LabelledBoxes

_LABELS = torch.full((len(Category),), -1)
_LABELS[list(AGENT_CLASSES)] = torch.arange(len(AGENT_CLASSES))


@dataclass(frozen=True)
class AgentTargets(Record):
    """The N road users of one frame that a head shall find."""

    boxes: LabelledBoxes
    """Labels are indices into `AGENT_CLASSES`."""
    track_id: Int[Tensor, "N"]
    velocity: Float[Tensor, "N 2"]
    """NaN where unknown."""
    attribute: Int[Tensor, "N"]
    future_xy: Float[Tensor, "N S 2"]
    future_valid: Bool[Tensor, "N S"]


@dataclass(frozen=True)
class MapTargets(Record):
    """The N map elements of one frame that a head shall find."""

    kind: Int[Tensor, "N"]
    orders: Float[Tensor, "N O P 2"]
    """Points at equal distances in every equivalent order, m."""


def agent_targets(boxes: Boxes, futures: AgentFutures | None, spec: VoxelSpec, steps: int) -> AgentTargets:
    """Return the targets of an unbatched frame.

    These are the boxes of the detected classes above the grid, except those without a lidar point, which
    nuScenes counts neither in training nor in evaluation. Without futures, no step is valid.
    """
    # Road users above the grid, of a detected class, with at least one lidar point or an unknown number
    label = _LABELS.to(boxes.category.device)[boxes.category]
    kept = boxes.valid & spec.covers(boxes.centre) & (label >= 0) & (boxes.num_points != 0)
    # Log sizes need positive sizes
    state = torch.cat([boxes.centre, boxes.size_lwh.clamp_min(1e-2).log()], dim=-1)
    count = int(kept.sum())
    xy, valid = boxes.centre.new_zeros(count, steps, 2), kept.new_zeros(count, steps)
    if futures is not None:
        rows = kept[: len(futures.valid)]  # a batch may pad boxes and futures to different lengths
        total = int(rows.sum())
        xy[:total] = futures.xy[: len(rows), :steps][rows]  # no steps for a head without forecasts
        valid[:total] = futures.valid[: len(rows), :steps][rows]
    return AgentTargets(
        boxes=LabelledBoxes(label[kept], state[kept], boxes.yaw[kept]),
        track_id=boxes.track_id[kept],
        velocity=boxes.velocity[kept],
        attribute=boxes.attribute[kept],
        future_xy=xy,
        future_valid=valid,
    )


def map_targets(elements: MapElements, kinds: int, points: int) -> MapTargets:
    """Return the elements of the first `kinds` kinds of an unbatched frame, with `points` points each."""
    wanted = ((elements.kind >= 0) & (elements.kind < kinds)).nonzero()[:, 0].tolist()
    # All orders of points that describe the same element: reversals, and starts of a closed line
    orders = elements.vertices.new_zeros(len(wanted), 2 * (points - 1), points, 2)
    for row, element in enumerate(wanted):
        line = elements.vertices[element, elements.valid[element]].double().cpu().numpy()
        even = torch.from_numpy(even_points(line, points)).to(orders)
        orders[row] = equivalent_orders(even)
    return MapTargets(elements.kind[wanted], orders)


def even_points(line: Float[np.ndarray, "V 2"], points: int) -> Float[np.ndarray, "P 2"]:
    """Return points at equal distances along a polyline, its ends included. A closed one stays closed."""
    arc_m = arc_lengths(line)
    resampled = points_at(line, arc_m, np.linspace(0.0, arc_m[-1], points))
    # Ends that meet in the line also meet exactly in the samples
    if math.isclose(0.0, float(np.abs(line[0] - line[-1]).max()), abs_tol=1e-9):
        resampled[-1] = resampled[0]
    return resampled
