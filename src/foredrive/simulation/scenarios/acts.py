"""Orders for the vehicles of a scenario."""

import dataclasses

import numpy as np

from foredrive.simulation.scenarios.cast import RUN_UP_M, is_let_go
from foredrive.simulation.scenarios.kinds import ENDS_BEFORE, MEETINGS, ScenarioKind
from foredrive.simulation.scenarios.kinematics import SPARE_M, arrival_s, cruise_mps, stopping_m
from foredrive.simulation.scenarios.scene import STANDS_MPS, Play, Scene
from foredrive.towns.traffic.lane_changes import change_length_m
from foredrive.towns.traffic.scenario_vehicles import grant_junction

MOVES_MPS = 1.0
"""Oncoming and crossing vehicles react to the ego vehicle only if it is slower than this, m/s, and in the
way."""
PASSED_M = 6.0
SETS_OFF_M = 48.0
SLOW = {ScenarioKind.LEAD_BRAKES: 0.55, ScenarioKind.CUT_IN: 0.35}
"""A lead vehicle stands until the gap to the ego vehicle is below `SETS_OFF_M`. Then it drives at this
share of the speed limit."""
BRAKES_MPS2, BRAKES_S = 6.0, 4.5
FOLLOWED_M, FOLLOWED_S = 40.0, 4.0
"""A lead vehicle brakes when the ego vehicle has followed within `FOLLOWED_M` for `FOLLOWED_S`, or before
the gap gets too short."""
STANDS_WITHIN_M, STANDS_S, BLOCKS_S = 25.0, 3.0, 40.0
"""A vehicle that blocks the lane drives on when the ego vehicle has stood within `STANDS_WITHIN_M` for
`STANDS_S`, or at the latest after `BLOCKS_S`."""
CUTS_IN_S, LEAST_CUT_M = 5.0, 4.0
BESIDE_M, ASIDE_M = 9.0, 2.0
RUNS_MPS2 = 2.5
"""A vehicle that needs a harder deceleration than this to stop at a line, m/s², visibly does not stop."""
ROOM_M = 3.4
"""Half the road width that crossing vehicles need, m."""
GATHERS_MPS2, FASTEST = 3.0, 1.15
EASY, SETS_OUT_S = 0.6, 0.5
"""A waiting red light runner plans its start with the share `EASY` of the speed limit, and with a delay of
`SETS_OUT_S` before it really accelerates."""
CREEP_MPS, NEAR_M = 4.0, 35.0
LONGEST_WAIT_S = 60.0
RESERVES_M = 50.0
"""Other vehicles give way to a red light runner once it is this near to the line, m."""


STANDING = (ScenarioKind.LEAD_BRAKES, ScenarioKind.CUT_IN, ScenarioKind.OBSTACLE_BEHIND_CORNER)
"""Kinds whose vehicles stand in a lane until the ego vehicle comes. They do not hold up other vehicles for
long."""


def act(scene: Scene, dt_s: float) -> Scene:
    """Return the scene with the orders for its vehicles. When a scenario is over, the next one follows."""
    play, ego = scene.play, scene.ego
    if scene.scenario.kind is ScenarioKind.CUT_IN and play.since_s is not None:
        return _come_over(scene, play.since_s)
    if ego.front_gap_m(scene.scenario.at_m) < -PASSED_M:
        return _over(scene)
    if not play.cast:
        return scene
    if scene.scenario.kind in MEETINGS:
        play = _without_passed(scene)
        scene = scene._replace(play=play)
    lead_m = scene.along_m(play.cast[0]) if play.cast else None
    if lead_m is None:
        return _over(scene)
    if play.since_s is None and scene.scenario.kind in ENDS_BEFORE and lead_m > scene.way.meet_m:
        return _over(scene)  # no vehicle brakes or changes lanes in a junction for the scenario
    if play.since_s is None and scene.scenario.kind in STANDING:
        held_s = play.holds_up_s + dt_s if scene.holds_up() else 0.0
        scene = scene._replace(play=dataclasses.replace(play, holds_up_s=held_s))
    match scene.scenario.kind:
        case ScenarioKind.LEAD_BRAKES:
            follows = _follows(scene, _gap_m(scene, lead_m))
            return _lead(_waiting(scene, dt_s, follows), lead_m, dt_s)
        case ScenarioKind.OBSTACLE_BEHIND_CORNER:
            return _block(_waiting(scene, dt_s, _stands_behind(scene)))
        case ScenarioKind.CUT_IN:
            return _cut_in(scene, lead_m)
        case _:
            return _meet(_waiting(scene, dt_s, True), lead_m)


def _without_passed(scene: Scene) -> Play:
    """Return the play with only those vehicles that can still be met.

    Such a vehicle has neither passed the meeting point nor turned off.
    """
    places = ((slot, scene.along_m(slot)) for slot in scene.play.cast)
    until_m = scene.way.meet_m + ROOM_M
    left = [slot for slot, m in places if m is not None and m < until_m + scene.half_m(slot)]
    return dataclasses.replace(scene.play, cast=tuple(left))


def _waiting(scene: Scene, dt_s: float, goes_on: bool) -> Scene:
    """Count the waiting time on if `goes_on`, else reset it."""
    waited_s = scene.play.waited_s + dt_s if goes_on else 0.0
    return scene._replace(play=dataclasses.replace(scene.play, waited_s=waited_s))


def _over(scene: Scene) -> Scene:
    return scene._replace(play=scene.play.after())


def _begun(scene: Scene) -> Scene:
    return scene._replace(play=scene.play.beginning(scene.ego.t_s))


def _gap_m(scene: Scene, lead_m: float) -> float:
    """Return the gap from the ego vehicle's bumper to the rear of the first vehicle of the scenario, m.

    That vehicle is ahead on the route or beside it.
    """
    on_route_m = scene.scenario.at_m - (scene.way.meet_m - lead_m)
    return scene.ego.front_gap_m(on_route_m) - scene.half_m(scene.play.cast[0])


def _cruise_ahead(scene: Scene, gap_m: float) -> None:
    """Order the lead vehicle to drive slowly once the ego vehicle is near."""
    slot = scene.play.cast[0]
    goes = scene.ego.has_set_out and (gap_m < SETS_OFF_M or scene.speed_mps(slot) > MOVES_MPS)
    goes |= scene.play.holds_up_s > STANDS_S
    scene.towards_mps(slot, SLOW[scene.scenario.kind] * scene.scenario.limit_mps if goes else 0.0)


def _lead(scene: Scene, lead_m: float, dt_s: float) -> Scene:
    play, ego, slot = scene.play, scene.ego, scene.play.cast[0]
    if play.since_s is not None:
        if ego.t_s - play.since_s > BRAKES_S:
            return _over(scene)
        scene.orders.max_mps2[slot] = -BRAKES_MPS2
        return scene
    gap_m, lead_mps = _gap_m(scene, lead_m), scene.speed_mps(slot)
    _cruise_ahead(scene, gap_m)
    if lead_m + lead_mps**2 / (2 * BRAKES_MPS2) > scene.way.meet_m:
        return scene
    least_m = ego.stopping_m() - lead_mps**2 / (2 * BRAKES_MPS2)
    soon_m = least_m + SPARE_M + ego.speed_mps * dt_s
    if _follows(scene, gap_m) and gap_m >= least_m and (gap_m < soon_m or play.waited_s > FOLLOWED_S):
        scene.orders.max_mps2[slot] = -BRAKES_MPS2
        return _begun(scene)
    return scene


def _follows(scene: Scene, gap_m: float) -> bool:
    lead_mps = scene.speed_mps(scene.play.cast[0])
    return 0.0 < gap_m < FOLLOWED_M and scene.ego.speed_mps > MOVES_MPS and lead_mps > MOVES_MPS


def _block(scene: Scene) -> Scene:
    play, ego, slot = scene.play, scene.ego, scene.play.cast[0]
    gap_m = ego.front_gap_m(scene.scenario.at_m) - scene.half_m(slot)
    if play.since_s is None and gap_m < ego.stopping_m() + SPARE_M and ego.speed_mps > MOVES_MPS:
        scene = _begun(scene)
    if play.waited_s > STANDS_S or (play.since_s is not None and ego.t_s - play.since_s > BLOCKS_S):
        return _over(scene)
    scene.orders.max_mps2[slot] = -BRAKES_MPS2
    return scene


def _stands_behind(scene: Scene) -> bool:
    """Return whether the ego vehicle stands behind the obstacle, or another vehicle does.

    Another vehicle may leave the ego vehicle no room to come that far.
    """
    if scene.play.holds_up_s > 0.0:
        return True
    ego = scene.ego
    gap_m = ego.front_gap_m(scene.scenario.at_m)
    return ego.speed_mps < STANDS_MPS and gap_m < STANDS_WITHIN_M and ego.has_set_out


def _cut_in(scene: Scene, lead_m: float) -> Scene:
    ego, slot, gap_m = scene.ego, scene.play.cast[0], _gap_m(scene, lead_m)
    _cruise_ahead(scene, gap_m)
    lead_mps = scene.speed_mps(slot)
    has_room = lead_m + change_length_m(scene.state.vehicles)[slot] < scene.way.meet_m
    if lead_mps < MOVES_MPS or not has_room:
        return scene
    closing_mps = ego.speed_mps - lead_mps
    # The lead keeps its speed, so the ego vehicle's excess speed counts.
    least_m = max(stopping_m(closing_mps, ego.acceleration_mps2), LEAST_CUT_M)
    spare_m = gap_m - least_m
    if closing_mps > MOVES_MPS and 0.0 < spare_m < SPARE_M + closing_mps and _is_free(scene, slot):
        change = (slot, scene.scenario.side)
        return _begun(scene)._replace(orders=dataclasses.replace(scene.orders, change=change))
    return scene


def _come_over(scene: Scene, since_s: float) -> Scene:
    if scene.ego.t_s - since_s > CUTS_IN_S:
        return _over(scene)
    _cruise_ahead(scene, 0.0)
    return scene


def _is_free(scene: Scene, slot: int) -> bool:
    """Return whether the space that a vehicle would change into is free."""
    poses, v = scene.traffic.poses(scene.state), scene.state.vehicles
    ahead = poses.forward[slot, :2]
    left = np.array([-ahead[1], ahead[0]]) * (1.0 if scene.scenario.side == 0 else -1.0)
    offset = poses.centre_m[:, :2] - poses.centre_m[slot, :2]
    there = v.active & (np.abs(offset @ ahead) < BESIDE_M) & (offset @ left > ASIDE_M)
    there &= offset @ left < 3 * ASIDE_M
    there[[0, slot]] = False
    return not there.any()


def _meet(scene: Scene, lead_m: float) -> Scene:
    """Order a vehicle to reach the meeting point together with the ego vehicle.

    A red light runner reacts to the ego vehicle only until it visibly runs the light. Oncoming traffic never
    exceeds the speed limit, and drives freely if the ego vehicle waits for it.
    """
    scenario, play, ego, slot = scene.scenario, scene.play, scene.ego, scene.play.cast[0]
    runs = scenario.kind is ScenarioKind.RED_LIGHT_RUNNER
    line_m, room_m = scene.way.line_m - lead_m - scene.half_m(slot), ego.front_gap_m(scenario.at_m - ROOM_M)
    scene.orders.ignores_ego[list(play.cast)] = ego.speed_mps > MOVES_MPS or room_m > 0.0
    comes = ego.speed_mps > MOVES_MPS and ego.middle_gap_m(scenario.at_m) > 0.0
    if play.since_s is not None:
        if runs:
            scene.towards_mps(slot, play.cruise_mps)
            return _run(scene, slot, line_m)
        return _synchronised(scene, lead_m, 1.0) if comes and room_m > 0.0 else scene
    if play.waited_s > LONGEST_WAIT_S:
        return _over(scene)
    if not comes or not is_let_go(scene, ego.arrival_s(scenario)) or (runs and _has_time(scene, lead_m)):
        _wait(scene, slot, line_m if runs else scene.way.meet_m - lead_m)
        return scene
    scene = _synchronised(scene, lead_m, FASTEST if runs else 1.0)
    spare_m = room_m - ego.stopping_m()
    if not runs:
        return _begun(scene) if spare_m < SPARE_M else scene
    if line_m < scene.speed_mps(slot) ** 2 / (2 * RUNS_MPS2):
        return _run(_begun(scene), slot, line_m)
    return _over(scene) if spare_m < 0.0 else _run(scene, slot, line_m)


def _has_time(scene: Scene, lead_m: float) -> bool:
    """Return whether it is too early for a standing vehicle to start."""
    speed, way_m = scene.speed_mps(scene.play.cast[0]), scene.way.meet_m - lead_m
    needs_s = SETS_OUT_S + arrival_s(way_m, speed, GATHERS_MPS2, EASY * scene.scenario.limit_mps)
    return speed < MOVES_MPS and scene.ego.arrival_s(scene.scenario) > needs_s


def _synchronised(scene: Scene, lead_m: float, fastest: float) -> Scene:
    """Order the vehicle to meet the ego vehicle, at no more than the share `fastest` of the speed limit."""
    slot, scenario = scene.play.cast[0], scene.scenario
    if lead_m > scene.way.meet_m:
        return scene
    arrives_s = max(scene.ego.arrival_s(scenario), 0.1)
    wanted = cruise_mps(scene.way.meet_m - lead_m, arrives_s, scene.speed_mps(slot), GATHERS_MPS2)
    wanted = min(wanted, fastest * scenario.limit_mps)
    scene.towards_mps(slot, wanted)
    return scene._replace(play=dataclasses.replace(scene.play, cruise_mps=wanted))


def _wait(scene: Scene, slot: int, to_go_m: float) -> None:
    """Order a vehicle to wait.

    A red light runner waits before its line. For all other vehicles the lights do this.
    """
    if scene.scenario.kind is ScenarioKind.RED_LIGHT_RUNNER:
        scene.towards_mps(slot, min(max((to_go_m - RUN_UP_M) / 3.0, 0.0), CREEP_MPS))
    elif not scene.ego.has_set_out:
        scene.towards_mps(slot, 0.0)
    elif to_go_m > NEAR_M:
        scene.towards_mps(slot, CREEP_MPS)


def _run(scene: Scene, slot: int, line_m: float) -> Scene:
    scene.orders.runs_lights[slot] = True
    if line_m > RESERVES_M:
        return scene
    lane = next(n for n in scene.way.lanes if scene.traffic.lanes.contested[n] and _begins_m(scene, n) >= 0.0)
    return scene._replace(state=grant_junction(scene.traffic, scene.state, slot, lane))


def _begins_m(scene: Scene, lane: int) -> float:
    """Return where a lane begins along the way, relative to the junction's line, m."""
    lanes = scene.way.lanes
    length_m = scene.traffic.lanes.length_m[list(lanes[: lanes.index(lane)])].sum()
    return float(length_m) - scene.way.line_m + 1e-6
