"""Lane search: maps waypoints to the lane graph and finds the shortest way through all of them."""

import enum
import heapq
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from foredrive.errors import InputError
from foredrive.towns.traffic.lane_graph import LaneGraph
from foredrive.towns.traffic.leaders import project_to_neighbour

ALSO_NEAR, ALSO_NEAR_M, NO_FURTHER_M = 3.0, 1.0, 20.0
"""A waypoint may mean any lane up to `ALSO_NEAR` times as far away as the nearest one, plus `ALSO_NEAR_M`.
The lane may be no more than `NO_FURTHER_M` (plus `ALSO_NEAR_M`) further away than the nearest. Lanes cross
and merge, and waypoints beside the road (those of Town05 short) do not say which of its lanes they mean."""
ASIDE_WEIGHT = 5.0
"""A metre between lane and waypoint costs as much as this many metres of driving."""
BACK_M = 0.5
"""A waypoint may lie this far behind the last one on the same lane, m: both are rounded."""
CHANGE_M, HURRIED_M2, CLOSED_M = 10.0, 250.0, 50.0
"""Cost of a lane change in metres of detour. Each change costs `CHANGE_M` plus `HURRIED_M2` / room,
because hurried changes are worse. A change that traffic would not make costs `CLOSED_M` more: over solid
lines, and to lanes that only begin there."""
MIN_ROOM_M = 1.0
"""Lane changes need at least this much room, m."""


class LanePoint(NamedTuple):
    """A point on the lane graph."""

    lane: int
    s_m: float
    """Arc length on the lane, m."""
    aside_m: float
    """Distance between the waypoint and the lane, m."""


@dataclass(frozen=True)
class Leg:
    """Part of a way: along one lane, from one arc length to another (both m)."""

    lane: int
    from_m: float
    to_m: float
    changes: int = 0
    """Start of the leg: 0 continues from the lane before, 1 is a change to the left (from the lane to
    the right), -1 is a change to the right (from the lane to the left)."""


class _Part(enum.IntEnum):
    """Position of a lane within a way.

    The end point matters on the last part, the start point on the first part.
    """

    FIRST = 0
    BETWEEN = 1
    LAST = 2


_Node = tuple[int, _Part]


def places_near(graph: LaneGraph, xyz: Float64[np.ndarray, "3"]) -> list[LanePoint]:
    """Return the places on the graph that a waypoint may mean: on the nearest lane and others nearby."""
    distance = np.linalg.norm(graph.xyz - xyz, axis=1)
    # Shortest distance to the samples of each lane; half a step
    # of slack because the lane lies between samples
    nearest = np.minimum.reduceat(distance, graph.first)
    places = []
    for lane in np.flatnonzero(
        nearest <= ALSO_NEAR * nearest.min() + ALSO_NEAR_M + graph.step_m.max()
    ).tolist():
        line = graph.samples(lane)
        start, along = line[:-1], np.diff(line, axis=0)
        # Foot of the perpendicular on each segment, clamped to the segment
        part = np.einsum("ni,ni->n", xyz - start, along) / np.einsum("ni,ni->n", along, along)
        part = np.clip(part, 0.0, 1.0)
        off = np.linalg.norm(start + part[:, None] * along - xyz, axis=1)
        k = int(np.argmin(off))
        places.append(LanePoint(lane, float((k + part[k]) * graph.step_m[lane]), float(off[k])))
    min_aside_m = min(place.aside_m for place in places)
    return [place for place in places if place.aside_m <= _max_aside_m(min_aside_m)]


def _max_aside_m(min_m: float) -> float:
    """Return the maximum distance of lanes that a waypoint may mean, m, given that of the nearest."""
    return min(ALSO_NEAR * min_m, min_m + NO_FURTHER_M) + ALSO_NEAR_M


def find_way(graph: LaneGraph, waypoints: Float64[np.ndarray, "W 3"]) -> tuple[list[Leg], list[LanePoint]]:
    """Find the shortest way through all waypoints in order, and the place of each waypoint on it.

    Among the places that each waypoint may mean, the search takes those that make the whole way shortest, as
    map matching does (Newson & Krumm 2009). A waypoint within a junction does not say which way through the
    junction it means.

    Raises:
        InputError: there are fewer than two waypoints, or a waypoint cannot be reached from those before it.
    """
    if len(waypoints) < 2:
        raise InputError(f"a route needs at least two waypoints, got {len(waypoints)}")
    # Dynamic programming over the waypoints: the cheapest way to each place of the present waypoint
    choices = [places_near(graph, xyz) for xyz in waypoints]
    ways: list[list[Leg]] = [[] for _ in choices[0]]
    places = [[place] for place in choices[0]]
    costs = [ASIDE_WEIGHT * place.aside_m for place in choices[0]]
    for number, (before, here) in enumerate(itertools.pairwise(choices), start=1):
        is_last = number == len(choices) - 1
        candidates: list[tuple[float, int, list[Leg]]] = []
        for end in here:  # of the last waypoint only the cheapest place counts
            max_cost = min((total for total, *_ in candidates), default=np.inf) if is_last else np.inf
            candidates.append(_best_onto(graph, before, costs, end, max_cost))
        if not any(np.isfinite(total) for total, *_ in candidates):
            raise InputError(f"no lanes lead from waypoint {number} to waypoint {number + 1}")
        # Extend the best way to the predecessor place that each place chose
        ways = [joined(ways[b], legs) for _, b, legs in candidates]
        places = [[*places[b], end] for (_, b, _), end in zip(candidates, here, strict=True)]
        costs = [total for total, *_ in candidates]
    chosen = int(np.argmin(costs))
    return ways[chosen], places[chosen]


def _best_onto(
    graph: LaneGraph, starts: Sequence[LanePoint], costs: Sequence[float], end: LanePoint, max_cost: float
) -> tuple[float, int, list[Leg]]:
    """Find the cheapest way to `end` from one of several start places with known costs.

    Returns the cost, which includes both places, the index of the start place, and the legs. The cost is
    infinite if no way costs less than `max_cost`. The most promising start places are searched first.
    """
    index, s_m = np.array([place.lane for place in (end, *starts)]), [place.s_m for place in (end, *starts)]
    here, *targets = graph.position(index, np.array(s_m))
    # Lower bound of each start: its cost plus the straight distance, so the search can stop early
    aside = ASIDE_WEIGHT * end.aside_m
    promised = aside - BACK_M + np.array(costs) + np.linalg.norm(np.array(targets) - here, axis=1)
    best: tuple[float, int, list[Leg]] = (np.inf, 0, [])
    for b in np.argsort(promised).tolist():
        if promised[b] >= min(max_cost, best[0]):
            break
        cost, legs = _shortest(graph, starts[b], end, min(max_cost, best[0]) - aside - costs[b])
        best = min(best, (aside + costs[b] + cost, b, legs), key=lambda item: item[0])
    return best


def joined(first: Sequence[Leg], second: Sequence[Leg]) -> list[Leg]:
    """Join two ways. The second must begin where the first ends."""
    if not first or not second or first[-1].lane != second[0].lane:
        return [*first, *second]
    middle = Leg(first[-1].lane, first[-1].from_m, second[0].to_m, first[-1].changes)
    return [*first[:-1], middle, *second[1:]]


def _shortest(graph: LaneGraph, start: LanePoint, end: LanePoint, max_m: float) -> tuple[float, list[Leg]]:
    """Find the cheapest way from one place to another (Dijkstra 1959).

    Returns its cost and its legs. The cost is infinite if no way costs less than `max_m`. A node of the
    search is a lane together with its part of the way. The cost of a node is the cost to the beginning of its
    lane.
    """
    first, goals = (start.lane, _Part.FIRST), [(end.lane, _Part.LAST)]
    # On one stretch of road the end may be reached without leaving the first part of the way
    if (straight := _legs(graph, start, end, _beside(graph, start.lane, end.lane))) is not None:
        goals.append((end.lane, _Part.FIRST))
    # The cost of a node refers to the beginning of its lane, so the start counts backwards
    cost: dict[_Node, float] = {first: -start.s_m}
    came_from: dict[_Node, _Node] = {}
    done: set[_Node] = set()
    queue: list[tuple[float, _Node]] = [(-start.s_m, first)]
    while queue:
        so_far, node = heapq.heappop(queue)
        # The first goal taken from the queue is the cheapest one
        if node in goals:
            break
        if node in done:
            continue
        done.add(node)
        for onward, price in _steps(graph, node, start, end):
            # Prune what is not better than known or exceeds the bound
            if so_far + price < min(cost.get(onward, np.inf), max_m):
                cost[onward], came_from[onward] = so_far + price, node
                heapq.heappush(queue, (so_far + price, onward))
    else:
        return np.inf, []
    if node == (end.lane, _Part.FIRST) and straight is not None:
        return so_far + end.s_m, straight
    # Follow the predecessors back to the start
    lanes = [node[0]]
    while node != first:
        node = came_from[node]
        lanes.append(node[0])
    legs = _legs(graph, start, end, lanes[::-1])
    return (np.inf, []) if legs is None else (so_far + end.s_m, legs)


def _steps(graph: LaneGraph, node: _Node, start: LanePoint, end: LanePoint) -> Iterator[tuple[_Node, float]]:
    """Yield the nodes that can be reached from a node, and the cost of each step."""
    lane, part = node
    length_m = float(graph.length_m[lane])
    if part is not _Part.LAST:
        # Onto a successor, which may or may not be the last lane of the way
        for onward in graph.successors[lane, : graph.successor_count[lane]].tolist():
            yield (onward, _Part.BETWEEN), length_m
            yield (onward, _Part.LAST), length_m
    # Room for a lane change on this part; in junctions lanes are not changed
    room_m = {_Part.FIRST: length_m - start.s_m, _Part.BETWEEN: length_m, _Part.LAST: end.s_m}[part]
    if room_m < MIN_ROOM_M or graph.junction[lane] >= 0:
        return
    for beside, may_cross in zip(graph.sides.lane[:, lane], graph.may_cross[:, lane], strict=True):
        if beside >= 0:
            closed_m = 0.0 if may_cross else CLOSED_M
            yield (int(beside), part), CHANGE_M + HURRIED_M2 / room_m + closed_m


def _beside(graph: LaneGraph, first: int, last: int) -> list[int]:
    """Return the lanes between `first` and `last`, which lie side by side. Only `first` if they do not."""
    for side in (0, 1):
        lanes = [first]
        while lanes[-1] != last and graph.sides.lane[side, lanes[-1]] >= 0:
            lanes.append(int(graph.sides.lane[side, lanes[-1]]))
        if lanes[-1] == last:
            return lanes
    return [first]


def _legs(graph: LaneGraph, start: LanePoint, end: LanePoint, lanes: list[int]) -> list[Leg] | None:
    """Return the legs along lanes that follow each other or lie side by side.

    Returns None if they do not lead to the end. Lane changes are spread evenly over the part of the road that
    is driven.
    """
    if lanes[-1] != end.lane:
        return None
    # Group lanes side by side: within a stretch, lanes are
    # changed, between stretches they follow each other
    stretches: list[list[int]] = [[lanes[0]]]
    for before, lane in itertools.pairwise(lanes):
        if lane in graph.successors[before, : graph.successor_count[before]]:
            stretches.append([lane])
        else:
            stretches[-1].append(lane)
    legs: list[Leg] = []
    for number, stretch in enumerate(stretches):
        at_m, side = (start.s_m if number == 0 else 0.0), 0
        for k, lane in enumerate(stretch):
            until_m = float(graph.length_m[lane])
            if number == len(stretches) - 1:
                # On the last stretch the way ends beside the end point
                until_m = _opposite(graph, end, stretch[k:])
            changes = len(stretch) - 1 - k
            if k == 0 and until_m - at_m < (MIN_ROOM_M if changes else -BACK_M):
                return None
            # When there are several lanes, the first and the last are driven half as long as those between.
            share = 1.0 if not changes else 0.5 / (changes if k == 0 else changes + 0.5)
            to_m = max(at_m, at_m + share * (until_m - at_m))
            legs.append(Leg(lane, at_m, to_m, side))
            if changes:
                side = 1 if graph.left[lane] == stretch[k + 1] else -1
                # Continue beside the point where the lane was left
                at_m = float(project_to_neighbour(lane, to_m, side, graph.sides))
    return legs


def _opposite(graph: LaneGraph, end: LanePoint, lanes: list[int]) -> float:
    """Return the arc length on the first of several lanes side by side, next to the end on the last."""
    # Project the end point from lane to lane, back to the first one
    at_m = end.s_m
    for lane, before in itertools.pairwise(reversed(lanes)):
        at_m = project_to_neighbour(lane, at_m, 1 if graph.left[lane] == before else -1, graph.sides)
    return float(at_m)
