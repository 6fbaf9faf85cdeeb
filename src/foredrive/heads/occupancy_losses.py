"""Occupancy losses on known voxels (NeMo eq. 10–11)."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.ops.masked import masked_mean
from foredrive.scene.voxels import MOVING_MPS

EPS = 1e-6


def occupancy_bce(
    logit: Float[Tensor, "*b Z Y X"],
    occupied: Float[Tensor, "*b Z Y X"],
    known: Bool[Tensor, "*b Z Y X"],
    occupied_weight: float = 1.0,
    emphasis: Float[Tensor, "*b Z Y X"] | float = 1.0,
) -> Float[Tensor, ""]:
    """Return the binary cross entropy averaged over the known voxels (eq. 10); 0 when none is known.

    `occupied_weight` multiplies the terms of occupied voxels, `emphasis` each term; eq. 10 has 1.
    """
    # pos_weight multiplies the terms of occupied voxels
    weight = logit.new_tensor([occupied_weight])
    per_voxel = F.binary_cross_entropy_with_logits(logit, occupied, reduction="none", pos_weight=weight)
    return masked_mean(emphasis * per_voxel, known)


def motion_emphasis(
    flow_mps: Float[Tensor, "b 3 Z Y X"], known: Bool[Tensor, "b Z Y X"], factor: float
) -> Float[Tensor, "b Z Y X"]:
    """Return `factor` for voxels whose content is known to move and for those next to them, 1 for others."""
    moving = known & (flow_mps.norm(dim=1) > MOVING_MPS)
    near = F.max_pool3d(moving.to(flow_mps.dtype), kernel_size=3, stride=1, padding=1)
    return 1 + (factor - 1) * near


def scene_class_affinity(
    logit: Float[Tensor, "*b Z Y X"], occupied: Float[Tensor, "*b Z Y X"], known: Bool[Tensor, "*b Z Y X"]
) -> Float[Tensor, ""]:
    """Return the geometric scene-class affinity −log P − log R − log S (MonoScene, eq. 4–6).

    Differentiable precision P = Σp·y/Σp, recall R = Σp·y/Σy, specificity S = Σ(1−p)(1−y)/Σ(1−y) over the
    known voxels of the batch. A term with an empty denominator (no occupied voxel, no free one) is left out;
    the published code divides by zero there.
    """
    p = logit.sigmoid()
    y, free = occupied * known, (1 - occupied) * known
    # Sums over the known voxels of the whole batch
    hit, count, count_free = (p * y).sum(), y.sum(), free.sum()
    terms = [(hit, (p * known).sum()), (hit, count), (((1 - p) * free).sum(), count_free)]
    has_occupied, has_free = count > 0, count_free > 0
    loss = logit.new_zeros(())
    # Terms of precision and recall need an occupied voxel, that of specificity a free one
    for (numerator, denominator), present in zip(terms, (has_occupied, has_occupied, has_free), strict=True):
        # EPS keeps ratio and logarithm finite
        ratio = (numerator + EPS) / (denominator + EPS)
        loss = loss - torch.where(present, ratio.log(), torch.zeros_like(ratio))
    return loss


def occupancy_loss(
    logit: Float[Tensor, "*b Z Y X"],
    occupied: Float[Tensor, "*b Z Y X"],
    known: Bool[Tensor, "*b Z Y X"],
    *,
    scal_weight: float,
    bce_weight: float,
    occupied_weight: float = 1.0,
    emphasis: Float[Tensor, "*b Z Y X"] | float = 1.0,
) -> Float[Tensor, ""]:
    """Return L_occ = λ_scal·L_scal + λ_BCE·L_BCE (eq. 11; the paper: 10 and 1)."""
    bce = occupancy_bce(logit, occupied, known, occupied_weight, emphasis)
    return scal_weight * scene_class_affinity(logit, occupied, known) + bce_weight * bce
