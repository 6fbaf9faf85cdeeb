"""Losses of all task heads together, and of the masks of matched vehicles."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.heads.agent_losses import AgentLossWeights, agent_losses
from foredrive.heads.agents_head import AGENT_CLASSES, AgentSet
from foredrive.heads.detection_losses import MatchingLossConfig, best_matching, near_pairs
from foredrive.heads.heads import HeadOutput
from foredrive.heads.instances_head import InstanceSet, instance_logits
from foredrive.heads.map_head import MapSet
from foredrive.heads.map_losses import MapLossWeights, map_element_losses
from foredrive.heads.plane import cell_middles
from foredrive.heads.semantic_losses import raster_loss, semantic_affinity, voxel_cross_entropy
from foredrive.heads.targets import agent_targets, map_targets
from foredrive.scene import Boxes, VoxelSpec
from foredrive.scene.boxes import VEHICLES
from foredrive.scene.map_elements import InstanceRaster, MapElements, PlaneSpec
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


OCCUPIED_WEIGHT = 2.0
STRIDE = 2
"""An item is judged on every second row and column of the raster, which costs a quarter."""
_VEHICLE_LABELS = torch.tensor([n for n, kind in enumerate(AGENT_CLASSES) if kind in VEHICLES])


def instance_loss(
    instances: InstanceSet,
    agents: AgentSet,
    boxes: Boxes,
    boxes_valid: Bool[Tensor, "b"],
    truth: InstanceRaster,
    spec: VoxelSpec,
    matching: MatchingLossConfig,
) -> Float[Tensor, ""]:
    """Return cross-entropy plus Dice of the masks of all matched vehicles and steps; 0 without any.

    Each vehicle that matches an agent's box nearby has its cells of the truth as the mask, at all steps that
    the log annotates. Cells outside of the volume's plane do not count. Of the others each item takes
    those of one row and one column in `STRIDE`, starting at another one than its neighbours in the batch.
    """
    # Cells whose middle is above the volume
    grid, wanted = truth.spec, _inside(truth.spec, spec)
    middle = cell_middles(grid.lower_m, grid.cell_m, grid.shape_yx).unflatten(0, grid.shape_yx)
    middles = middle[wanted[0]][:, wanted[1]].to(instances.embedding.device)
    losses = []
    # Vehicles among the matched boxes, at steps that are annotated
    for item in boxes_valid.nonzero()[:, 0].tolist():
        targets = agent_targets(boxes[item], None, spec, 0)
        sets = agents[item].boxes, targets.boxes
        query, match = near_pairs(*sets, *best_matching(*sets, matching))
        vehicle = torch.isin(targets.boxes.label[match], _VEHICLE_LABELS.to(match.device))
        steps = truth.valid[item]
        query, track_id = query[vehicle], targets.track_id[match[vehicle]]
        if not len(query) or not bool(steps.any()):
            continue
        # Another start for each item, so that a batch covers all rows and columns
        rows, columns = slice(item // STRIDE % STRIDE, None, STRIDE), slice(item % STRIDE, None, STRIDE)
        points = middles[rows, columns]
        logits = instance_logits(instances[item], agents[item], query, points.flatten(0, 1))
        cells = truth.track_id[item][:, wanted[0]][:, :, wanted[1]][:, rows, columns]
        # Track ids are stored plus 1, as 0 is no vehicle
        masks = cells == (track_id + 1)[:, None, None, None]
        whole = logits.unflatten(-1, points.shape[:2])[:, steps]
        all_vehicles = torch.ones(len(query), dtype=torch.bool, device=whole.device)
        losses.append(raster_loss(whole, masks[:, steps], all_vehicles, OCCUPIED_WEIGHT))
    # Zero with a gradient, for batches without matched vehicles
    return torch.stack(losses).mean() if losses else instances.embedding.sum() * 0


def _inside(raster: PlaneSpec, spec: VoxelSpec) -> tuple[Bool[Tensor, "Y"], Bool[Tensor, "X"]]:
    """Return which rows and columns of a raster have their middle above a volume."""
    inside = []
    for axis, size in ((1, raster.shape_yx[0]), (0, raster.shape_yx[1])):
        middle = raster.lower_m[axis] + (torch.arange(size) + 0.5) * raster.cell_m
        inside.append((middle > spec.lower_m[axis]) & (middle < spec.upper_m[axis]))
    return inside[0], inside[1]
