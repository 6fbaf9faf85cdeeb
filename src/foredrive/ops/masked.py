"""Means over the entries that count."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def masked_mean(values: Float[Tensor, "*n"], mask: Bool[Tensor, "*n"]) -> Float[Tensor, ""]:
    """Return the mean over a mask, or 0 if it is empty. Masked values may be NaN."""
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp_min(1)
