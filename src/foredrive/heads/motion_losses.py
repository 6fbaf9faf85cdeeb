"""Loss of forecast motion with several modes."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.ops.masked import masked_mean


class MotionLosses(NamedTuple):
    """Terms of the loss, without their weights."""

    distance: Float[Tensor, ""]
    mode: Float[Tensor, ""]


def motion_losses(
    future_xy: Float[Tensor, "n M S 2"],
    log_prob: Float[Tensor, "n M"],
    true_xy: Float[Tensor, "n S 2"],
    valid: Bool[Tensor, "n S"],
) -> MotionLosses:
    """Return the smooth L1 distance of the best mode, and the cross-entropy of that mode.

    Only the mode with the least mean distance over the valid steps learns the path (winner takes all). Means
    are over agents with a valid step; without any, both are 0.
    """
    known = valid.any(dim=-1)
    steps = valid.sum(dim=-1).clamp_min(1)
    with torch.no_grad():
        # The mode with the least mean distance over known steps wins, without gradient
        distance = (future_xy - true_xy[:, None]).norm(dim=-1) * valid[:, None]
        best = (distance.sum(-1) / steps[:, None]).argmin(dim=-1)
    won = future_xy[torch.arange(len(best), device=best.device), best]
    error = F.smooth_l1_loss(won, true_xy, reduction="none").sum(-1)
    per_agent = torch.where(valid, error, 0.0).sum(-1) / steps
    # Agents without a known step have no loss
    return MotionLosses(
        distance=masked_mean(per_agent, known),
        mode=masked_mean(F.nll_loss(log_prob, best, reduction="none"), known),
    )
