"""Planned, predicted and driven paths."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.scene.record import Record


@dataclass(frozen=True)
class Trajectory(Record):
    """M alternative paths of T steps in the ego frame at now. Step k is at time (k+1)·`dt_s`.

    A recorded future or a single plan has M = 1.
    """

    xy: Float[Tensor, "*b M T 2"]
    """Rear-axle position, m."""
    yaw: Float[Tensor, "*b M T"]
    """Heading relative to the ego heading at now, rad."""
    valid: Bool[Tensor, "*b M T"]
    log_prob: Float[Tensor, "*b M"]
    """Log-probability of each alternative. 0 for a single one."""
    dt_s: float
