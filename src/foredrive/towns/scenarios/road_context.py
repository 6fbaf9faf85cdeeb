"""Places along a route: its lanes, its points and its headings."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from foredrive.geometry.polylines import points_at
from foredrive.towns.driving.lane_search import Leg
from foredrive.towns.driving.routes import DriveRoute
from foredrive.towns.traffic.lane_graph import LaneGraph
from foredrive.towns.traffic.lane_index import LaneIndex
from foredrive.towns.world import World

AROUND_M = 25.0
"""Search radius around the expected position on the route, m: routes may cross themselves."""
ONWARD_LANES = 4


class Stretch(NamedTuple):
    """Part of a route on one lane."""

    leg: Leg
    from_m: float
    """Start on the route, m."""
    to_m: float


class RoadContext(NamedTuple):
    """The route and the town in which scenarios are searched."""

    route: DriveRoute
    graph: LaneGraph
    near: LaneIndex
    world: World


def stretches_of(road: RoadContext) -> list[Stretch]:
    """Return the route's legs with their start and end on the route."""
    route, graph, at_m, stretches = road.route, road.graph, 0.0, []
    for leg in route.legs:
        ends = graph.position(np.array([leg.lane, leg.lane]), np.array([leg.from_m, leg.to_m]))
        # Both ends of the leg on the route, searched from the end of the last one
        from_m = arc_m(route, ends[0], at_m)
        at_m = arc_m(route, ends[1], from_m + leg.to_m - leg.from_m)
        stretches.append(Stretch(leg, from_m, at_m))
    return stretches


def arc_m(route: DriveRoute, xyz: Float64[np.ndarray, "3"], about_m: float) -> float:
    """Return the position on the route, m, that is nearest to a point, searched around `about_m`."""
    away_m = np.hypot(*(route.xyz[:, :2] - xyz[:2]).T)
    # Only points near the expected position: routes may cross themselves
    away_m[np.abs(route.arc_m - about_m) > AROUND_M] = np.inf
    return float(route.arc_m[np.argmin(away_m)]) if np.isfinite(away_m).any() else about_m


def pose(route: DriveRoute, at_m: float) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "2"]]:
    """Return a point of the route, m, and the unit vector of its heading there."""
    # Heading from 1.5 m before to 1.5 m after
    xyz, before, after = (points_at(route.xyz, route.arc_m, at_m + ds) for ds in (0.0, -1.5, 1.5))
    step = (after - before)[:2]
    return xyz, step / np.hypot(*step)


def onward(graph: LaneGraph, lane: int) -> list[int]:
    """Return the lanes that lead straight on from a lane."""
    lanes = [lane]
    for _ in range(ONWARD_LANES):
        options = graph.successors[lanes[-1], : graph.successor_count[lanes[-1]]]
        if not len(options):
            break
        # The straightest successor each time
        lanes.append(int(options[np.argmin(np.abs(graph.turn_rad[options]))]))
    return lanes[1:]
