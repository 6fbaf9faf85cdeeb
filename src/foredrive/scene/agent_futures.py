"""The recorded futures of road users."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.scene.record import Record


@dataclass(frozen=True)
class AgentFutures(Record):
    """Where the objects of the boxes at now go, in the ego frame at now. Step k is (k + 1) `dt_s` after now.

    Row m belongs to box m of the frame at now. There are as many rows as boxes in this frame, or as the
    largest count of a batch. Steps at which the object is not annotated, and padding, have `valid` False and
    zeros.
    """

    xy: Float[Tensor, "*b M S 2"]
    """Box centre, m."""
    yaw: Float[Tensor, "*b M S"]
    """Heading about ego z, rad, in [-π, π)."""
    valid: Bool[Tensor, "*b M S"]
    dt_s: float
