"""The part of a map around the ego vehicle."""

import enum
from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.scene.record import Record


class MapKind(enum.IntEnum):
    """Kinds of polylines in a `MapPatch`. An area is given by its closed outline."""

    LANE_CENTRE = 0
    LANE_BOUNDARY = 1
    ROAD_EDGE = 2
    CROSSWALK = 3
    WALKWAY = 4
    STOP_ZONE = 5
    INTERSECTION = 6


@dataclass(frozen=True)
class MapPatch(Record):
    """P polylines of at most V vertices around the ego vehicle, in the ego frame at now."""

    vertices: Float[Tensor, "*b P V 3"]
    """Vertices, m. z is 0 where the map has no heights."""
    valid: Bool[Tensor, "*b P V"]
    kind: Int[Tensor, "*b P"]
    """A `MapKind`, or -1 for padding."""
