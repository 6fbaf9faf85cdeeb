"""Lanes of a log's map, to tell whether a vehicle is on any of them."""

from collections.abc import Sequence

import numpy as np
import shapely
from jaxtyping import Float64

from foredrive.simulation.lane_rules import OUTSIDE_BY_M


class LoggedLanes:
    """The area of all lanes; which way they lead is not looked at.

    Args:
        outlines: world frame, m.
    """

    def __init__(self, outlines: Sequence[Float64[np.ndarray, "V 2"]]) -> None:
        self._areas = shapely.STRtree([shapely.make_valid(shapely.Polygon(outline)) for outline in outlines])

    def outside(self, xy: Float64[np.ndarray, "2"]) -> bool:
        """Whether a point is further beside all lanes than CARLA's OutsideRouteLanesTest lets pass."""
        near = self._areas.query(shapely.Point(*xy), predicate="dwithin", distance=OUTSIDE_BY_M)
        return len(near) == 0
