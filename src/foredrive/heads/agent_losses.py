"""Losses of road users: of the dense map of centres, of the queries by the best matching, of their motion.

A carried query stays with the object that it was matched to.

The map of centres is that of CenterNet (Zhou et al. 2019) and CenterPoint (Yin et al. 2021).
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.heads.agents_head import AGENT_CLASSES, AgentSet
from foredrive.heads.carried import Lineage
from foredrive.heads.detection_losses import MatchingLossConfig, best_matching, matched_loss, near_pairs
from foredrive.heads.detection_network import BoxSet
from foredrive.heads.plane import cell_middles
from foredrive.heads.proposals import CentreMap
from foredrive.heads.targets import AgentTargets, agent_targets
from foredrive.ops.masked import masked_mean
from foredrive.scene import Boxes, VoxelSpec
from foredrive.scene.task_truth import TaskTruth
from foredrive.sets import LabelledBoxes


def centre_target(
    xy: Float[Tensor, "N 2"],
    label: Int[Tensor, "N"],
    spread_m: Float[Tensor, "N"],
    middle_m: Float[Tensor, "y x 2"],
    cell_m: float,
    classes: int,
) -> Float[Tensor, "K y x"]:
    """Return a map with 1 in the cell of each centre and a Gaussian around it; the largest one counts.

    Args:
        xy: centres inside of the map, m.
        label: classes.
        spread_m: standard deviation of each Gaussian.
        middle_m: middles of the cells.
        cell_m: edge of a cell.
        classes: K.
    """
    target = xy.new_zeros(classes, *middle_m.shape[:2])
    # Gaussian bump of every object at every cell
    away_m = (middle_m[None] - xy[:, None, None]).square().sum(-1)
    bump = (-0.5 * away_m / spread_m[:, None, None].square()).exp()
    # The cell of the centre is exactly 1, even if the middle of the cell is off the centre
    cell = ((xy - middle_m[0, 0]) / cell_m + 0.5).floor().long()
    bump[torch.arange(len(xy)), cell[:, 1], cell[:, 0]] = 1.0
    index = label.long()[:, None, None].expand_as(bump)
    # Where bumps of a class overlap, the larger value counts
    return target.scatter_reduce(0, index, bump, "amax")


def centre_loss(
    logits: Float[Tensor, "*n K y x"],
    target: Float[Tensor, "*n K y x"],
    alpha: float = 2.0,
    beta: float = 4.0,
) -> Float[Tensor, ""]:
    """Return the focal loss, lower near centres, per centre (CornerNet, Law and Deng 2018, eq. 1)."""
    p = logits.sigmoid()
    # Cells at centres are positive; the others are negative, weighted less near centres
    centre = target == 1.0
    present = (1 - p) ** alpha * F.logsigmoid(logits)
    empty = (1 - target) ** beta * p**alpha * F.logsigmoid(-logits)
    return -torch.where(centre, present, empty).sum() / centre.sum().clamp_min(1)


SPREAD = 0.25
"""Standard deviation of a centre's Gaussian as a share of the box's mean edge over ground."""
VELOCITY_SCALE_MPS = 5.0
"""An error of this size weighs as much as one of 1 m."""


@dataclass(frozen=True)
class AgentLossWeights:
    """Weights of the terms of the agents' losses."""

    centres: float = 1.0
    """Of the dense map's focal loss."""
    cells: float = 1.0
    """Of the boxes of the cells at centres."""
    queries: float = 0.5
    velocity: float = 0.2
    """Of the L1 error of a matched box, per m/s."""
    attribute: float = 0.2
    motion: float = 0.5
    boxes: MatchingLossConfig = field(default_factory=MatchingLossConfig)


def agent_losses(
    centres: CentreMap,
    layers: list[AgentSet],
    boxes: Boxes,
    boxes_valid: Bool[Tensor, "b"],
    truth: TaskTruth,
    spec: VoxelSpec,
    weights: AgentLossWeights,
    lineage: Lineage | None = None,
    frames: int = 1,
) -> dict[str, Float[Tensor, ""]]:
    """Return weighted losses, means over the annotated items (that of the queries over layers too).

    Args:
        centres: the dense map of b items.
        layers: agents after each layer.
        boxes: at now.
        boxes_valid: whether an item is annotated at now. The others have no losses.
        truth: of b items.
        spec: grid of the volumes.
        weights: weights of the terms.
        lineage: of agents that are carried on: a query stays with the object it was matched to before.
        frames: items of a sequence; a sequence's first item has no carried agents.
    """
    last = layers[-1]
    steps = 0 if last.future_xy is None else last.future_xy.shape[-2]
    terms: dict[str, list[Tensor]] = {
        name: [] for name in ("centres", "cells", "queries", "velocity", "attribute", "motion")
    }
    count = last.velocity.shape[1]
    # Object that each query was matched to in the frame before
    nobody = torch.full((count,), NOBODY, device=boxes_valid.device)
    owner = nobody
    for item, annotated in enumerate(boxes_valid.tolist()):
        # A sequence's first item, or one after a frame without annotation, has no matches to keep
        owner = nobody if item % frames == 0 or not annotated else owner
        if not annotated:
            continue
        futures = None if truth.futures is None else truth.futures[item]
        targets = agent_targets(boxes[item], futures, spec, steps)
        for name, value in _cell_losses(centres[item], targets, spec).items():
            terms[name].append(value)
        # Slot of the frame before that each query was carried from
        source = nobody if lineage is None else lineage.source[item]
        away_m = torch.cdist(
            last.boxes.mean[item, :, :2].detach(), targets.boxes.state[:, :2].to(last.boxes.mean)
        )
        # Carried queries stay with their object; the rest is matched anew below
        held = held_objects(source, owner, targets.track_id, away_m)
        for number, layer in enumerate(layers):
            predicted = layer[item]
            # Optimal matching of the free queries and objects, beside the held pairs
            query, match = matching_beside(predicted.boxes, targets.boxes, held, weights.boxes)
            terms["queries"].append(matched_loss(predicted.boxes, targets.boxes, query, match, weights.boxes))
            # Velocity, attribute and motion are trained at the last layer only
            if number == len(layers) - 1:
                near = near_pairs(predicted.boxes, targets.boxes, query, match)
                for name, value in _matched_terms(predicted, targets, *near).items():
                    terms[name].append(value)
                owner = owners(query, match, targets.track_id, count)
    if last.future_xy is None:
        del terms["motion"]
    # Zero with a gradient, for batches without annotation
    zero = last.velocity.sum() * 0 + centres.logits.sum() * 0
    return {
        name: getattr(weights, name) * torch.stack(values).mean() if values else zero
        for name, values in terms.items()
    }


def _cell_losses(centres: CentreMap, targets: AgentTargets, spec: VoxelSpec) -> dict[str, Float[Tensor, ""]]:
    """Return the losses of one item's dense map: of the centres, and of the boxes near them."""
    rows, columns = centres.z.shape
    lower = centres.xy.new_tensor(spec.lower_m[:2])
    cell_m = spec.voxel_m
    state, label = targets.boxes.state.to(centres.xy), targets.boxes.label
    middle = cell_middles(spec.lower_m[:2], cell_m, (rows, columns)).view(rows, columns, 2).to(lower)
    # The bump scales with the box, and covers the neighbouring cells at least
    spread = (SPREAD * state[:, 3:5].exp().mean(-1)).clamp_min(0.7 * cell_m)
    target = centre_target(state[:, :2], label, spread, middle, cell_m, len(AGENT_CLASSES))
    # Each box trains the cell of its centre and the eight around it.
    around = torch.tensor([[i, j] for j in (-1, 0, 1) for i in (-1, 0, 1)], device=lower.device)
    # Cells around the centre, without those off the grid
    cell = ((state[:, :2] - lower) / cell_m).floor().long()[:, None] + around
    inside = ((cell >= 0) & (cell < cell.new_tensor([columns, rows]))).all(-1)
    box, _ = inside.nonzero(as_tuple=True)
    column, row = cell[inside].unbind(-1)
    logits = torch.cat(
        [centres.xy[row, column], centres.z[row, column, None], centres.log_lwh[row, column]], dim=-1
    )
    assert targets.boxes.yaw is not None
    yaw = targets.boxes.yaw.to(state)[box]
    # The heading as sine and cosine has no jump at ±π
    arrow = torch.stack([yaw.sin(), yaw.cos()], dim=-1)
    off = (logits - state[box]).abs().sum(-1) + (centres.heading[row, column] - arrow).abs().sum(-1)
    velocity = targets.velocity[box]
    # Unknown velocities are NaN: replace them before they meet a gradient
    known = velocity.isfinite().all(-1)
    slip = centres.velocity[row, column] - torch.where(known[:, None], velocity, 0.0)
    off = off + torch.where(known, slip.abs().sum(-1) / VELOCITY_SCALE_MPS, 0.0)
    return {"centres": centre_loss(centres.logits, target), "cells": off.sum() / max(len(off), 1)}


def _matched_terms(
    predicted: AgentSet, targets: AgentTargets, query: Tensor, match: Tensor
) -> dict[str, Float[Tensor, ""]]:
    """Return the losses of velocity, attribute and motion of one item's near pairs."""
    true_velocity = targets.velocity[match]
    known = true_velocity.isfinite().all(-1)
    off = (predicted.velocity[query] - torch.where(known[:, None], true_velocity, 0.0)).abs().sum(-1)
    true_attribute = targets.attribute[match]
    # Label -1 is an unknown attribute and is left out
    entropy = F.cross_entropy(
        predicted.attribute[query], true_attribute.long(), ignore_index=-1, reduction="none"
    )
    terms = {"velocity": masked_mean(off, known), "attribute": masked_mean(entropy, true_attribute >= 0)}
    if predicted.future_xy is None or predicted.log_prob is None:
        return terms
    # Forecasts: distance of the nearest mode, and cross-entropy of the modes
    motion = motion_losses(
        predicted.future_xy[query],
        predicted.log_prob[query],
        targets.future_xy[match],
        targets.future_valid[match],
    )
    return terms | {"motion": motion.distance + motion.mode}


class MotionLosses(NamedTuple):
    """Terms of the loss, without their weights."""

    distance: Float[Tensor, ""]
    mode: Float[Tensor, ""]


def motion_losses(
    future_xy: Float[Tensor, "n M S 2"],
    log_prob: Float[Tensor, "n M"],
    true_xy: Float[Tensor, "n S 2"],
    valid: Bool[Tensor, "n S"],
) -> MotionLosses:
    """Return the smooth L1 distance of the best mode, and the cross-entropy of that mode.

    Only the mode with the least mean distance over the valid steps learns the path (winner takes all). Means
    are over agents with a valid step; without any, both are 0.
    """
    known_agents = valid.any(dim=-1)
    steps = valid.sum(dim=-1).clamp_min(1)
    with torch.no_grad():
        # The mode with the least mean distance over known steps wins, without gradient
        distance = (future_xy - true_xy[:, None]).norm(dim=-1) * valid[:, None]
        best = (distance.sum(-1) / steps[:, None]).argmin(dim=-1)
    won = future_xy[torch.arange(len(best), device=best.device), best]
    error = F.smooth_l1_loss(won, true_xy, reduction="none").sum(-1)
    per_agent = torch.where(valid, error, 0.0).sum(-1) / steps
    # Agents without a known step have no loss
    return MotionLosses(
        distance=masked_mean(per_agent, known_agents),
        mode=masked_mean(F.nll_loss(log_prob, best, reduction="none"), known_agents),
    )


NOBODY = -1
"""Owner of a query that was matched to no object."""
RELEASED_M = 4.0
"""Distance from which on a carried query is no longer held to its object."""


@dataclass(frozen=True)
class Held:
    """The queries of one frame that carry on an object of the frame before."""

    query: Int[Tensor, "h"]
    match: Int[Tensor, "h"]
    """The object of each of `query` at now."""
    bound: Bool[Tensor, "Q"]
    """Queries that carry on an object, also one that has left: they can have no other."""


def held_objects(
    source: Int[Tensor, "Q"],
    owner: Int[Tensor, "_Q"],
    track_id: Int[Tensor, "N"],
    away_m: Float[Tensor, "Q N"],
) -> Held:
    """Return which queries have to find which objects (MOTR, Zeng et al. 2022, §3.3).

    A query that is `RELEASED_M` away from its object has lost it: both are free.

    Args:
        source: index of each query in the frame before, or -1.
        owner: identity of the object that each query of the frame before was matched to, or `NOBODY`.
        track_id: identity of each object at now.
        away_m: distance of each query from each object, m.
    """
    # Object that the query carried on, if any
    query_track = torch.where(source >= 0, owner[source.clamp_min(0)], NOBODY)
    # Its row among the objects at now
    has_same_track = (query_track[:, None] == track_id) & (query_track[:, None] != NOBODY)
    # A query that is far from its object is free, and the object is free as well
    is_released = (has_same_track & (away_m >= RELEASED_M)).any(dim=1)
    has_same_track = has_same_track & ~is_released[:, None]
    query, match = has_same_track.nonzero(as_tuple=True)
    return Held(query, match, (query_track != NOBODY) & ~is_released)


def matching_beside(
    predicted: BoxSet, truth: LabelledBoxes, held: Held, config: MatchingLossConfig
) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
    """Return queries and their objects: the held ones, and the best matching of all others."""
    # Queries and objects without a partner are matched optimally
    free_query = (~held.bound).nonzero()[:, 0]
    free = torch.ones(len(truth.label), dtype=torch.bool, device=held.match.device)
    free[held.match] = False
    free_object = free.nonzero()[:, 0]
    query, match = best_matching(predicted[free_query], truth[free_object], config)
    return torch.cat([held.query, free_query[query]]), torch.cat([held.match, free_object[match]])


def owners(
    query: Int[Tensor, "n"], match: Int[Tensor, "n"], track_id: Int[Tensor, "N"], queries: int
) -> Int[Tensor, "Q"]:
    """Return the identity of the object of each query, or `NOBODY`."""
    owner = torch.full((queries,), NOBODY, dtype=torch.long, device=query.device)
    owner[query] = track_id[match].long()
    return owner
