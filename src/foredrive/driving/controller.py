"""Controller that follows plans: it steers back to the path and keeps the plan's timing.

Lateral and longitudinal control are linear-quadratic regulators of a double integrator, whose gains have a
closed form. Lateral, over the distance driven: offset'' = curvature, with gains 1/λ² and √2/λ for a length λ
that grows with speed. Longitudinal, over time: gains ω² and √2 ω. The curvature and the acceleration of the
plan itself are fed forward.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from foredrive.driving.dynamics import EGO, Vehicle
from foredrive.driving.plans import Plan
from foredrive.scene import BicycleState, Control

RETURN_M, RETURN_S = 2.5, 0.5
"""λ at rest, m, and its increase per m/s of speed, s."""
STEERING_DELAY_S = 0.1
"""Look-ahead time on the path, s: the wheel needs time to turn."""
KEEPING_RADPS = 1.0
"""ω, rad/s: errors along the path decay within a few seconds."""
MAX_LAG_M = 3.0
PREVIEW_S = 0.3
"""Time over which the plan's acceleration is averaged for the feed-forward, s."""
STANDING_MPS = 0.1
HOLDING_MPS2 = 1.0
"""Deceleration command that holds a standing vehicle, m/s²."""
NO_PLAN_MPS2 = 3.0
"""Deceleration while there is no plan, m/s²."""


@dataclass(frozen=True)
class ControllerState:
    """State of the controller: the plan it follows, and the plans that are still being computed."""

    plan: Plan | None = None
    coming: tuple[tuple[float, Plan], ...] = ()
    """Time at which each plan becomes available, s, and the plan. Sorted by time."""

    def expecting(self, plan: Plan, ready_s: float) -> "ControllerState":
        """Return the state with one more plan.

        The plan becomes available at `ready_s` because of the agent's latency.
        """
        coming = sorted([*self.coming, (ready_s, plan)], key=lambda item: item[0])
        return dataclasses.replace(self, coming=tuple(coming))

    def at(self, t_s: float) -> "ControllerState":
        """Return the state with the newest plan that is available at `t_s`."""
        # Of the plans that are ready, the one made last; an older plan never replaces a newer one
        ready = [plan for ready_s, plan in self.coming if ready_s <= t_s + 1e-9]
        if not ready:
            return self
        newest = max(ready, key=lambda plan: plan.made_s)
        if self.plan is not None and self.plan.made_s > newest.made_s:
            newest = self.plan
        return ControllerState(newest, self.coming[len(ready) :])


def follow(
    controller: ControllerState, state: BicycleState, t_s: float, vehicle: Vehicle = EGO
) -> tuple[Control, ControllerState]:
    """Return the control for the step that begins now, and the updated state of the controller."""
    controller = controller.at(t_s)
    if controller.plan is None:
        return Control(-NO_PLAN_MPS2, state.steering_rad), controller
    return _track(controller.plan, state, t_s - controller.plan.made_s, vehicle), controller


def _track(plan: Plan, state: BicycleState, after_s: float, vehicle: Vehicle) -> Control:
    # Position on the path: distance along it and offset to its left
    way_m, left_m = plan.path.project(np.array([state.x_m, state.y_m]))
    # Mean acceleration of the plan over the next moments, within its horizon
    soon_s = max(after_s, min(after_s + PREVIEW_S, plan.horizon_s))
    speed, soon = plan.speed_mps(after_s), plan.speed_mps(soon_s)
    if max(speed, soon, state.speed_mps) < STANDING_MPS:
        return Control(-HOLDING_MPS2, state.steering_rad)
    # The lag is limited, so that a vehicle far behind does not accelerate without bound
    lag_m = min(max(plan.progress_m(after_s) - way_m, -MAX_LAG_M), MAX_LAG_M)
    too_slow = speed - state.speed_mps
    fed_forward = (soon - speed) / PREVIEW_S
    # Feed-forward plus feedback on position and speed: gains ω² and √2 ω
    acceleration = fed_forward + KEEPING_RADPS**2 * lag_m + math.sqrt(2) * KEEPING_RADPS * too_slow
    return Control(acceleration, _steering(plan, state, way_m, left_m, vehicle))


def _steering(plan: Plan, state: BicycleState, way_m: float, left_m: float, vehicle: Vehicle) -> float:
    # λ grows with the speed: gentler steering when fast
    length_m = RETURN_M + RETURN_S * state.speed_mps
    heading, _ = plan.path.course(way_m)
    # Curvature of the path where the vehicle is when the wheel has turned
    _, ahead = plan.path.course(way_m + STEERING_DELAY_S * state.speed_mps)
    aside_m = min(max(left_m, -length_m), length_m)
    askew = math.remainder(state.yaw_rad - heading, 2 * math.pi)
    # Feed-forward curvature, and feedback with gains 1 / λ² and √2 / λ
    curvature = ahead - aside_m / length_m**2 - math.sqrt(2) * askew / length_m
    # Bicycle model: curvature = tan(δ) / wheelbase
    return math.atan(vehicle.wheelbase_m * curvature)
