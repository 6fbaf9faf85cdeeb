"""Losses of all task heads together."""

from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.losses.map_elements import MapLossWeights, map_element_losses
from foredrive.losses.masked import masked_mean
from foredrive.losses.motion import motion_losses
from foredrive.losses.semantics import raster_loss, semantic_affinity, voxel_cross_entropy
from foredrive.models.tasks.agents import AgentSet
from foredrive.models.tasks.heads import HeadOutput
from foredrive.models.tasks.maps import MapSet
from foredrive.scene import Boxes, VoxelSpec
from foredrive.scene.map_elements import MapElements
from foredrive.scene.semantics import SemanticVoxels
from foredrive.scene.task_truth import TaskTruth
from foredrive.training.detection_losses import MatchingLossConfig, best_matching, matched_loss
from foredrive.training.task_targets import AgentTargets, agent_targets, map_targets


@dataclass(frozen=True)
class TaskWeights:
    """Weights of the tasks' losses, and of the terms within them."""

    detection: float = 1.0
    velocity: float = 0.2
    """Of the L1 error of a matched box, per m/s."""
    attribute: float = 0.2
    motion: float = 0.5
    elements: float = 1.0
    raster: float = 1.0
    voxels: float = 1.0
    boxes: MatchingLossConfig = field(default_factory=MatchingLossConfig)
    map: MapLossWeights = field(default_factory=MapLossWeights)


def task_losses(
    output: HeadOutput,
    boxes: Boxes,
    boxes_valid: Bool[Tensor, "b"],
    truth: TaskTruth,
    spec: VoxelSpec,
    class_weight: Float[Tensor, "C"] | None,
    weights: TaskWeights,
) -> dict[str, Float[Tensor, ""]]:
    """Return the losses of the heads by name; "loss" is their weighted sum.

    Args:
        output: of the heads for b items. A head that was left out has no loss.
        boxes: at now.
        boxes_valid: whether an item is annotated at now. Others do not train the agents.
        truth: of b items. What it lacks trains nothing.
        spec: grid of the volumes.
        class_weight: weight of each class of semantic voxels.
        weights: weights of the losses.
    """
    losses: dict[str, Float[Tensor, ""]] = {}
    if output.agents is not None:
        losses |= _agent_losses(output.agents, boxes, boxes_valid, truth, spec, weights)
    if output.elements is not None and truth.elements is not None:
        losses["elements"] = _map_loss(output.elements, truth.elements, weights.map)
    if output.raster is not None and truth.raster is not None:
        losses["raster"] = raster_loss(output.raster, truth.raster.layers, truth.raster.known)
    if output.voxels is not None and truth.semantics is not None:
        losses["voxels"] = _voxel_loss(output.voxels, truth.semantics, class_weight)
    total = torch.stack([getattr(weights, name) * value for name, value in losses.items()]).sum()
    return losses | {"loss": total}


def _agent_losses(
    layers: list[AgentSet],
    boxes: Boxes,
    boxes_valid: Bool[Tensor, "b"],
    truth: TaskTruth,
    spec: VoxelSpec,
    weights: TaskWeights,
) -> dict[str, Float[Tensor, ""]]:
    """Return the means over the annotated items; detection is the mean over layers too."""
    last = layers[-1]
    zero = last.velocity.sum() * 0
    detection, velocity, attribute, motion = [], [], [], []
    for item in boxes_valid.nonzero()[:, 0].tolist():
        steps = 0 if last.future_xy is None else last.future_xy.shape[-2]
        futures = None if truth.futures is None else truth.futures[item]
        targets = agent_targets(boxes[item], futures, spec, steps)
        for number, layer in enumerate(layers):
            found = layer[item]
            query, match = best_matching(found.boxes, targets.boxes, weights.boxes)
            detection.append(matched_loss(found.boxes, targets.boxes, query, match, weights.boxes))
            if number == len(layers) - 1:
                terms = _matched_terms(found, targets, query, match)
                velocity.append(terms[0])
                attribute.append(terms[1])
                motion.append(terms[2])
    named = {"detection": detection, "velocity": velocity, "attribute": attribute, "motion": motion}
    if last.future_xy is None:
        del named["motion"]
    return {name: torch.stack(values).mean() if values else zero for name, values in named.items()}


def _matched_terms(
    found: AgentSet, targets: AgentTargets, query: Tensor, match: Tensor
) -> tuple[Float[Tensor, ""], Float[Tensor, ""], Float[Tensor, ""]]:
    """Return the losses of velocity, attribute and motion of one item's matched queries."""
    true_velocity = targets.velocity[match]
    known = true_velocity.isfinite().all(-1)
    off = (found.velocity[query] - torch.where(known[:, None], true_velocity, 0.0)).abs().sum(-1)
    true_attribute = targets.attribute[match]
    entropy = F.cross_entropy(
        found.attribute[query], true_attribute.long(), ignore_index=-1, reduction="none"
    )
    motion = found.velocity.new_zeros(())
    if found.future_xy is not None and found.log_prob is not None:
        terms = motion_losses(
            found.future_xy[query],
            found.log_prob[query],
            targets.future_xy[match],
            targets.future_valid[match],
        )
        motion = terms.distance + terms.mode
    return masked_mean(off, known), masked_mean(entropy, true_attribute >= 0), motion


def _map_loss(layers: list[MapSet], elements: MapElements, weights: MapLossWeights) -> Float[Tensor, ""]:
    """Return the mean over layers and over items with a map."""
    values = []
    for item in elements.known.nonzero()[:, 0].tolist():
        kinds, points = layers[0].logits.shape[-1], layers[0].points.shape[-2]
        targets = map_targets(elements[item], kinds, points)
        for layer in layers:
            found = map_element_losses(
                layer.logits[item], layer.points[item], targets.kind, targets.orders, weights
            )
            values.append(
                weights.kind * found.kind
                + weights.points * found.points
                + weights.direction * found.direction
            )
    return torch.stack(values).mean() if values else layers[0].logits.sum() * 0


def _voxel_loss(
    logits: Float[Tensor, "b C Z Y X"], truth: SemanticVoxels, class_weight: Float[Tensor, "C"] | None
) -> Float[Tensor, ""]:
    weight = logits.new_ones(logits.shape[1]) if class_weight is None else class_weight.to(logits)
    entropy = voxel_cross_entropy(logits, truth.index, truth.known, weight)
    return entropy + semantic_affinity(logits, truth.index, truth.known)
