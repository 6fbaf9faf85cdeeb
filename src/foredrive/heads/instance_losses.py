"""The loss of instance occupancy: the masks of matched vehicles, now and later."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.heads.agents_head import AGENT_CLASSES, AgentSet
from foredrive.heads.detection_losses import MatchingLossConfig, best_matching, near_pairs
from foredrive.heads.instances_head import InstanceSet, instance_logits
from foredrive.heads.plane import cell_middles
from foredrive.heads.semantic_losses import raster_loss
from foredrive.heads.targets import agent_targets
from foredrive.scene import Boxes, VoxelSpec
from foredrive.scene.boxes import VEHICLES
from foredrive.scene.map_elements import InstanceRaster, PlaneSpec

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
        known = torch.ones(len(query), dtype=torch.bool, device=whole.device)
        losses.append(raster_loss(whole, masks[:, steps], known, OCCUPIED_WEIGHT))
    # Zero with a gradient, for batches without matched vehicles
    return torch.stack(losses).mean() if losses else instances.embedding.sum() * 0


def _inside(raster: PlaneSpec, spec: VoxelSpec) -> tuple[Bool[Tensor, "Y"], Bool[Tensor, "X"]]:
    """Return which rows and columns of a raster have their middle above a volume."""
    inside = []
    for axis, size in ((1, raster.shape_yx[0]), (0, raster.shape_yx[1])):
        middle = raster.lower_m[axis] + (torch.arange(size) + 0.5) * raster.cell_m
        inside.append((middle > spec.lower_m[axis]) & (middle < spec.upper_m[axis]))
    return inside[0], inside[1]
