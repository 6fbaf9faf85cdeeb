"""Losses of scored plans: sub-scores told by a simulation, and imitation of the expert."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.losses.masked import masked_mean


def sub_score_loss(
    logits: Float[Tensor, "b N S"], values: Float[Tensor, "b N S"], known: Bool[Tensor, "b S"]
) -> Float[Tensor, "S"]:
    """Return the binary cross-entropy of each sub-score over all plans of the items that tell it."""
    each = F.binary_cross_entropy_with_logits(logits, values, reduction="none").mean(1)
    return torch.stack([masked_mean(each[:, k], known[:, k]) for k in range(each.shape[1])])


def soft_imitation_loss(
    logits: Float[Tensor, "b N"],
    xy: Float[Tensor, "b N T 2"],
    expert_xy: Float[Tensor, "b T 2"],
    valid: Bool[Tensor, "b T"],
) -> Float[Tensor, ""]:
    """Return the cross-entropy with y_i ∝ exp(-Σ_t ‖T_i(t) - T̂(t)‖²) over the plans of a vocabulary.

    This is the imitation loss of Hydra-MDP (Li et al. 2024), over the valid steps.
    """
    squared = (xy - expert_xy[:, None]).square().sum(-1)
    away = torch.where(valid[:, None], squared, 0.0).sum(-1)
    each = -(away.neg().softmax(-1) * logits.log_softmax(-1)).sum(-1)
    return masked_mean(each, valid.any(-1))
