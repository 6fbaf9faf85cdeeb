"""Lanes of a log's map, to check whether a vehicle is on a lane."""

from collections.abc import Sequence

import numpy as np
import shapely
from jaxtyping import Float64

from foredrive.driving.lane_rules import OUTSIDE_BY_M


class LoggedLanes:
    """Area of all lanes. Their directions are not considered.

    Args:
        outlines: outlines of the lanes, m, world frame.
    """

    def __init__(self, outlines: Sequence[Float64[np.ndarray, "_ 2"]]) -> None:
        self._areas = shapely.STRtree([shapely.make_valid(shapely.Polygon(outline)) for outline in outlines])

    @property
    def area(self) -> shapely.Geometry:
        """Return the union of all lanes."""
        return shapely.union_all(self._areas.geometries)

    def outside(self, xy: Float64[np.ndarray, "2"]) -> bool:
        """Return whether a point is outside of all lanes, by CARLA's OutsideRouteLanesTest."""
        near = self._areas.query(shapely.Point(*xy), predicate="dwithin", distance=OUTSIDE_BY_M)
        return len(near) == 0
