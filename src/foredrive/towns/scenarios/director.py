"""Crossing actors (pedestrians and cyclists): when they start, and how they avoid vehicles."""

import numpy as np
from jaxtyping import Float64

from foredrive.scene import Category
from foredrive.simulation.dynamics import EGO
from foredrive.simulation.scenarios.context import ScenarioEgo
from foredrive.simulation.scenarios.kinematics import SPARE_M, cruise_mps
from foredrive.simulation.scenarios.scenario import Scenario, ScenarioKind
from foredrive.simulation.time_to_collision import MovingBoxes, time_to_collision_s
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
    spare_m = gap_m - ego.stopping_m()
    if speed < MIN_EGO_MPS:
        return None
    if scenario.kind is ScenarioKind.DOOR_ZONE:  # visible in the lane while the ego vehicle can still stop
        spare_m -= speed * scenario.meet_m / STEP_OUT_MPS
        return STEP_OUT_MPS if SPARE_M - LATE_M < spare_m < SPARE_M else None
    arrives_s = ego.arrival_s(scenario)
    early = arrives_s > scenario.meet_m / PREFERRED_MPS[actor.category] and spare_m > SPARE_M
    if spare_m < 0 or early:
        return None
    pace = cruise_mps(scenario.meet_m, arrives_s, 0.0, ACCELERATION_MPS2)
    return min(max(pace, MIN_MPS), MAX_MPS[actor.category])


def is_on_the_spot(scenario: Scenario, actor: ScriptedActor, since_s: float) -> bool:
    """Return whether an actor waits in the lane: a pedestrian that has stepped out before a parked car."""
    waits = scenario.kind is ScenarioKind.DOOR_ZONE and since_s < STAYS_S
    return waits and actor.s_m >= scenario.meet_m - NEARLY_M


def would_hit(actor: ScriptedActor, pace_mps: float, others: MovingBoxes) -> bool:
    """Return whether a crossing actor that goes on hits a vehicle that it would not hit if it stood still."""
    to_go_m = actor.length_m - actor.s_m if pace_mps > 0 else actor.s_m
    left_s = to_go_m / abs(pace_mps)
    goes = time_to_collision_s(_box(actor, pace_mps), others).min(initial=np.inf)
    stands = time_to_collision_s(_box(actor, 0.0), others).min(initial=np.inf)
    return bool(goes < min(left_s, SAFE_S) and stands > goes)


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
