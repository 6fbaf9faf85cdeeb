"""Who is called in for a scenario, and where: out of sight, or from the start of the drive on."""

import dataclasses

import numpy as np
from jaxtyping import Float64

from foredrive.simulation.scenarios.ground import Ground
from foredrive.simulation.scenarios.kinds import MEETINGS, ScenarioKind, Way
from foredrive.simulation.scenarios.scene import Scene
from foredrive.towns.traffic.guests import cleared, invited, points_on
from foredrive.towns.traffic.lights import Light
from foredrive.towns.traffic.turnover import BORN_BEYOND_M

EARLY_M = 170.0
"""Nobody is called in for what is so much further along the route."""
AT_START_M = (35.0, 85.0)
"""Oncoming traffic stands so far from the place where it is met when a drive begins."""
RUN_UP_M, CAR_M = 22.0, 2.5
"""Who will run a light waits for the ego vehicle with its bumper so far before its line."""
AHEAD_AT_START_M, AHEAD_M = 28.0, 102.0
"""Who is to be followed or passed begins so far ahead of the ego vehicle."""
SHARED_AT_START_M, SHARED_M = 25.0, 36.0
"""And has so much to drive, at least, until it has to have happened."""
STREAM, STREAM_APART_M = 3, 17.0
"""How many come towards the ego vehicle, and how far from each other."""
BEGIN_M = 6.0
SAMPLES_M = 4.0
APPROACHING_MPS = 3.0


def can_stand(ground: Ground, at_m: float) -> bool:
    """Whether somebody can be called in to stand at a place of a route, unseen."""
    if at_m < EARLY_M:
        return True
    away_m = np.arange(BORN_BEYOND_M, EARLY_M, SAMPLES_M)
    return _is_far(ground, np.full(len(away_m), at_m), at_m - away_m)


def can_drive_ahead(ground: Ground, from_m: float, to_m: float) -> bool:
    """Whether somebody can be called in to drive ahead on a stretch of a route, unseen."""
    if from_m <= AHEAD_AT_START_M <= to_m - SHARED_AT_START_M:
        return True
    ahead_m = np.arange(max(from_m, AHEAD_M), to_m - SHARED_M, SAMPLES_M)
    return _is_far(ground, ahead_m, ahead_m - AHEAD_M)


def _is_far(ground: Ground, ahead_m: Float64[np.ndarray, "n"], behind_m: Float64[np.ndarray, "n"]) -> bool:
    """Whether of some pairs of places of a route one is too far apart to see from the one to the other."""
    xy, arc_m = ground.route.xyz.T[:2], ground.route.arc_m
    there, here = (np.stack([np.interp(m, arc_m, axis) for axis in xy]) for m in (ahead_m, behind_m))
    return bool((np.hypot(*(there - here)) > BORN_BEYOND_M).any())


def call(scene: Scene, at_start: bool) -> Scene:
    """The scene with its vehicles on the road, if they can come now.

    Args:
        at_start: the drive is about to begin: nobody has seen yet what is there and what is not.
    """
    gap_m = scene.ego.middle_gap_m(scene.scenario.at_m)
    if not 0.0 < gap_m < EARLY_M:
        return scene
    for number, way in enumerate(scene.scenario.ways):
        begin_m, speed_mps = _begin(scene, way, gap_m, at_start)
        if begin_m is None or begin_m < BEGIN_M:
            continue
        called = _called(scene, number, begin_m, speed_mps, at_start)
        if called is not None:
            return called
    return scene


def _begin(scene: Scene, way: Way, gap_m: float, at_start: bool) -> tuple[float | None, float]:
    """Where along a way the first vehicle begins (None: not now), and how fast."""
    scenario, ego = scene.scenario, scene.ego
    if scenario.kind is ScenarioKind.OBSTACLE_BEHIND_CORNER:
        return way.meet_m, 0.0
    if scenario.kind in MEETINGS:
        if at_start and scenario.kind is ScenarioKind.RED_LIGHT_RUNNER:
            return way.line_m - RUN_UP_M - CAR_M, 0.0
        if at_start:
            return way.meet_m - min(max(gap_m, AT_START_M[0]), AT_START_M[1]), 0.0
        arrives_s = ego.arrival_s(scenario)
        if ego.speed_mps < APPROACHING_MPS or not is_let_go(scene, arrives_s):
            return None, 0.0
        return way.meet_m - scenario.limit_mps * arrives_s, scenario.limit_mps
    ahead_m, shared_m = (AHEAD_AT_START_M, SHARED_AT_START_M) if at_start else (AHEAD_M, SHARED_M)
    if gap_m - ahead_m < shared_m:
        return None, 0.0
    return way.meet_m - (gap_m - ahead_m), 0.0


def is_let_go(scene: Scene, after_s: float) -> bool:
    """Whether the ego vehicle will not have a red light at the junction of the scenario."""
    shows = scene.traffic.signals.shows(scene.state.time_s + after_s)
    return bool(shows[scene.scenario.ego_lane] != Light.RED)


def _called(scene: Scene, number: int, begin_m: float, speed_mps: float, at_start: bool) -> Scene | None:
    traffic, way, kind = scene.traffic, scene.scenario.ways[number], scene.scenario.kind
    count = STREAM if kind is ScenarioKind.ONCOMING_TRAFFIC else 1
    begins_m = [begin_m - k * STREAM_APART_M for k in range(count)]
    begins_m = [m for m in begins_m if m >= BEGIN_M]
    places = points_on(traffic.lanes, way.lanes, np.array(begins_m))
    if not at_start and np.linalg.norm(places - scene.ego.centre_m, axis=1).min() < BORN_BEYOND_M:
        return None
    until_m = way.meet_m if kind is ScenarioKind.RED_LIGHT_RUNNER else begin_m + 2 * SAMPLES_M
    from_m = begins_m[-1] - 2 * SAMPLES_M
    if kind in (ScenarioKind.LEAD_BRAKES, ScenarioKind.CUT_IN) and at_start:
        from_m = begin_m - AHEAD_AT_START_M + 2 * SAMPLES_M
    room = points_on(traffic.lanes, way.lanes, np.arange(max(from_m, 0.0), until_m, SAMPLES_M))
    state = cleared(traffic, scene.state, room, 0.0 if at_start else BORN_BEYOND_M - 5.0)
    free = [] if state is None else [slot for slot in traffic.guest_slots if not state.vehicles.active[slot]]
    if state is None or len(free) < len(begins_m):
        return None
    for slot, along_m in zip(free, begins_m, strict=False):
        state = invited(traffic, state, slot, way.lanes, along_m, speed_mps)
    play = dataclasses.replace(scene.play, cast=tuple(free[: len(begins_m)]), way=number)
    return scene._replace(state=state, play=play)
