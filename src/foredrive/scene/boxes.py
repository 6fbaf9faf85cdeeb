"""Tracked 3-D boxes."""

import enum
from dataclasses import dataclass

import torch
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


VEHICLES = frozenset(
    {
        Category.CAR,
        Category.TRUCK,
        Category.BUS,
        Category.TRAILER,
        Category.CONSTRUCTION_VEHICLE,
        Category.MOTORCYCLE,
        Category.BICYCLE,
    }
)
"""The seven vehicle classes of nuScenes' detection task, on which UniAD judges motion and occupancy."""

UNKNOWN = -1
"""Value of `num_points`, `attribute` and `visibility` where a log has none."""


class Attribute(enum.IntEnum):
    """nuScenes' attributes of vehicles, two-wheelers and pedestrians. `label` is the devkit's name."""

    VEHICLE_MOVING = 0
    VEHICLE_PARKED = 1
    """At rest for longer, without intent to move."""
    VEHICLE_STOPPED = 2
    """At rest with a driver who intends to move."""
    CYCLE_WITH_RIDER = 3
    CYCLE_WITHOUT_RIDER = 4
    PEDESTRIAN_MOVING = 5
    PEDESTRIAN_STANDING = 6
    PEDESTRIAN_SITTING_LYING_DOWN = 7

    @property
    def label(self) -> str:
        """Return the name in nuScenes' files, such as "vehicle.moving"."""
        return self.name.lower().replace("_", ".", 1)


class Visibility(enum.IntEnum):
    """nuScenes' levels of the share of an object that is visible in all images together."""

    V0_40 = 1
    V40_60 = 2
    V60_80 = 3
    V80_100 = 4


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
    num_points: Int[Tensor, "*b M"]
    """Number of lidar returns from the object, or `UNKNOWN`."""
    attribute: Int[Tensor, "*b M"]
    """An `Attribute`, or `UNKNOWN`."""
    visibility: Int[Tensor, "*b M"]
    """A `Visibility`, or `UNKNOWN`."""


def unlabelled(*shape: int, device: torch.device | str | None = None) -> dict[str, Tensor]:
    """Return the fields of `Boxes` that a log may lack, each of the given shape and unknown everywhere."""
    names = ("num_points", "attribute", "visibility")
    return {name: torch.full(shape, UNKNOWN, device=device) for name in names}
