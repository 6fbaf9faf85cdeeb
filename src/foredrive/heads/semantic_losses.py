"""Losses of semantic voxels and of map rasters."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from foredrive.heads.occupancy_losses import EPS
from foredrive.ops.masked import masked_mean


def class_weights(count: Shaped[Tensor, "C"]) -> Float[Tensor, "C"]:
    """Return 1 / ln(1.02 + share) for the share of each class (Paszke et al. 2016, ENet, §5.1)."""
    share = count.double() / count.sum().clamp_min(1)
    return (1 / (1.02 + share).log()).float()


def voxel_cross_entropy(
    logits: Float[Tensor, "b C *n"],
    index: Shaped[Tensor, "b *n"],
    known: Bool[Tensor, "b *n"],
    weight: Float[Tensor, "C"],
) -> Float[Tensor, ""]:
    """Return the cross-entropy over known voxels, each weighted by its true class; 0 if none is known."""
    # The class weight multiplies each voxel's loss; the sum is divided by the weights of the known ones
    per_voxel = F.cross_entropy(logits, index.long(), weight, reduction="none")
    weights = torch.where(known, weight[index.long()], 0.0)
    return torch.where(known, per_voxel, 0.0).sum() / weights.sum().clamp_min(1e-6)


def semantic_affinity(
    logits: Float[Tensor, "b C *n"], index: Shaped[Tensor, "b *n"], known: Bool[Tensor, "b *n"]
) -> Float[Tensor, ""]:
    """Return the semantic scene-class affinity over known voxels (MonoScene, eq. 4-6).

    For each true class it is -log P - log R - log S, with differentiable precision, recall and specificity;
    the mean over the classes that the truth has. Without known voxels it is 0.
    """
    classes = logits.shape[1]
    # Known voxels as one list
    p = logits.movedim(1, -1)[known].softmax(dim=-1)
    y = F.one_hot(index[known].long(), classes).to(p)
    # Expected hits, occupied voxels and predicted voxels of each class
    hit, true, total = (p * y).sum(0), y.sum(0), len(y)
    predicted = p.sum(0)
    free = ((1 - p) * (1 - y)).sum(0)
    ratios = torch.stack(
        [
            (hit + EPS) / (predicted + EPS),
            (hit + EPS) / (true + EPS),
            # A class that fills everything has no specificity
            torch.where(true < total, (free + EPS) / (total - true + EPS), 1.0),
        ]
    )
    return masked_mean(-ratios.log().sum(0), true > 0)


def raster_loss(
    logits: Float[Tensor, "b L Y X"],
    layers: Bool[Tensor, "b L Y X"],
    known: Bool[Tensor, "b"],
    occupied_weight: float = 5.0,
) -> Float[Tensor, ""]:
    """Return the binary cross-entropy plus the Dice loss of each layer; the mean over layers of known items.

    Dice is 1 - 2 Σpy / (Σp² + Σy²) (Milletari et al. 2016). `occupied_weight` multiplies the cross-entropy of
    occupied cells, because lines cover few.
    """
    y = layers.to(logits)
    weight = logits.new_tensor(occupied_weight)
    # Mean over the cells of a layer
    entropy = F.binary_cross_entropy_with_logits(logits, y, reduction="none", pos_weight=weight).mean(
        (-2, -1)
    )
    p = logits.sigmoid()
    both, either = (p * y).sum((-2, -1)), (p.square() + y).sum((-2, -1))
    # The ones keep the ratio finite for empty layers, and make it 0 for a good empty prediction
    dice = 1 - (2 * both + 1) / (either + 1)
    return masked_mean(entropy + dice, known[:, None].expand_as(entropy))
