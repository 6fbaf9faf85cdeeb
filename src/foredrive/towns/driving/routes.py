"""Routes to drive: waypoints are matched to lanes and joined into a line with an option at each point."""

import enum
import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int

from foredrive.driving.route_sets import RouteWaypoints
from foredrive.errors import InputError
from foredrive.geometry.polylines import arc_lengths
from foredrive.towns.driving.lane_search import Leg, find_way
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.map.names import tile_around
from foredrive.towns.traffic.lane_graph import TURN_RAD, LaneGraph, build_lane_graph
from foredrive.towns.traffic.routes import MIN_CHANGE_M, PLANNED_CHANGE_S

SAMPLE_M, SPACING_M = 0.5, 0.75
"""Spacing at which lanes are sampled, and minimum spacing of the points that are kept, m."""


class RouteOption(enum.IntEnum):
    """Manoeuvre that a route asks for at a point, as CARLA's road options."""

    LEFT = 0
    RIGHT = 1
    STRAIGHT = 2
    """Go straight through a junction."""
    FOLLOW = 3
    """Follow the lane, outside of junctions."""
    CHANGE_LEFT = 4
    CHANGE_RIGHT = 5


@dataclass(frozen=True, eq=False)
class DriveRoute:
    """A route along the lanes of a town: a line of N points about a metre apart."""

    id: str
    town: str
    xyz: Float64[np.ndarray, "N 3"]
    """Points on the road, m, world frame."""
    arc_m: Float64[np.ndarray, "N"]
    """Distance from the start to each point, m, in the plane."""
    option: Int[np.ndarray, "N"]
    """A `RouteOption` at each point, derived from the route only."""
    legs: tuple[Leg, ...]
    """Lanes of the route, as indices into the town's lane graph."""
    aside_m: float
    """Largest distance between a waypoint and its lane, m."""

    @property
    def length_m(self) -> float:
        """Return the length from the first waypoint to the last, m."""
        return float(self.arc_m[-1])

    @property
    def lanes(self) -> tuple[int, ...]:
        """Return the lane at the end of each stretch of road, as the traffic expects it of vehicle 0."""
        ends = [leg.lane for leg, onward in itertools.pairwise(self.legs) if not onward.changes]
        return (*ends, self.legs[-1].lane)


def snap_route(waypoints: RouteWaypoints) -> DriveRoute:
    """Compute the route through some waypoints. This takes 0.1 s, plus the loading of the town's map.

    In a large town it is a route of the tile around it.

    Raises:
        InputError: there is no such town, no way through the waypoints, or they are too far apart for a tile.
            The error names the route.
    """
    try:
        town = tile_around(waypoints.town, waypoints.xyz_m[:, :2])
        graph = build_lane_graph(load_town_map(town))
        legs, places = find_way(graph, waypoints.xyz_m)
    except InputError as error:
        raise InputError(f"route {waypoints.id} in {waypoints.town}: {error}") from None
    xyz, option = route_line(graph, legs)
    arc_m = arc_lengths(xyz[:, :2])
    aside_m = max(place.aside_m for place in places)
    return DriveRoute(waypoints.id, town, xyz, arc_m, option, tuple(legs), aside_m)


def route_line(graph: LaneGraph, legs: list[Leg]) -> tuple[Float64[np.ndarray, "N 3"], Int[np.ndarray, "N"]]:
    """Return the points along some legs and the option at each point.

    Where the legs change lanes, the line moves smoothly from one lane to the other.
    """
    # Points of all legs, with the leg of each
    points, leg_of = _sampled(graph, legs)
    steps = np.append(0.0, np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1))
    begins = np.append(True, np.diff(leg_of) > 0)
    steps[begins] = 0.0  # a lane change adds no length
    # At a lane change, the next leg begins beside the end of the last one: no distance is driven
    arc_m = np.cumsum(steps)
    option = np.full(len(points), int(RouteOption.FOLLOW))
    left = _left_of(points, leg_of)
    shift_m = np.zeros(len(points))
    inside = np.array([graph.junction[leg.lane] >= 0 for leg in legs])
    # Runs of legs inside and outside of junctions alternate: turns there, lane changes here
    for in_junction, run in itertools.groupby(range(len(legs)), key=lambda k: bool(inside[k])):
        of_run = list(run)
        on_run = (leg_of >= of_run[0]) & (leg_of <= of_run[-1])
        if in_junction:
            option[on_run] = _turn(graph, [legs[k] for k in of_run])
            continue
        # The shift to the new lane is spread over a window instead of a step at the leg's start
        for change, from_m, to_m in _windows(graph, legs, of_run, arc_m, leg_of):
            index = int(np.argmax(leg_of == change))
            aside_m = legs[change].changes * float(np.linalg.norm((points[index] - points[index - 1])[:2]))
            # Quintic 0 → 1 over the window, minus the step that the points make themselves
            x = np.clip((arc_m - from_m) / max(to_m - from_m, 1e-6), 0.0, 1.0)
            led = x**3 * (10 - 15 * x + 6 * x**2)
            shift_m += aside_m * (led - (np.arange(len(points)) >= index))
            sign = RouteOption.CHANGE_LEFT if aside_m > 0 else RouteOption.CHANGE_RIGHT
            option[(arc_m >= from_m) & (arc_m <= to_m) & on_run] = sign
    points[:, :2] += shift_m[:, None] * left
    kept = _thinned(points[:, :2])
    return points[kept], option[kept]


def _sampled(graph: LaneGraph, legs: list[Leg]) -> tuple[Float64[np.ndarray, "N 3"], Int[np.ndarray, "N"]]:
    """Sample points along each leg, including both ends. Return the points and the leg index of each."""
    points, leg_of = [], []
    for number, leg in enumerate(legs):
        count = max(2, int(np.ceil((leg.to_m - leg.from_m) / SAMPLE_M)) + 1)
        s = np.linspace(leg.from_m, leg.to_m, count)
        points.append(graph.position(np.full(count, leg.lane), s))
        leg_of.append(np.full(count, number))
    return np.concatenate(points), np.concatenate(leg_of)


def _thinned(xy: Float64[np.ndarray, "N 2"]) -> list[int]:
    """Return the indices of points that are at least `SPACING_M` apart, always with both ends.

    The points may step back at lane changes.
    """
    kept = [0]
    for k in range(1, len(xy)):
        if np.hypot(*(xy[k] - xy[kept[-1]])) >= SPACING_M:
            kept.append(k)
    # The end point replaces the last point kept, so that the spacing does not fall short there
    if len(kept) > 1:
        kept.pop()
    return [*kept, len(xy) - 1]


def _left_of(points: Float64[np.ndarray, "N 3"], leg_of: Int[np.ndarray, "N"]) -> Float64[np.ndarray, "N 2"]:
    """Return the unit vector to the left of the lane at each point."""
    left = np.zeros((len(points), 2))
    for leg in range(leg_of[-1] + 1):
        on = np.flatnonzero(leg_of == leg)
        # Direction by central differences within one leg; legs of a change do not line up
        dx, dy = np.gradient(points[on, :2], axis=0).T
        left[on] = np.stack([-dy, dx], axis=1) / np.hypot(dx, dy).clip(1e-9)[:, None]
    return left


def _turn(graph: LaneGraph, legs: list[Leg]) -> RouteOption:
    """Return the turn that legs through a junction make."""
    turn_rad = sum(float(graph.turn_rad[leg.lane]) for leg in legs)
    if abs(turn_rad) < TURN_RAD:
        return RouteOption.STRAIGHT
    return RouteOption.LEFT if turn_rad > 0 else RouteOption.RIGHT


def _windows(
    graph: LaneGraph,
    legs: list[Leg],
    run: list[int],
    arc_m: Float64[np.ndarray, "N"],
    leg_of: Int[np.ndarray, "N"],
) -> list[tuple[int, float, float]]:
    """Return, for each lane change on a run of legs outside of junctions, its leg and its start and end, m.

    Each change has the length of a gentle lane change if the run is long enough. Changes follow one another
    and end before the run does.
    """
    changes = [k for k in run if legs[k].changes]
    on_run = (leg_of >= run[0]) & (leg_of <= run[-1])
    first_m, last_m = float(arc_m[on_run][0]), float(arc_m[on_run][-1])
    # Wanted lengths, scaled down together if the run is too short for all of them
    wanted = [max(MIN_CHANGE_M, PLANNED_CHANGE_S * float(graph.limit_mps[legs[k].lane])) for k in changes]
    scale = min(1.0, (last_m - first_m) / sum(wanted)) if wanted else 1.0
    windows, free_m = [], first_m
    room_after = [scale * sum(wanted[j + 1 :]) for j in range(len(wanted))]
    for k, length_m, after_m in zip(changes, wanted, room_after, strict=True):
        length_m *= scale
        centre_m = float(arc_m[np.argmax(leg_of == k)])
        # Around the middle of the change, but after the last one and with room for those that follow
        from_m = max(free_m, min(centre_m - 0.5 * length_m, last_m - after_m - length_m))
        free_m = from_m + length_m
        windows.append((k, from_m, free_m))
    return windows
