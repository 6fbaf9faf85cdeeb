"""How the ego vehicle moves: a kinematic bicycle whose actuators have limits.

The reference point is the middle of the rear axle, the ego frame's origin, which never slips sideways:
yaw rate = v tan(δ) / wheelbase (Rajamani, Vehicle Dynamics and Control, sec. 2.2). Motion is seen from above:
heights and slopes belong to whoever knows the road.
"""

import math
from dataclasses import dataclass

from foredrive.errors import InputError
from foredrive.scene import BicycleState, Control

STEP_S = 0.05
"""The simulation runs at 20 Hz."""


@dataclass(frozen=True)
class Vehicle:
    """The ego vehicle's body, and what its actuators can do. The default is what towns are recorded with."""

    wheelbase_m: float = 2.86048
    length_m: float = 4.89238
    width_m: float = 1.83671
    axle_to_centre_m: float = 1.64855
    """From the rear axle forward to the middle of the body."""
    max_steering_rad: float = 0.6
    """Front-wheel angle at the end stop: the rear axle turns on a circle of 4.2 m."""
    max_steering_radps: float = 0.7
    """As fast as a driver turns the wheel in need: 640 °/s at a ratio of 16."""
    max_acceleration_mps2: float = 4.0
    max_braking_mps2: float = 8.0
    """On a dry road."""
    max_jerk_mps3: float = 30.0
    """How fast engine and brakes build up their force: from coasting to full braking in .27 s."""


EGO = Vehicle()


def step(state: BicycleState, control: Control, dt_s: float = STEP_S, vehicle: Vehicle = EGO) -> BicycleState:
    """The state `dt_s` later.

    The wheel turns towards the wanted angle and the force builds up towards the wanted acceleration, as fast
    as they can. The way driven is the arc of the step's mean angle, exact while that is held; a vehicle that
    brakes to a halt within the step stands from there on.

    Raises:
        InputError: the control is not finite, or the time not positive.
    """
    wanted = (control.acceleration_mps2, control.steering_rad)
    if not all(map(math.isfinite, wanted)) or not dt_s > 0:
        raise InputError(f"a step needs finite controls and a positive time, got {control} over {dt_s} s")
    acceleration = _towards(
        _clamped(wanted[0], -vehicle.max_braking_mps2, vehicle.max_acceleration_mps2),
        state.acceleration_mps2,
        vehicle.max_jerk_mps3 * dt_s,
    )
    steering = _towards(
        _clamped(wanted[1], -vehicle.max_steering_rad, vehicle.max_steering_rad),
        state.steering_rad,
        vehicle.max_steering_radps * dt_s,
    )
    speed = state.speed_mps + acceleration * dt_s
    if speed > 0:
        distance_m = 0.5 * (state.speed_mps + speed) * dt_s
    else:
        distance_m = 0.5 * state.speed_mps**2 / -acceleration if acceleration < 0 else 0.0
        speed, acceleration = 0.0, 0.0
    curvature = math.tan(0.5 * (state.steering_rad + steering)) / vehicle.wheelbase_m
    x_m, y_m, yaw_rad = _along_arc(state.x_m, state.y_m, state.yaw_rad, distance_m, curvature)
    return BicycleState(x_m, y_m, yaw_rad, speed, steering, acceleration)


def yaw_rate_radps(state: BicycleState, vehicle: Vehicle = EGO) -> float:
    """How fast the heading turns now, positive to the left."""
    return state.speed_mps * math.tan(state.steering_rad) / vehicle.wheelbase_m


def _along_arc(
    x_m: float, y_m: float, yaw_rad: float, distance_m: float, curvature: float
) -> tuple[float, float, float]:
    """The pose at the end of an arc: its chord points along the mean of both headings."""
    half_turn = 0.5 * distance_m * curvature
    chord_m = distance_m * (math.sin(half_turn) / half_turn if abs(half_turn) > 1e-6 else 1.0)
    along = yaw_rad + half_turn
    turned = math.remainder(yaw_rad + 2 * half_turn, 2 * math.pi)
    return x_m + chord_m * math.cos(along), y_m + chord_m * math.sin(along), turned


def _clamped(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


def _towards(wanted: float, now: float, most: float) -> float:
    """`wanted`, or as near to it as one comes by a change of `most`."""
    return _clamped(wanted, now - most, now + most)
