"""Road users as a model finds them, and map elements as it finds them."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from foredrive.scene.record import Record


@dataclass(frozen=True)
class Agents(Record):
    """M detected road users in the ego frame at now, with K modes of motion in S steps."""

    centre: Float[Tensor, "*b M 3"]
    """Box centre, m."""
    size_lwh: Float[Tensor, "*b M 3"]
    yaw: Float[Tensor, "*b M"]
    velocity: Float[Tensor, "*b M 2"]
    """Velocity over ground, in the axes of the ego frame, m/s."""
    category: Int[Tensor, "*b M"]
    """The most probable `Category`."""
    score: Float[Tensor, "*b M"]
    """Probability that there is an object of this category."""
    attribute: Int[Tensor, "*b M"]
    """The most probable `Attribute`."""
    track_id: Int[Tensor, "*b M"]
    """Identity within the drive; -1 without tracking."""
    future_xy: Float[Tensor, "*b M K S 2"] | None = None
    """Box centre at (step + 1) · `dt_s` after now, m. None without forecasts."""
    log_prob: Float[Tensor, "*b M K"] | None = None
    """Log-probability of each mode."""
    dt_s: float = 0.5


@dataclass(frozen=True)
class MapLines(Record):
    """E detected map elements in the ego frame at now, of P points each."""

    points: Float[Tensor, "*b E P 2"]
    """Points in order along the element, m."""
    kind: Int[Tensor, "*b E"]
    """An `ElementKind`."""
    score: Float[Tensor, "*b E"]
    """Probability, 0 to 1."""
