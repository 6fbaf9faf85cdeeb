"""Timed rays: the viewing rays of a sensor with their times."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from foredrive.scene.record import Record


@dataclass(frozen=True)
class TimedRays(Record):
    """N rays in the ego frame of one reference time."""

    origin_ego: Float[Tensor, "*b N 3"]
    """Start of the ray, m."""
    dir_ego: Float[Tensor, "*b N 3"]
    """Unit direction."""
    dt_s: Float[Tensor, "*b N"]
    """Time of the measurement relative to the reference time, s."""
