"""Plays the scenarios of a route one after the other."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from foredrive.driving.dynamics import EGO
from foredrive.driving.time_to_collision import MovingBoxes, time_to_collision_s
from foredrive.scene import Category
from foredrive.towns.scenarios.context import ScenarioContext, ScenarioEgo, ScenarioProgress
from foredrive.towns.scenarios.kinematics import SPARE_M, cruise_mps
from foredrive.towns.scenarios.scenario import Scenario, ScenarioKind
from foredrive.towns.scenarios.vehicle_orders import give_orders
from foredrive.towns.scenarios.vehicles import place_vehicles
from foredrive.towns.traffic.orders import Orders
from foredrive.towns.traffic.scripted_actors import ACCELERATION_MPS2, ScriptedActor
from foredrive.towns.traffic.state import TrafficState
from foredrive.towns.traffic.traffic import Traffic

MIN_EGO_MPS = 1.5
PREFERRED_MPS = {Category.PEDESTRIAN: 1.4, Category.BICYCLE: 3.5}
MIN_MPS, MAX_MPS = 0.8, {Category.PEDESTRIAN: 3.0, Category.BICYCLE: 6.0}
STEP_OUT_MPS = 1.5
STAYS_S = 9.0
"""A pedestrian that steps out before a parked car goes back after this time, s."""
HALF_WIDTH_M = 0.5
NEARLY_M = 0.3
STANDS_MPS = 0.5
LATE_M = 3.0
SAFE_S = 4.0
BACK_MPS = -0.8
"""Speed of a crossing actor that steps back because a vehicle blocks its way, m/s."""
BESIDE_M = 0.4


def pace_to_begin(scenario: Scenario, actor: ScriptedActor, ego: ScenarioEgo) -> float | None:
    """Return the speed at which a crossing actor starts now to meet the ego vehicle, m/s.

    Returns None if it is too early, or no longer fair.
    """
    gap_m, speed = ego.front_gap_m(scenario.at_m) - HALF_WIDTH_M, ego.speed_mps
    # Distance that the ego vehicle has beyond its stopping distance
    spare_m = gap_m - ego.stopping_m()
    if speed < MIN_EGO_MPS:
        return None
    # The way until the pedestrian is visible in the lane counts too
    if scenario.kind is ScenarioKind.DOOR_ZONE:  # visible in the lane while the ego vehicle can still stop
        spare_m -= speed * scenario.meet_m / STEP_OUT_MPS
        # Begin in a window of `LATE_M`: the ego vehicle can still just stop
        return STEP_OUT_MPS if SPARE_M - LATE_M < spare_m < SPARE_M else None
    arrives_s = ego.arrival_s(scenario)
    # Too early: the actor would have to walk more slowly than it likes to
    early = arrives_s > scenario.meet_m / PREFERRED_MPS[actor.category] and spare_m > SPARE_M
    if spare_m < 0 or early:
        return None
    # The pace at which both meet, within what the actor can do
    pace = cruise_mps(scenario.meet_m, arrives_s, 0.0, ACCELERATION_MPS2)
    return min(max(pace, MIN_MPS), MAX_MPS[actor.category])


def is_on_the_spot(scenario: Scenario, actor: ScriptedActor, since_s: float) -> bool:
    """Return whether an actor waits in the lane: a pedestrian that has stepped out before a parked car."""
    waits = scenario.kind is ScenarioKind.DOOR_ZONE and since_s < STAYS_S
    return waits and actor.s_m >= scenario.meet_m - NEARLY_M


def would_hit(actor: ScriptedActor, pace_mps: float, others: MovingBoxes) -> bool:
    """Return whether a crossing actor that goes on hits a vehicle that it would not hit if it stood still."""
    to_go_m = actor.length_m - actor.s_m if pace_mps > 0 else actor.s_m
    # Time until the actor has left the road, and times to collision if it goes on or stands
    left_s = to_go_m / abs(pace_mps)
    collision_if_moving_s = time_to_collision_s(_box(actor, pace_mps), others).min(initial=np.inf)
    collision_if_standing_s = time_to_collision_s(_box(actor, 0.0), others).min(initial=np.inf)
    # It hits only by going on: waiting would avoid it
    return bool(
        collision_if_moving_s < min(left_s, SAFE_S) and collision_if_standing_s > collision_if_moving_s
    )


def pace_among(actor: ScriptedActor, pace_mps: float, others: MovingBoxes) -> float:
    """Return the speed of a crossing actor among vehicles, m/s.

    It waits for vehicles that approach, and steps back from vehicles that block its way.
    """
    if not would_hit(actor, pace_mps, others):
        return pace_mps
    stand = np.hypot(*others.velocity_mps.T) < STANDS_MPS
    if would_hit(actor, pace_mps, others.only(stand)) and not would_hit(actor, BACK_MPS, others):
        return BACK_MPS
    return 0.0


def vehicle_boxes(traffic: Traffic, state: TrafficState, ego: ScenarioEgo) -> MovingBoxes:
    """Return the vehicles that crossing actors avoid: all, but vehicle 0 only while it stands."""
    v, poses = state.vehicles, traffic.poses(state)
    # Vehicle 0 is not avoided while it drives: it is the one that has to react
    rows = np.flatnonzero(v.active)
    rows = rows[rows > 0]
    velocity: Float64[np.ndarray, "M 2"] = v.speed_mps[rows, None] * poses.forward[rows, :2]
    boxes = MovingBoxes(poses.centre_m[rows, :2], v.size_lwh[rows, :2], poses.yaw[rows], velocity)
    if ego.speed_mps > STANDS_MPS:
        return boxes
    size = np.array([EGO.length_m, EGO.width_m])
    own = MovingBoxes(ego.centre_m[None, :2], size[None], np.array([ego.yaw_rad]), np.zeros((1, 2)))
    return MovingBoxes(*(np.concatenate(pair) for pair in zip(boxes, own, strict=True)))


def _box(actor: ScriptedActor, pace_mps: float) -> MovingBoxes:
    size = actor.size_lwh[:2] + 2 * BESIDE_M
    velocity = pace_mps * actor.ahead
    return MovingBoxes(actor.xyz[None, :2], size[None], np.array([actor.yaw_rad]), velocity[None])


PASSED_M = 8.0


class Director:
    """Gives the traffic its orders for the scenarios of one route. All state is in `ScenarioProgress`."""

    def __init__(self, traffic: Traffic, scenarios: Sequence[Scenario]) -> None:
        self._traffic, self._scenarios = traffic, scenarios
        self._numbers = [number for number, scenario in enumerate(scenarios) if scenario.actor is not None]
        self._crossing_actors = tuple(scenario.actor for scenario in scenarios if scenario.actor is not None)

    def set_up(
        self, state: TrafficState, ego: ScenarioEgo, dt_s: float
    ) -> tuple[ScenarioProgress, TrafficState]:
        """Return the progress and the traffic at the start of a drive.

        All crossing road users wait at their places, and the vehicles of a near scenario are on the road.
        """
        progress = ScenarioProgress(pace_mps=(0.0,) * len(self._crossing_actors))
        state = dataclasses.replace(state, scripted_actors=self._crossing_actors)
        progress, state, _ = self.direct(progress, state, ego, dt_s, at_start=True)
        return progress, state

    def direct(
        self,
        progress: ScenarioProgress,
        state: TrafficState,
        ego: ScenarioEgo,
        dt_s: float,
        at_start: bool = False,
    ) -> tuple[ScenarioProgress, TrafficState, Orders]:
        """Return the updated progress, the traffic, and the orders for its next step.

        The traffic includes newly placed vehicles.
        """
        orders = Orders.none(len(state.vehicles.active))
        if progress.number < len(self._scenarios):
            scenario = self._scenarios[progress.number]
            if scenario.actor is not None:
                progress = self._direct_crossing(progress, scenario, state, ego)
            else:
                context = ScenarioContext(self._traffic, scenario, progress, state, ego, orders)
                context = give_orders(context if progress.slots else place_vehicles(context, at_start), dt_s)
                progress, state, orders = context.progress, context.state, context.orders
        speeds_mps = self._crossing_mps(progress, state, ego)
        return progress, state, dataclasses.replace(orders, scripted_mps=speeds_mps)

    def _direct_crossing(
        self, progress: ScenarioProgress, scenario: Scenario, state: TrafficState, ego: ScenarioEgo
    ) -> ScenarioProgress:
        index = self._numbers.index(progress.number)
        actor = state.scripted_actors[index]
        # Over if the vehicle has passed or the actor has crossed
        if ego.front_gap_m(scenario.at_m) < -PASSED_M or actor.s_m >= actor.length_m:
            return progress.after()
        pace = pace_to_begin(scenario, actor, ego) if progress.since_s is None else None
        if pace is None or would_hit(actor, pace, vehicle_boxes(self._traffic, state, ego)):
            return progress
        paces = (*progress.pace_mps[:index], pace, *progress.pace_mps[index + 1 :])
        return dataclasses.replace(progress.beginning(ego.t_s), pace_mps=paces)

    def _crossing_mps(
        self, progress: ScenarioProgress, state: TrafficState, ego: ScenarioEgo
    ) -> tuple[float, ...]:
        """Return the current speed of each crossing actor, m/s."""
        begun, paces, boxes = dict(progress.begun), list(progress.pace_mps), None
        for index, (number, actor) in enumerate(zip(self._numbers, state.scripted_actors, strict=True)):
            if paces[index] == 0.0 or actor.s_m >= actor.length_m:
                continue
            boxes = boxes or vehicle_boxes(self._traffic, state, ego)
            waits = is_on_the_spot(self._scenarios[number], actor, ego.t_s - begun[number])
            paces[index] = 0.0 if waits else pace_among(actor, paces[index], boxes)
        return tuple(paces)
