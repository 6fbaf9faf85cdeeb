"""Orders for the vehicles of a scenario."""

import dataclasses

import numpy as np

from foredrive.towns.scenarios.context import STANDS_MPS, ScenarioContext, ScenarioProgress
from foredrive.towns.scenarios.kinematics import SPARE_M, arrival_s, cruise_mps, stopping_m
from foredrive.towns.scenarios.scenario import ENDS_BEFORE, MEETINGS, ScenarioKind
from foredrive.towns.scenarios.vehicles import RUN_UP_M, is_let_go
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
CUTS_IN_S, MIN_CUT_IN_M = 5.0, 4.0
BESIDE_M, ASIDE_M = 9.0, 2.0
RUNS_MPS2 = 2.5
"""A vehicle that needs a harder deceleration than this to stop at a line, m/s², visibly does not stop."""
ROOM_M = 3.4
"""Half the road width that crossing vehicles need, m."""
GATHERS_MPS2, MAX_LIMIT_SHARE = 3.0, 1.15
EASY, SETS_OUT_S = 0.6, 0.5
"""A waiting red light runner plans its start with the share `EASY` of the speed limit, and with a delay of
`SETS_OUT_S` before it really accelerates."""
CREEP_MPS, NEAR_M = 4.0, 35.0
MAX_WAIT_S = 60.0
RESERVES_M = 50.0
"""Other vehicles give way to a red light runner once it is this near to the line, m."""


LANE_BLOCKERS = (ScenarioKind.LEAD_BRAKES, ScenarioKind.CUT_IN, ScenarioKind.OBSTACLE_BEHIND_CORNER)
"""Kinds whose vehicles stand in a lane until the ego vehicle comes. They do not hold up other vehicles for
long."""


def give_orders(context: ScenarioContext, dt_s: float) -> ScenarioContext:
    """Return the context with the orders for its vehicles. When a scenario is over, the next one follows."""
    progress, ego = context.progress, context.ego
    # A cut-in goes on even when the ego vehicle has passed
    if context.scenario.kind is ScenarioKind.CUT_IN and progress.since_s is not None:
        return _continue_cut_in(context, progress.since_s)
    if ego.front_gap_m(context.scenario.at_m) < -PASSED_M:
        return _ended(context)
    if not progress.slots:
        return context
    if context.scenario.kind in MEETINGS:
        progress = _without_passed(context)
        context = context._replace(progress=progress)
    # Without its vehicle a scenario is over
    lead_m = context.along_m(progress.slots[0]) if progress.slots else None
    if lead_m is None:
        return _ended(context)
    if progress.since_s is None and context.scenario.kind in ENDS_BEFORE and lead_m > context.way.meet_m:
        return _ended(context)  # no vehicle brakes or changes lanes in a junction for the scenario
    # Count for how long other vehicles are held up
    if progress.since_s is None and context.scenario.kind in LANE_BLOCKERS:
        held_s = progress.holds_up_s + dt_s if context.holds_up() else 0.0
        context = context._replace(progress=dataclasses.replace(progress, holds_up_s=held_s))
    match context.scenario.kind:
        case ScenarioKind.LEAD_BRAKES:
            follows = _follows(context, _gap_m(context, lead_m))
            return _order_lead(_waiting(context, dt_s, follows), lead_m, dt_s)
        case ScenarioKind.OBSTACLE_BEHIND_CORNER:
            return _order_obstacle(_waiting(context, dt_s, _stands_behind(context)))
        case ScenarioKind.CUT_IN:
            return _order_cut_in(context, lead_m)
        case _:
            return _order_meeting(_waiting(context, dt_s, True), lead_m)


def _without_passed(context: ScenarioContext) -> ScenarioProgress:
    """Return the progress with only those vehicles that can still be met.

    Such a vehicle has neither passed the meeting point nor turned off.
    """
    places = ((slot, context.along_m(slot)) for slot in context.progress.slots)
    until_m = context.way.meet_m + ROOM_M
    left = [slot for slot, m in places if m is not None and m < until_m + context.half_m(slot)]
    return dataclasses.replace(context.progress, slots=tuple(left))


def _waiting(context: ScenarioContext, dt_s: float, goes_on: bool) -> ScenarioContext:
    """Count the waiting time on if `goes_on`, else reset it."""
    waited_s = context.progress.waited_s + dt_s if goes_on else 0.0
    return context._replace(progress=dataclasses.replace(context.progress, waited_s=waited_s))


def _ended(context: ScenarioContext) -> ScenarioContext:
    return context._replace(progress=context.progress.after())


def _begun(context: ScenarioContext) -> ScenarioContext:
    return context._replace(progress=context.progress.beginning(context.ego.t_s))


def _gap_m(context: ScenarioContext, lead_m: float) -> float:
    """Return the gap from the ego vehicle's bumper to the rear of the first vehicle of the scenario, m.

    That vehicle is ahead on the route or beside it.
    """
    # Position of the lead vehicle on the route: its distance to the meeting point, taken from there
    on_route_m = context.scenario.at_m - (context.way.meet_m - lead_m)
    return context.ego.front_gap_m(on_route_m) - context.half_m(context.progress.slots[0])


def _cruise_ahead(context: ScenarioContext, gap_m: float) -> None:
    """Order the lead vehicle to drive slowly once the ego vehicle is near."""
    slot = context.progress.slots[0]
    # It sets off when the ego vehicle is near, or when others wait behind it
    goes = context.ego.has_set_out and (gap_m < SETS_OFF_M or context.speed_mps(slot) > MOVES_MPS)
    goes |= context.progress.holds_up_s > STANDS_S
    context.towards_mps(slot, SLOW[context.scenario.kind] * context.scenario.limit_mps if goes else 0.0)


def _order_lead(context: ScenarioContext, lead_m: float, dt_s: float) -> ScenarioContext:
    progress, ego, slot = context.progress, context.ego, context.progress.slots[0]
    # Braking: hard for `BRAKES_S`, then it is over
    if progress.since_s is not None:
        if ego.t_s - progress.since_s > BRAKES_S:
            return _ended(context)
        context.orders.max_mps2[slot] = -BRAKES_MPS2
        return context
    gap_m, lead_mps = _gap_m(context, lead_m), context.speed_mps(slot)
    _cruise_ahead(context, gap_m)
    # It would come to rest beyond the end: do not begin
    if lead_m + lead_mps**2 / (2 * BRAKES_MPS2) > context.way.meet_m:
        return context
    # The ego vehicle needs its stopping distance less the lead's braking distance
    min_gap_m = ego.stopping_m() - lead_mps**2 / (2 * BRAKES_MPS2)
    # The next step might be too late: `soon_m` includes the way until then
    soon_m = min_gap_m + SPARE_M + ego.speed_mps * dt_s
    if _follows(context, gap_m) and gap_m >= min_gap_m and (gap_m < soon_m or progress.waited_s > FOLLOWED_S):
        context.orders.max_mps2[slot] = -BRAKES_MPS2
        return _begun(context)
    return context


def _follows(context: ScenarioContext, gap_m: float) -> bool:
    lead_mps = context.speed_mps(context.progress.slots[0])
    return 0.0 < gap_m < FOLLOWED_M and context.ego.speed_mps > MOVES_MPS and lead_mps > MOVES_MPS


def _order_obstacle(context: ScenarioContext) -> ScenarioContext:
    progress, ego, slot = context.progress, context.ego, context.progress.slots[0]
    gap_m = ego.front_gap_m(context.scenario.at_m) - context.half_m(slot)
    # It counts as begun when the ego vehicle has to brake for it
    if progress.since_s is None and gap_m < ego.stopping_m() + SPARE_M and ego.speed_mps > MOVES_MPS:
        context = _begun(context)
    # It drives on when somebody has waited behind it, or after a maximum time
    if progress.waited_s > STANDS_S or (
        progress.since_s is not None and ego.t_s - progress.since_s > BLOCKS_S
    ):
        return _ended(context)
    context.orders.max_mps2[slot] = -BRAKES_MPS2
    return context


def _stands_behind(context: ScenarioContext) -> bool:
    """Return whether the ego vehicle stands behind the obstacle, or another vehicle does.

    Another vehicle may leave the ego vehicle no room to come that far.
    """
    if context.progress.holds_up_s > 0.0:
        return True
    ego = context.ego
    gap_m = ego.front_gap_m(context.scenario.at_m)
    return ego.speed_mps < STANDS_MPS and gap_m < STANDS_WITHIN_M and ego.has_set_out


def _order_cut_in(context: ScenarioContext, lead_m: float) -> ScenarioContext:
    ego, slot, gap_m = context.ego, context.progress.slots[0], _gap_m(context, lead_m)
    _cruise_ahead(context, gap_m)
    lead_mps = context.speed_mps(slot)
    # The change must be completed before the meeting point
    has_room = lead_m + change_length_m(context.state.vehicles)[slot] < context.way.meet_m
    if lead_mps < MOVES_MPS or not has_room:
        return context
    # Only a faster ego vehicle can be cut in on, and it must still be able to slow down
    closing_mps = ego.speed_mps - lead_mps
    # The lead keeps its speed, so the ego vehicle's excess speed counts.
    min_gap_m = max(stopping_m(closing_mps, ego.acceleration_mps2), MIN_CUT_IN_M)
    spare_m = gap_m - min_gap_m
    if closing_mps > MOVES_MPS and 0.0 < spare_m < SPARE_M + closing_mps and _is_free(context, slot):
        change = (slot, context.scenario.side)
        return _begun(context)._replace(orders=dataclasses.replace(context.orders, change=change))
    return context


def _continue_cut_in(context: ScenarioContext, since_s: float) -> ScenarioContext:
    if context.ego.t_s - since_s > CUTS_IN_S:
        return _ended(context)
    _cruise_ahead(context, 0.0)
    return context


def _is_free(context: ScenarioContext, slot: int) -> bool:
    """Return whether the space that a vehicle would change into is free."""
    poses, v = context.traffic.poses(context.state), context.state.vehicles
    ahead = poses.forward[slot, :2]
    left = np.array([-ahead[1], ahead[0]]) * (1.0 if context.scenario.side == 0 else -1.0)
    # Others in the frame of the cutting-in vehicle: beside it on the side of the change
    offset = poses.centre_m[:, :2] - poses.centre_m[slot, :2]
    beside = v.active & (np.abs(offset @ ahead) < BESIDE_M) & (offset @ left > ASIDE_M)
    beside &= offset @ left < 3 * ASIDE_M
    beside[[0, slot]] = False
    return not beside.any()


def _order_meeting(context: ScenarioContext, lead_m: float) -> ScenarioContext:
    """Order a vehicle to reach the meeting point together with the ego vehicle.

    A red light runner reacts to the ego vehicle only until it visibly runs the light. Oncoming traffic never
    exceeds the speed limit, and drives freely if the ego vehicle waits for it.
    """
    scenario, progress, ego, slot = context.scenario, context.progress, context.ego, context.progress.slots[0]
    runs = scenario.kind is ScenarioKind.RED_LIGHT_RUNNER
    # Distance of the bumper to the junction's line, and room before the crossing area
    line_m = context.way.line_m - lead_m - context.half_m(slot)
    room_m = ego.front_gap_m(scenario.at_m - ROOM_M)
    # Others react to the ego vehicle only if it stands in their way
    context.orders.ignores_ego[list(progress.slots)] = ego.speed_mps > MOVES_MPS or room_m > 0.0
    is_ego_approaching = ego.speed_mps > MOVES_MPS and ego.middle_gap_m(scenario.at_m) > 0.0
    # Begun: a red light runner keeps its speed; oncoming traffic keeps adjusting its arrival
    if progress.since_s is not None:
        if runs:
            context.towards_mps(slot, progress.cruise_mps)
            return _order_run(context, slot, line_m)
        return _order_arrival(context, lead_m, 1.0) if is_ego_approaching and room_m > 0.0 else context
    if progress.waited_s > MAX_WAIT_S:
        return _ended(context)
    # Wait until the ego vehicle comes, has no red light, and it is time to go
    if (
        not is_ego_approaching
        or not is_let_go(context, ego.arrival_s(scenario))
        or (runs and _has_time(context, lead_m))
    ):
        _order_wait(context, slot, line_m if runs else context.way.meet_m - lead_m)
        return context
    # Approach so that both arrive together
    context = _order_arrival(context, lead_m, MAX_LIMIT_SHARE if runs else 1.0)
    spare_m = room_m - ego.stopping_m()
    # Oncoming traffic has begun when the ego vehicle must brake or go first
    if not runs:
        return _begun(context) if spare_m < SPARE_M else context
    # A runner has begun when it visibly cannot stop. Before that, the ego vehicle must have room to stop
    if line_m < context.speed_mps(slot) ** 2 / (2 * RUNS_MPS2):
        return _order_run(_begun(context), slot, line_m)
    return _ended(context) if spare_m < 0.0 else _order_run(context, slot, line_m)


def _has_time(context: ScenarioContext, lead_m: float) -> bool:
    """Return whether it is too early for a standing vehicle to start."""
    speed, way_m = context.speed_mps(context.progress.slots[0]), context.way.meet_m - lead_m
    # Time that the vehicle would need with an easy start
    needs_s = SETS_OUT_S + arrival_s(way_m, speed, GATHERS_MPS2, EASY * context.scenario.limit_mps)
    return speed < MOVES_MPS and context.ego.arrival_s(context.scenario) > needs_s


def _order_arrival(context: ScenarioContext, lead_m: float, limit_share: float) -> ScenarioContext:
    """Order the vehicle to meet the ego vehicle, no faster than a share of the speed limit."""
    slot, scenario = context.progress.slots[0], context.scenario
    if lead_m > context.way.meet_m:
        return context
    arrives_s = max(context.ego.arrival_s(scenario), 0.1)
    # Speed that arrives with the ego vehicle, limited
    wanted = cruise_mps(context.way.meet_m - lead_m, arrives_s, context.speed_mps(slot), GATHERS_MPS2)
    wanted = min(wanted, limit_share * scenario.limit_mps)
    context.towards_mps(slot, wanted)
    return context._replace(progress=dataclasses.replace(context.progress, cruise_mps=wanted))


def _order_wait(context: ScenarioContext, slot: int, to_go_m: float) -> None:
    """Order a vehicle to wait.

    A red light runner waits before its line. For all other vehicles the lights do this.
    """
    if context.scenario.kind is ScenarioKind.RED_LIGHT_RUNNER:
        # Creep towards the waiting place, slower as it comes nearer
        context.towards_mps(slot, min(max((to_go_m - RUN_UP_M) / 3.0, 0.0), CREEP_MPS))
    elif not context.ego.has_set_out:
        context.towards_mps(slot, 0.0)
    elif to_go_m > NEAR_M:
        context.towards_mps(slot, CREEP_MPS)


def _order_run(context: ScenarioContext, slot: int, line_m: float) -> ScenarioContext:
    context.orders.runs_lights[slot] = True
    # Near the line it gets right of way, so that others let it pass
    if line_m > RESERVES_M:
        return context
    lane = next(
        n for n in context.way.lanes if context.traffic.lanes.contested[n] and _begins_m(context, n) >= 0.0
    )
    return context._replace(state=grant_junction(context.traffic, context.state, slot, lane))


def _begins_m(context: ScenarioContext, lane: int) -> float:
    """Return where a lane begins along the way, relative to the junction's line, m."""
    lanes = context.way.lanes
    length_m = context.traffic.lanes.length_m[list(lanes[: lanes.index(lane)])].sum()
    return float(length_m) - context.way.line_m + 1e-6
