"""Foredrive's own routes, drawn from a seed and kept in the package's data file.

Those of the towns for training are trained on. Those of the unseen towns are driven to judge, and nothing is
chosen by what comes out. `python -m benchmarks.common.own_routes` draws all again and writes them there.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import NamedTuple

import numpy as np

from foredrive.driving.route_sets import SHIPPED, RouteWaypoints, shipped_sets, write_shipped
from foredrive.errors import InputError
from foredrive.towns.driving.routes import DriveRoute, RouteOption, snap_route
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.map.names import TILE_EDGE_M, TOWNS, is_held_out, tile_bounds_m
from foredrive.towns.traffic.fleet import find_start_points
from foredrive.towns.traffic.lane_graph import LaneGraph, build_lane_graph
from foredrive.towns.traffic.routes import Route, draw_route

CANDIDATES = 6
"""Number of candidates per route. The one with the most manoeuvres that the others lack is taken."""
WAYPOINT_AT = 0.75
"""Position of the waypoint on each lane, as a share of its length: behind a lane change, if there is one."""
CLEAR_OF_END_M = 3.0
APART_M = 300.0
"""A start this far from all others, m, is worth as much as a manoeuvre that no other route has."""


class RouteSetSpec(NamedTuple):
    """Places and lengths of the routes of a set."""

    towns: Mapping[str, int]
    """Number of routes in each town or tile."""
    min_m: float
    max_m: float


TILES = tuple(f"Town13_Tile_{x}_{y}" for x, y in ((14, -16), (-17, -18), (12, -8), (-9, 1), (11, -20)))
"""Tiles of the five districts of Town13, chosen on its plan."""
TRAINING = tuple(town for town in TOWNS if not is_held_out(town))
ROUTE_SETS = {
    "training-short": RouteSetSpec(dict.fromkeys(TRAINING, 8), 80.0, 150.0),
    "training-long": RouteSetSpec(dict.fromkeys(TRAINING, 3), 500.0, 1500.0),
    "unseen-short": RouteSetSpec({"Town15": 17, **dict.fromkeys(TILES, 3)}, 80.0, 150.0),
    "unseen-long": RouteSetSpec({"Town15": 5, **dict.fromkeys(TILES, 1)}, 500.0, 1500.0),
}


def draw_routes(town: str, spec: RouteSetSpec, seed: int = 0) -> list[RouteWaypoints]:
    """Draw the routes of a set in one town. They are spread over it.

    Turns, straight crossings and lane changes are mixed as evenly as possible.
    """
    graph = build_lane_graph(load_town_map(town))
    starts, rng = find_start_points(graph), np.random.default_rng((seed, *town.encode(), spec.towns[town]))
    chosen: list[tuple[RouteWaypoints, DriveRoute]] = []
    met: Counter[int] = Counter()
    while len(chosen) < spec.towns[town]:
        best, best_worth = None, -math.inf
        # Draw until one candidate is valid, then take the one that adds most
        while best is None:
            for _ in range(CANDIDATES):
                length_m = float(rng.uniform(spec.min_m, spec.max_m))
                drawn = draw_route(graph, starts, rng, length_m, from_s=0.0, until_s=math.inf)
                candidate = _checked(f"{town}-{len(chosen)}", town, graph, drawn, length_m, spec)
                worth = (
                    -math.inf
                    if candidate is None
                    else _worth(candidate[1], [route for _, route in chosen], met)
                )
                if worth > best_worth:
                    best, best_worth = candidate, worth
        chosen.append(best)
        met.update(_manoeuvres(best[1]))
    return [waypoints for waypoints, _ in chosen]


def _checked(
    name: str, town: str, graph: LaneGraph, drawn: Route, length_m: float, spec: RouteSetSpec
) -> tuple[RouteWaypoints, DriveRoute] | None:
    """Return a route as waypoints and as `snap_route` reads them.

    Returns None if there is no such route, if it takes another way, or if its length is out of range.
    """
    # Distance of the end of each lane from the start; the route ends on the last lane outside of junctions
    ends_m = np.append(0.0, np.cumsum(graph.length_m[drawn.lanes])) - drawn.start_m
    last = int(np.flatnonzero((ends_m[:-1] < length_m) & (graph.junction[drawn.lanes] < 0))[-1])
    lanes = drawn.lanes[: last + 1]
    # One waypoint per lane, late on it, so that a lane change on the lane lies before it
    at_m = WAYPOINT_AT * graph.length_m[lanes]
    at_m[-1] = min(length_m - ends_m[last], graph.length_m[lanes[-1]] - CLEAR_OF_END_M)
    first = graph.position(drawn.entered[:1], np.array([drawn.start_m]))
    # Waypoints of the first lane only count behind the start
    later = at_m > (drawn.start_m if last == 0 else 0.0)
    later[0] &= at_m[0] > drawn.start_m
    points = np.concatenate([first, graph.position(lanes, at_m)[later]])
    waypoints = RouteWaypoints(name, town, np.round(points, 2))
    try:
        route = snap_route(waypoints)
    except InputError:
        return None
    fits = spec.min_m <= route.length_m <= spec.max_m and _has_road_around(route)
    # The lanes that were drawn must all be on the way that the matching finds
    return (waypoints, route) if fits and set(lanes.tolist()) <= {leg.lane for leg in route.legs} else None


def _has_road_around(route: DriveRoute) -> bool:
    """Return whether a route keeps away from the edge of its tile."""
    bounds_m = tile_bounds_m(route.town)
    if bounds_m is None:
        return True
    lower, upper = np.array(bounds_m[:2]) + TILE_EDGE_M, np.array(bounds_m[2:]) - TILE_EDGE_M
    return bool(((route.xyz[:, :2] > lower) & (route.xyz[:, :2] < upper)).all())


def _worth(route: DriveRoute, others: Sequence[DriveRoute], met: Counter[int]) -> float:
    """Return the value that a route adds to others: manoeuvres that they lack, and a distant start."""
    # Rare manoeuvres count more: 1 / (1 + how often they occur so far)
    away_m = min((float(np.hypot(*(route.xyz[0] - o.xyz[0])[:2])) for o in others), default=0.0)
    return sum(1 / (1 + met[option]) for option in _manoeuvres(route)) + min(away_m / APART_M, 1.0)


def _manoeuvres(route: DriveRoute) -> set[int]:
    return set(route.option.tolist()) - {int(RouteOption.FOLLOW)}


def main() -> None:
    """Draw these sets anew and write the data file. All other sets stay as they are."""
    sets: dict[str, Sequence[RouteWaypoints]] = dict(shipped_sets())
    for name, spec in ROUTE_SETS.items():
        sets[name] = [route for town in spec.towns for route in draw_routes(town, spec)]
    write_shipped(Path(str(resources.files("foredrive.driving").joinpath(SHIPPED))), sets)


if __name__ == "__main__":
    main()
