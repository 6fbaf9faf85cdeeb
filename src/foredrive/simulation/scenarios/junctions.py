"""Scenarios in junctions: oncoming traffic and red light runners."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64

from foredrive.simulation.scenarios.road_context import RoadContext, Stretch, arc_m, onward
from foredrive.simulation.scenarios.scenario import Scenario, ScenarioKind, Way
from foredrive.towns.traffic.lane_graph import TURN_RAD, LaneControl, LaneGraph

UPSTREAM_M, MIN_UPSTREAM_M = 120.0, 62.0
"""Length of straight approach for the other vehicles, m: wanted, and minimum."""
AHEAD_COS, ACROSS_COS = -0.7, 0.7
MIN_APPROACH_M, MIN_THROUGH_MPS = 50.0, 4.5
"""If the ego vehicle's approach is shorter, m, or its turn is slower, m/s, its arrival cannot be predicted
in time."""
MEET_M = 2.0
"""Two lanes cross if their centrelines come this near to each other, m."""


def at_junctions(road: RoadContext, stretches: list[Stretch]) -> Iterator[Scenario]:
    """Yield oncoming traffic at left turns, and red light runners from the side at lights."""
    graph = road.graph
    heading = _start_headings(graph)
    for leg, from_m, to_m in stretches:
        lane = leg.lane
        if graph.junction[lane] < 0 or from_m < 1.0:
            continue
        ways: dict[ScenarioKind, list[tuple[float, Way]]] = {}
        for other in np.unique(_conflicting(graph, lane)).tolist():
            facing = float(np.cos(heading[other] - heading[lane]))
            lit = graph.control[lane] == LaneControl.LIGHT and graph.control[other] == LaneControl.LIGHT
            guarded = graph.control[[lane, other]].max() > LaneControl.LIGHT
            if abs(graph.turn_rad[other]) > TURN_RAD or guarded:
                continue
            if graph.turn_rad[lane] > TURN_RAD and facing < AHEAD_COS:
                kind = ScenarioKind.ONCOMING_TRAFFIC
            elif lit and abs(facing) < ACROSS_COS:
                kind = ScenarioKind.RED_LIGHT_RUNNER
            else:
                continue
            met = _met(road, lane, other, 0.5 * (from_m + to_m))
            if met is not None:
                ways.setdefault(kind, []).append(met)
        limit = float(graph.limit_mps[lane])
        for kind, found in ways.items():
            first_m = min(at_m for at_m, _ in found)
            nearest = tuple(way for at_m, way in found if at_m < first_m + MEET_M)
            through = float(graph.speed_mps[graph.first[lane] : graph.first[lane] + graph.count[lane]].min())
            predictable = first_m > MIN_APPROACH_M and through > MIN_THROUGH_MPS
            if kind is ScenarioKind.RED_LIGHT_RUNNER and not predictable:
                continue
            yield Scenario(kind, first_m, limit, through, nearest, ego_lane=lane)


def _conflicting(graph: LaneGraph, lane: int) -> np.ndarray:
    return graph.conflicts.other[graph.conflicts.first[lane] : graph.conflicts.first[lane + 1]]


def _start_headings(graph: LaneGraph) -> Float64[np.ndarray, "L"]:
    step = graph.xyz[graph.first + 1] - graph.xyz[graph.first]
    return np.asarray(np.arctan2(step[:, 1], step[:, 0]))


def _met(road: RoadContext, lane: int, other: int, about_m: float) -> tuple[float, Way] | None:
    """Return where the route meets another lane, m, and a way along that lane.

    Returns None if they do not meet or the approach is too short.
    """
    graph = road.graph
    mine, theirs = graph.samples(lane), graph.samples(other)
    apart_m = np.hypot(*(mine[:, None, :2] - theirs[None, :, :2]).transpose(2, 0, 1))
    i, j = np.unravel_index(int(np.argmin(apart_m)), apart_m.shape)
    before = _upstream(graph, other)
    upstream_m = float(graph.length_m[before].sum())
    if apart_m[i, j] > MEET_M or upstream_m < MIN_UPSTREAM_M:
        return None
    meet_m = upstream_m + float(j * graph.step_m[other])
    way = Way((*before, other, *onward(graph, other)), meet_m, upstream_m)
    return arc_m(road.route, mine[i], about_m), way


def _upstream(graph: LaneGraph, lane: int) -> list[int]:
    """Return the lanes that lead straight to a lane, the furthest first."""
    before: list[int] = []
    length_m = 0.0
    while length_m < UPSTREAM_M:
        options = graph.predecessors[before[0] if before else lane]
        options = options[options >= 0]
        if not len(options):
            break
        straightest = int(options[np.argmin(np.abs(graph.turn_rad[options]))])
        if abs(graph.turn_rad[straightest]) > TURN_RAD:
            break
        before.insert(0, straightest)
        length_m += float(graph.length_m[straightest])
    while before and graph.contested[before[0]]:
        before.pop(0)
    return before
