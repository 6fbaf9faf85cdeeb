"""Places the vehicles of a scenario on the road: out of sight, or at the start of the drive."""

import dataclasses

import numpy as np
from jaxtyping import Float64

from foredrive.geometry.polylines import points_at
from foredrive.scene.traffic_light import LightState
from foredrive.towns.scenarios.context import ScenarioContext
from foredrive.towns.scenarios.road_context import RoadContext
from foredrive.towns.scenarios.scenario import MEETINGS, ScenarioKind, Way
from foredrive.towns.traffic.scenario_vehicles import add_vehicle, clear_area, points_along
from foredrive.towns.traffic.spawning import SPAWN_MIN_M

EARLY_M = 170.0
"""No vehicle is placed for a scenario further than this along the route, m."""
AT_START_M = (35.0, 85.0)
"""Range of the distance between oncoming traffic and the meeting point at the start of a drive, m."""
RUN_UP_M, CAR_M = 22.0, 2.5
"""A red light runner waits with its bumper `RUN_UP_M` before its line. `CAR_M` is half a car's length."""
AHEAD_AT_START_M, AHEAD_M = 28.0, 102.0
"""Initial distance of a lead or cut-in vehicle ahead of the ego vehicle, m: at the start of the drive, and
later."""
SHARED_AT_START_M, SHARED_M = 25.0, 36.0
"""Minimum distance that such a vehicle must have until the scenario has to be over, m: at the start of the
drive, and later."""
STREAM, STREAM_APART_M = 3, 17.0
"""Number of oncoming vehicles, and the distance between them, m."""
BEGIN_M = 6.0
SAMPLES_M = 4.0
APPROACHING_MPS = 3.0


def can_stand(road: RoadContext, at_m: float) -> bool:
    """Return whether a standing vehicle can be placed at a point of a route unseen."""
    # Near the start of the drive a vehicle may be placed in sight
    if at_m < EARLY_M:
        return True
    # From a distance at which it cannot be seen, some time on the way there
    away_m = np.arange(SPAWN_MIN_M, EARLY_M, SAMPLES_M)
    return _is_far(road, np.full(len(away_m), at_m), at_m - away_m)


def can_drive_ahead(road: RoadContext, from_m: float, to_m: float) -> bool:
    """Return whether a lead vehicle can be placed on a stretch of a route unseen."""
    if from_m <= AHEAD_AT_START_M <= to_m - SHARED_AT_START_M:
        return True
    ahead_m = np.arange(max(from_m, AHEAD_M), to_m - SHARED_M, SAMPLES_M)
    return _is_far(road, ahead_m, ahead_m - AHEAD_M)


def _is_far(road: RoadContext, ahead_m: Float64[np.ndarray, "n"], behind_m: Float64[np.ndarray, "n"]) -> bool:
    """Return whether at least one of some pairs of points on a route is too far apart for sight.

    Two points cannot be seen from each other if they are further apart than `SPAWN_MIN_M`.
    """
    ahead_xy, here = (points_at(road.route.xyz[:, :2], road.route.arc_m, m) for m in (ahead_m, behind_m))
    return bool((np.hypot(*(ahead_xy - here).T) > SPAWN_MIN_M).any())


def place_vehicles(context: ScenarioContext, at_start: bool) -> ScenarioContext:
    """Return the context with its vehicles on the road, if they can be placed now.

    Args:
        at_start: whether the drive is about to begin, so that vehicles may also appear in sight.
    """
    gap_m = context.ego.middle_gap_m(context.scenario.at_m)
    # Only scenarios ahead and near enough
    if not 0.0 < gap_m < EARLY_M:
        return context
    # Take the first way on which the vehicles can be placed
    for number, way in enumerate(context.scenario.ways):
        begin_m, speed_mps = _begin(context, way, gap_m, at_start)
        if begin_m is None or begin_m < BEGIN_M:
            continue
        placed_context = _placed(context, number, begin_m, speed_mps, at_start)
        if placed_context is not None:
            return placed_context
    return context


def _begin(context: ScenarioContext, way: Way, gap_m: float, at_start: bool) -> tuple[float | None, float]:
    """Return where along a way the first vehicle begins, m (None: not now), and its speed, m/s."""
    scenario, ego = context.scenario, context.ego
    if scenario.kind is ScenarioKind.OBSTACLE_BEHIND_CORNER:
        return way.meet_m, 0.0
    if scenario.kind in MEETINGS:
        if at_start and scenario.kind is ScenarioKind.RED_LIGHT_RUNNER:
            # A runner waits before its line; oncoming traffic at the distance of the ego vehicle
            return way.line_m - RUN_UP_M - CAR_M, 0.0
        if at_start:
            return way.meet_m - min(max(gap_m, AT_START_M[0]), AT_START_M[1]), 0.0
        # Later: where a vehicle at the limit would have to be now to arrive at the same time
        arrives_s = ego.arrival_s(scenario)
        if ego.speed_mps < APPROACHING_MPS or not is_let_go(context, arrives_s):
            return None, 0.0
        return way.meet_m - scenario.limit_mps * arrives_s, scenario.limit_mps
    # Lead and cut-in vehicles begin some distance ahead of the ego vehicle
    ahead_m, shared_m = (AHEAD_AT_START_M, SHARED_AT_START_M) if at_start else (AHEAD_M, SHARED_M)
    if gap_m - ahead_m < shared_m:
        return None, 0.0
    return way.meet_m - (gap_m - ahead_m), 0.0


def is_let_go(context: ScenarioContext, after_s: float) -> bool:
    """Return whether the ego vehicle will have no red light at the scenario's junction."""
    shows = context.traffic.signals.light_states(context.state.time_s + after_s)
    return bool(shows[context.scenario.ego_lane] != LightState.RED)


def _placed(
    context: ScenarioContext, number: int, begin_m: float, speed_mps: float, at_start: bool
) -> ScenarioContext | None:
    traffic, way, kind = context.traffic, context.scenario.ways[number], context.scenario.kind
    count = STREAM if kind is ScenarioKind.ONCOMING_TRAFFIC else 1
    # Oncoming traffic is a stream of several vehicles, one behind the other
    begins_m = [begin_m - k * STREAM_APART_M for k in range(count)]
    begins_m = [m for m in begins_m if m >= BEGIN_M]
    places = points_along(traffic.lanes, way.lanes, np.array(begins_m))
    # None may appear in sight
    if not at_start and np.linalg.norm(places - context.ego.centre_m, axis=1).min() < SPAWN_MIN_M:
        return None
    # Remove other vehicles from the stretch that they need
    until_m = way.meet_m if kind is ScenarioKind.RED_LIGHT_RUNNER else begin_m + 2 * SAMPLES_M
    from_m = begins_m[-1] - 2 * SAMPLES_M
    if kind in (ScenarioKind.LEAD_BRAKES, ScenarioKind.CUT_IN) and at_start:
        from_m = begin_m - AHEAD_AT_START_M + 2 * SAMPLES_M
    room = points_along(traffic.lanes, way.lanes, np.arange(max(from_m, 0.0), until_m, SAMPLES_M))
    state = clear_area(traffic, context.state, room, 0.0 if at_start else SPAWN_MIN_M - 5.0)
    # Slots of scenarios that are not in use
    free = (
        [] if state is None else [slot for slot in traffic.scenario_slots if not state.vehicles.active[slot]]
    )
    if state is None or len(free) < len(begins_m):
        return None
    for slot, along_m in zip(free, begins_m, strict=False):
        state = add_vehicle(traffic, state, slot, way.lanes, along_m, speed_mps)
    progress = dataclasses.replace(context.progress, slots=tuple(free[: len(begins_m)]), way=number)
    return context._replace(state=state, progress=progress)
