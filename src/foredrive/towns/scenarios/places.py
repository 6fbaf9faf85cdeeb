"""Finds the scenarios that a route allows, and draws some of them from a seed."""

import dataclasses
import itertools
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float64

from foredrive.scene import Category
from foredrive.towns.driving.routes import DriveRoute
from foredrive.towns.scenarios.crossings import beside_parked, crossing
from foredrive.towns.scenarios.kinematics import SPARE_M, stopping_m
from foredrive.towns.scenarios.road_context import RoadContext, Stretch, arc_m, onward, stretches_of
from foredrive.towns.scenarios.scenario import ENDS_BEFORE, Scenario, ScenarioKind, Way
from foredrive.towns.scenarios.vehicles import can_drive_ahead, can_stand
from foredrive.towns.traffic.lane_graph import TURN_RAD, LaneControl, LaneGraph, build_lane_graph
from foredrive.towns.traffic.lane_index import build_lane_index
from foredrive.towns.traffic.leaders import project_to_neighbour
from foredrive.towns.traffic.scripted_actors import FIRST_TRACK_ID
from foredrive.towns.world import World

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
    # Only lanes inside junctions that the route does not begin in
    for leg, from_m, to_m in stretches:
        lane = leg.lane
        if graph.junction[lane] < 0 or from_m < 1.0:
            continue
        # Other lanes that cross this one, by the kind of scenario that they allow
        ways: dict[ScenarioKind, list[tuple[float, Way]]] = {}
        for other in np.unique(_conflicting(graph, lane)).tolist():
            facing = float(np.cos(heading[other] - heading[lane]))
            # Both lanes have lights; at stop and yield signs there is no such scenario
            lit = graph.control[lane] == LaneControl.LIGHT and graph.control[other] == LaneControl.LIGHT
            guarded = graph.control[[lane, other]].max() > LaneControl.LIGHT
            if abs(graph.turn_rad[other]) > TURN_RAD or guarded:
                continue
            # Against each other and turning left: oncoming. Across at a light: red light runner
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
        # The first meeting point counts, with all ways that meet about there
        for kind, ways_of_kind in ways.items():
            first_m = min(at_m for at_m, _ in ways_of_kind)
            nearest = tuple(way for at_m, way in ways_of_kind if at_m < first_m + MEET_M)
            # Speed of the ego vehicle in its turn
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
    # Nearest pair of samples of both lanes
    apart_m = np.hypot(*(mine[:, None, :2] - theirs[None, :, :2]).transpose(2, 0, 1))
    i, j = np.unravel_index(int(np.argmin(apart_m)), apart_m.shape)
    # The other vehicle needs a straight approach of some length
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
    # It may not begin on a contested lane
    while before and graph.contested[before[0]]:
        before.pop(0)
    return before


FIRST_M, CLEAR_OF_END_M = 28.0, 8.0
"""Lengths at the route's beginning and end without scenarios, m."""
APART_M, STAGED_APART_M = 80.0, 120.0
"""Minimum distance between scenarios, m. Scenarios with vehicles need more, as these must approach out of
sight."""
CHOICE_M = 70.0
"""One scenario is drawn among those within this distance on the route, m, of the kind that is rarest so
far."""
CROSSING_EVERY_M = 9.0
AFTER_TURN_M, SEEN_AFTER_TURN_M = 9.0, 8.0
"""Distance of a crossing behind a turn, m, and the distance before it from which it must be visible, m."""
BEHIND_CORNER_M = 16.0
"""Distance of a standing vehicle behind a turn, m. It is longer because in a turn one drives slowly but is
hardly through it."""
BEFORE_LINE_M = 14.0
MIN_STRETCH_M = 45.0


def scenarios_on(route: DriveRoute, world: World, seed: int) -> tuple[Scenario, ...]:
    """Return scenarios along a route, in the order in which they are met, at least 80 m apart.

    Args:
        world: world of the drive, grown from the drive's seed.
        seed: equal seeds give equal scenarios.
    """
    rng = np.random.default_rng((seed, *route.id.encode()))
    drawn = _drawn(possible_scenarios(route, world, rng), rng)
    return tuple(_numbered(scenario, number, rng) for number, scenario in enumerate(drawn))


def possible_scenarios(route: DriveRoute, world: World, rng: np.random.Generator) -> list[Scenario]:
    """Return all scenarios that a route allows, in the order in which they are met.

    Places and kinds of crossings are drawn at random.
    """
    graph = build_lane_graph(world.town)
    road = RoadContext(route, graph, build_lane_index(graph), world)
    stretches = stretches_of(road)
    possible = [*at_junctions(road, stretches), *_on_stretches(road, stretches, rng)]
    possible += beside_parked(road)
    last_m = route.length_m - CLEAR_OF_END_M
    # Clear of the route's ends; some kinds only have to be over before the end
    within = [s for s in possible if s.at_m >= FIRST_M and (s.at_m <= last_m or s.kind in ENDS_BEFORE)]
    return sorted(within, key=lambda scenario: scenario.at_m)


def _drawn(possible: Sequence[Scenario], rng: np.random.Generator) -> list[Scenario]:
    drawn: list[Scenario] = []
    count: Counter[ScenarioKind] = Counter()
    while True:
        last_m = drawn[-1].at_m if drawn else FIRST_M - APART_M
        apart_m = STAGED_APART_M if drawn else APART_M
        # The next scenario must be far enough from the last one
        open_to = [s for s in possible if s.at_m >= last_m + (APART_M if s.actor else apart_m)]
        if not open_to:
            return drawn
        # Among those near, the kind that has been drawn least; then one of that kind
        near = [s for s in open_to if s.at_m <= open_to[0].at_m + CHOICE_M]
        min_count = min(count[s.kind] for s in near)
        kinds = sorted({s.kind for s in near if count[s.kind] == min_count})
        kind = kinds[int(rng.integers(len(kinds)))]
        of_kind = [s for s in near if s.kind == kind]
        drawn.append(of_kind[int(rng.integers(len(of_kind)))])
        count[kind] += 1


def _numbered(scenario: Scenario, number: int, rng: np.random.Generator) -> Scenario:
    """Give the crossing road user of a scenario its own track id and style."""
    if scenario.actor is None:
        return scenario
    style = int(rng.integers(2**31))
    actor = dataclasses.replace(scenario.actor, track_id=FIRST_TRACK_ID + number, style=style)
    return dataclasses.replace(scenario, actor=actor)


def _on_stretches(
    road: RoadContext, stretches: list[Stretch], rng: np.random.Generator
) -> Iterator[Scenario]:
    """Yield the scenarios outside of junctions, on runs of lanes between them."""
    graph = road.graph
    # Runs of lanes between junctions
    for is_inside, group in itertools.groupby(stretches, key=lambda s: bool(graph.junction[s.leg.lane] >= 0)):
        run = list(group)
        if is_inside:
            continue
        first = stretches.index(run[0])
        # Whether the route has just turned
        turned = first > 0 and abs(graph.turn_rad[stretches[first - 1].leg.lane]) > TURN_RAD
        from_m, to_m = run[0].from_m, run[-1].to_m
        if turned:
            yield from _after_turn(road, run)
        yield from _along(road, from_m + 1.5 * AFTER_TURN_M, to_m - BEFORE_LINE_M, run, rng)
        for stretch in run:
            yield from _lead_and_cut_in(road, stretch)


def _after_turn(road: RoadContext, run: list[Stretch]) -> Iterator[Scenario]:
    graph, leg, from_m = road.graph, run[0].leg, run[0].from_m
    limit = float(graph.limit_mps[leg.lane])
    # A standing vehicle needs room behind the corner and must be placed unseen
    if leg.to_m - leg.from_m > BEHIND_CORNER_M + 3.0 and can_stand(road, from_m + BEHIND_CORNER_M):
        way = Way((leg.lane, *onward(graph, leg.lane)), leg.from_m + BEHIND_CORNER_M)
        yield Scenario(ScenarioKind.OBSTACLE_BEHIND_CORNER, from_m + BEHIND_CORNER_M, limit, ways=(way,))
    if run[-1].to_m > from_m + AFTER_TURN_M:
        for category in (Category.PEDESTRIAN, Category.BICYCLE):
            yield from crossing(road, from_m + AFTER_TURN_M, limit, category, SEEN_AFTER_TURN_M)


def _along(
    road: RoadContext, from_m: float, to_m: float, run: list[Stretch], rng: np.random.Generator
) -> Iterator[Scenario]:
    """Yield the crossings on a stretch."""
    for at_m in np.arange(from_m + rng.uniform(0.0, 3.0), to_m, CROSSING_EVERY_M).tolist():
        lane = next((s.leg.lane for s in run if at_m <= s.to_m), run[-1].leg.lane)
        limit = float(road.graph.limit_mps[lane])
        category = Category.PEDESTRIAN if rng.random() < 0.5 else Category.BICYCLE
        # The start of the crossing must be visible for the whole stopping distance
        yield from crossing(road, at_m, limit, category, min(stopping_m(limit) + SPARE_M, at_m))


def _lead_and_cut_in(road: RoadContext, stretch: Stretch) -> Iterator[Scenario]:
    graph, (leg, from_m, to_m) = road.graph, stretch
    lane, limit = leg.lane, float(graph.limit_mps[leg.lane])
    if leg.to_m - leg.from_m < MIN_STRETCH_M or not can_drive_ahead(road, from_m, to_m):
        return
    way = Way((lane, *onward(graph, lane)), leg.to_m)
    yield Scenario(ScenarioKind.LEAD_BRAKES, to_m, limit, ways=(way,))
    # Cut-ins from either side where the line may be crossed towards the route
    for side in (0, 1):
        beside = int(graph.sides.lane[side, lane])
        if beside < 0 or not graph.may_cross[1 - side, beside] or graph.contested[beside]:
            continue
        meet_m = float(project_to_neighbour(lane, leg.to_m, 1 if side == 0 else -1, graph.sides))
        way = Way((beside, *onward(graph, beside)), meet_m)
        yield Scenario(ScenarioKind.CUT_IN, to_m, limit, ways=(way,), side=1 - side)
