"""Follows plans: steers back to the path, and keeps to its times.

Both controllers are linear-quadratic regulators of a double integrator, whose gains have a closed form.
Across the path, over the way driven: offset'' = curvature, with gains 1/λ² and √2/λ for a length λ that grows
with speed. Along it, over time: gains ω² and √2 ω. What the plan itself asks for is fed forward.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from foredrive.scene import BicycleState, Control
from foredrive.simulation.dynamics import EGO, Vehicle
from foredrive.simulation.plans import Plan

RETURN_M, RETURN_S = 2.5, 0.5
"""λ at rest, and what each m/s adds to it."""
STEERING_DELAY_S = 0.1
"""The path is read this far ahead: the wheel needs time to turn."""
KEEPING_RADPS = 1.0
"""ω: errors along the path are gone after a few seconds."""
LARGEST_LAG_M = 3.0
PREVIEW_S = 0.3
"""The acceleration fed forward is the plan's over this time."""
STANDING_MPS = 0.1
HOLDING_MPS2 = 1.0
"""How hard the brake holds a standing vehicle."""
NO_PLAN_MPS2 = 3.0
"""How hard it brakes while there is no plan."""


@dataclass(frozen=True)
class Following:
    """What the controller knows: the plan it follows, and those that are still being computed."""

    plan: Plan | None = None
    coming: tuple[tuple[float, Plan], ...] = ()
    """When each is there, s, in order of time, and the plan."""

    def expecting(self, plan: Plan, ready_s: float) -> "Following":
        """Also with a plan that the agent's latency keeps back until `ready_s`."""
        coming = sorted([*self.coming, (ready_s, plan)], key=lambda item: item[0])
        return dataclasses.replace(self, coming=tuple(coming))

    def at(self, t_s: float) -> "Following":
        """With the newest plan that is there at a time."""
        ready = [plan for ready_s, plan in self.coming if ready_s <= t_s + 1e-9]
        if not ready:
            return self
        newest = max(ready, key=lambda plan: plan.made_s)
        if self.plan is not None and self.plan.made_s > newest.made_s:
            newest = self.plan
        return Following(newest, self.coming[len(ready) :])


def follow(
    following: Following, state: BicycleState, t_s: float, vehicle: Vehicle = EGO
) -> tuple[Control, Following]:
    """The control for the step that begins now, and what the controller knows from now on."""
    following = following.at(t_s)
    if following.plan is None:
        return Control(-NO_PLAN_MPS2, state.steering_rad), following
    return _track(following.plan, state, t_s - following.plan.made_s, vehicle), following


def _track(plan: Plan, state: BicycleState, after_s: float, vehicle: Vehicle) -> Control:
    way_m, left_m = plan.path.project(np.array([state.x_m, state.y_m]))
    soon_s = max(after_s, min(after_s + PREVIEW_S, plan.horizon_s))
    speed, soon = plan.speed_mps(after_s), plan.speed_mps(soon_s)
    if max(speed, soon, state.speed_mps) < STANDING_MPS:
        return Control(-HOLDING_MPS2, state.steering_rad)
    lag_m = min(max(plan.progress_m(after_s) - way_m, -LARGEST_LAG_M), LARGEST_LAG_M)
    too_slow = speed - state.speed_mps
    fed_forward = (soon - speed) / PREVIEW_S
    acceleration = fed_forward + KEEPING_RADPS**2 * lag_m + math.sqrt(2) * KEEPING_RADPS * too_slow
    return Control(acceleration, _steering(plan, state, way_m, left_m, vehicle))


def _steering(plan: Plan, state: BicycleState, way_m: float, left_m: float, vehicle: Vehicle) -> float:
    length_m = RETURN_M + RETURN_S * state.speed_mps
    heading, _ = plan.path.course(way_m)
    _, ahead = plan.path.course(way_m + STEERING_DELAY_S * state.speed_mps)
    aside_m = min(max(left_m, -length_m), length_m)
    askew = math.remainder(state.yaw_rad - heading, 2 * math.pi)
    curvature = ahead - aside_m / length_m**2 - math.sqrt(2) * askew / length_m
    return math.atan(vehicle.wheelbase_m * curvature)
