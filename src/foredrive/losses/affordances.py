"""Losses of affordances: the next light and the lead vehicle."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.losses.masked import masked_mean


def light_loss(
    logits: Float[Tensor, "b 4"], state: Int[Tensor, "b"], known: Bool[Tensor, "b"]
) -> Float[Tensor, ""]:
    """Return the cross-entropy of the state of the next light over the items that tell; 0 without any."""
    return masked_mean(F.cross_entropy(logits, state.long(), reduction="none"), known)


def presence_loss(
    logit: Float[Tensor, "b"], there: Bool[Tensor, "b"], known: Bool[Tensor, "b"]
) -> Float[Tensor, ""]:
    """Return the binary cross-entropy of a lead vehicle over the items that tell; 0 without any."""
    each = F.binary_cross_entropy_with_logits(logit, there.to(logit), reduction="none")
    return masked_mean(each, known)


def distance_loss(
    found_m: Float[Tensor, "b"], true_m: Float[Tensor, "b"], there: Bool[Tensor, "b"]
) -> Float[Tensor, ""]:
    """Return the mean absolute error of a distance where there is one, relative to 5 m and the distance."""
    return masked_mean((found_m - true_m).abs() / (5.0 + true_m.clamp_min(0.0)), there)


def speed_loss(
    found_mps: Float[Tensor, "b"], true_mps: Float[Tensor, "b"], there: Bool[Tensor, "b"]
) -> Float[Tensor, ""]:
    """Return the mean absolute error of a speed, m/s, where there is one."""
    return masked_mean((found_mps - torch.where(there, true_mps, 0.0)).abs(), there)
