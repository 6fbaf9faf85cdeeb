"""Imitation of the driven path."""

from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.losses.masked import masked_mean
from foredrive.scene import Trajectory


def waypoint_loss(plan: Trajectory, driven: Trajectory) -> Float[Tensor, ""]:
    """Return the mean distance ‖ŷ − y‖₂ over the valid steps, m (NeMo eq. 14); 0 when none is valid."""
    squared = ((plan.xy - driven.xy) ** 2).sum(-1)
    distance = (squared + 1e-12).sqrt()  # the gradient of a bare root is infinite at 0
    return masked_mean(distance, driven.valid)


def l1_waypoint_loss(
    planned: Float[Tensor, "b T D"], driven: Float[Tensor, "b T D"], valid: Bool[Tensor, "b T"]
) -> Float[Tensor, ""]:
    """Return the L1 distance over D coordinates, averaged over the valid steps; 0 when none is valid."""
    return masked_mean((planned - driven).abs().sum(dim=-1), valid)
