"""Imitation of the driven path (NeMo eq. 14)."""

from jaxtyping import Float
from torch import Tensor

from foredrive.scene import Trajectory


def waypoint_loss(plan: Trajectory, driven: Trajectory) -> Float[Tensor, ""]:
    """Mean distance ‖ŷ − y‖₂ over the valid steps, m; 0 when none is valid."""
    squared = ((plan.xy - driven.xy) ** 2).sum(-1)
    distance = (squared + 1e-12).sqrt()  # the gradient of a bare root is infinite at 0
    return (distance * driven.valid).sum() / driven.valid.sum().clamp_min(1)
