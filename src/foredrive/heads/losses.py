"""Losses of all task heads together."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.heads.agent_losses import AgentLossWeights, agent_losses
from foredrive.heads.heads import HeadOutput
from foredrive.heads.instance_losses import instance_loss
from foredrive.heads.map_head import MapSet
from foredrive.heads.map_losses import MapLossWeights, map_element_losses
from foredrive.heads.semantic_losses import raster_loss, semantic_affinity, voxel_cross_entropy
from foredrive.heads.targets import map_targets
from foredrive.scene import Boxes, VoxelSpec
from foredrive.scene.map_elements import MapElements
from foredrive.scene.semantics import SemanticVoxels
from foredrive.scene.task_truth import TaskTruth


@dataclass(frozen=True)
class TaskWeights:
    """Weights of the tasks' losses, and of the terms within them."""

    agents: AgentLossWeights = field(default_factory=AgentLossWeights)
    elements: float = 1.0
    raster: float = 1.0
    voxels: float = 1.0
    instances: float = 1.0
    map: MapLossWeights = field(default_factory=MapLossWeights)


def task_losses(
    output: HeadOutput,
    boxes: Boxes,
    boxes_valid: Bool[Tensor, "b"],
    truth: TaskTruth,
    spec: VoxelSpec,
    class_weight: Float[Tensor, "C"] | None,
    weights: TaskWeights,
    frames: int = 1,
) -> dict[str, Float[Tensor, ""]]:
    """Return the weighted losses of the heads by name; "loss" is their sum.

    Args:
        output: of the heads for b items. A head that was left out has no loss.
        boxes: at now.
        boxes_valid: whether an item is annotated at now. The others have no losses of agents.
        truth: of b items. A task without truth has no loss.
        spec: grid of the volumes.
        class_weight: weight of each class of semantic voxels.
        weights: weights of the losses.
        frames: items of a sequence, if the items are sequences.
    """
    losses: dict[str, Float[Tensor, ""]] = {}
    if output.agents is not None:
        assert output.centres is not None
        losses |= agent_losses(
            output.centres,
            output.agents,
            boxes,
            boxes_valid,
            truth,
            spec,
            weights.agents,
            output.lineage,
            frames,
        )
    if output.elements is not None and truth.elements is not None:
        losses["elements"] = weights.elements * _map_loss(output.elements, truth.elements, weights.map)
    if output.raster is not None and truth.raster is not None:
        losses["raster"] = weights.raster * raster_loss(
            output.raster, truth.raster.layers, truth.raster.known
        )
    if output.voxels is not None and truth.semantics is not None:
        losses["voxels"] = weights.voxels * _voxel_loss(output.voxels, truth.semantics, class_weight)
    if output.instances is not None and output.agents is not None and truth.instances is not None:
        # Rows of the last frames
        last = slice(frames - 1, None, frames)  # the heads leave out the other frames of a sequence
        losses["instances"] = weights.instances * instance_loss(
            output.instances,
            output.agents[-1][last],
            boxes[last],
            boxes_valid[last],
            truth.instances[last],
            spec,
            weights.agents.boxes,
        )
    return losses | {"loss": torch.stack(list(losses.values())).sum()}


def _map_loss(layers: list[MapSet], elements: MapElements, weights: MapLossWeights) -> Float[Tensor, ""]:
    """Return the mean over layers and over items with a map."""
    # Every layer has a loss (deep supervision); items without a map have none
    values = []
    for item in elements.known.nonzero()[:, 0].tolist():
        kinds, points = layers[0].logits.shape[-1], layers[0].points.shape[-2]
        targets = map_targets(elements[item], kinds, points)
        for layer in layers:
            losses = map_element_losses(
                layer.logits[item], layer.points[item], targets.kind, targets.orders, weights
            )
            values.append(
                weights.kind * losses.kind
                + weights.points * losses.points
                + weights.direction * losses.direction
            )
    # Zero with a gradient, for batches without a map
    return torch.stack(values).mean() if values else layers[0].logits.sum() * 0


def _voxel_loss(
    logits: Float[Tensor, "b C Z Y X"], truth: SemanticVoxels, class_weight: Float[Tensor, "C"] | None
) -> Float[Tensor, ""]:
    weight = logits.new_ones(logits.shape[1]) if class_weight is None else class_weight.to(logits)
    entropy = voxel_cross_entropy(logits, truth.index, truth.known, weight)
    return entropy + semantic_affinity(logits, truth.index, truth.known)
