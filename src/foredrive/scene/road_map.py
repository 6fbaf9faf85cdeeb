"""The roads around a drive as areas: the parts of a map that judges need."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

Outline = Float64[np.ndarray, "_ 2"]
"""Closed polygon without its last vertex, m, world frame."""


@dataclass(frozen=True, eq=False)
class RoadMap:
    """Areas of a map in the plane of the world."""

    lanes: tuple[Outline, ...]
    on_route: tuple[bool, ...]
    """Whether each lane belongs to the route: those that the drive follows, and those beside them in the same
    direction."""
    drivable: tuple[Outline, ...]
    """Areas in which a vehicle may drive: groups of lanes, intersections, car parks. They may overlap."""
    intersections: tuple[Outline, ...]
    centreline: Float64[np.ndarray, "N 2"]
    """Middle of the route's lanes, from before the start to behind the end of what is judged."""
