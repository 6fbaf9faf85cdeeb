"""What a sensor looks along: rays with the time at which each of them looks."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from foredrive.scene.record import Record


@dataclass(frozen=True)
class TimedRays(Record):
    """N rays in the ego frame of one reference time."""

    origin_ego: Float[Tensor, "*b N 3"]
    """m."""
    dir_ego: Float[Tensor, "*b N 3"]
    """Unit direction."""
    dt_s: Float[Tensor, "*b N"]
    """When the ray looks, relative to the reference time."""
