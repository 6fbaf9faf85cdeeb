"""Tracked 3-D boxes."""

import enum
from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.scene.record import Record


class Category(enum.IntEnum):
    """Classes of a box: those of the nuScenes detection task, animals, and everything else."""

    CAR = 0
    TRUCK = 1
    BUS = 2
    TRAILER = 3
    CONSTRUCTION_VEHICLE = 4
    MOTORCYCLE = 5
    BICYCLE = 6
    PEDESTRIAN = 7
    ANIMAL = 8
    TRAFFIC_CONE = 9
    BARRIER = 10
    OTHER = 11


@dataclass(frozen=True)
class Boxes(Record):
    """Boxes in the ego frame of their time step, padded to M. Padding has `valid` False.

    In a `Clip` the leading dimensions are [b T].
    """

    centre: Float[Tensor, "*b M 3"]
    """Box centre (not the bottom), ego frame, m."""
    size_lwh: Float[Tensor, "*b M 3"]
    """Length (along the heading), width, height, m."""
    yaw: Float[Tensor, "*b M"]
    """Heading about ego z, rad, 0 along ego x, counter-clockwise."""
    velocity: Float[Tensor, "*b M 2"]
    """Velocity over ground, in the axes of the ego frame, m/s. NaN where the log has none."""
    track_id: Int[Tensor, "*b M"]
    """Identity of the object, constant within one log."""
    category: Int[Tensor, "*b M"]
    """Index of the `Category`."""
    valid: Bool[Tensor, "*b M"]
