"""Contrastive loss between images and texts (Radford et al. 2021, figure 3)."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor


def is_true(stated: Bool[Tensor, "t V"], holds: Bool[Tensor, "i V"]) -> Bool[Tensor, "i t"]:
    """Return which of t texts are true of which of i images: all facts that a text states hold.

    Args:
        stated: of V facts, those that each text states.
        holds: of V facts, those that hold for each image.
    """
    return (~holds).float() @ stated.float().T == 0


def info_nce(
    logits: Float[Tensor, "n n"], true: Bool[Tensor, "n n"]
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Return InfoNCE over rows and columns whose pairs lie on the diagonal; other true pairs are left out.

    Returns:
        The mean loss, and the share of rows whose own text comes first.
    """
    own = torch.arange(len(logits), device=logits.device)
    other_true = true & ~torch.eye(len(logits), dtype=torch.bool, device=logits.device)
    logits = logits.masked_fill(other_true, -torch.inf)
    loss = (F.cross_entropy(logits, own) + F.cross_entropy(logits.T, own)) / 2
    return loss, (logits.argmax(dim=1) == own).float().mean()
