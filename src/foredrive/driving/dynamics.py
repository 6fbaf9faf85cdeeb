"""Motion of the ego vehicle: a kinematic bicycle with actuator limits.

The reference point is the middle of the rear axle, which is the origin of the ego frame and never slips
sideways: yaw rate = v tan(δ) / wheelbase (Rajamani, Vehicle Dynamics and Control, sec. 2.2). Motion is
computed in the plane. Heights and slopes come from the code that knows the road.
"""

import math
from dataclasses import dataclass

from foredrive.errors import InputError
from foredrive.scene import BicycleState, Control

STEP_S = 0.05
"""Length of a simulation step, s: the simulation runs at 20 Hz."""


@dataclass(frozen=True)
class Vehicle:
    """Body and actuator limits of the ego vehicle. The default is the vehicle used to record the towns."""

    wheelbase_m: float = 2.86048
    length_m: float = 4.89238
    width_m: float = 1.83671
    axle_to_centre_m: float = 1.64855
    """Distance from the rear axle forward to the middle of the body, m."""
    max_steering_rad: float = 0.6
    """Front-wheel angle at the end stop, rad: the rear axle turns on a circle of radius 4.2 m."""
    max_steering_radps: float = 0.7
    """Rate of the front-wheel angle, rad/s: a driver in an emergency turns the wheel at 640 °/s, with a
    ratio of 16."""
    max_acceleration_mps2: float = 4.0
    max_braking_mps2: float = 8.0
    """On a dry road, m/s²."""
    max_jerk_mps3: float = 30.0
    """Rate at which engine and brakes build up their force, m/s³: full braking after 0.27 s of coasting."""


EGO = Vehicle()


def step(state: BicycleState, control: Control, dt_s: float = STEP_S, vehicle: Vehicle = EGO) -> BicycleState:
    """Return the state `dt_s` later.

    The front wheel turns towards the commanded angle and the acceleration changes towards the commanded
    value, both at limited rates. The vehicle drives the arc of the step's mean steering angle, which is exact
    for a constant angle. A vehicle that brakes to a halt within the step stays at rest from there on.

    Raises:
        InputError: the control is not finite, or the time is not positive.
    """
    wanted = (control.acceleration_mps2, control.steering_rad)
    if not all(map(math.isfinite, wanted)) or not dt_s > 0:
        raise InputError(f"a step needs finite controls and a positive time, got {control} over {dt_s} s")
    # Acceleration and steering move towards the commands at limited rates
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
    # Mean speed over the step; braking to a halt ends the motion within the step
    speed = state.speed_mps + acceleration * dt_s
    if speed > 0:
        distance_m = 0.5 * (state.speed_mps + speed) * dt_s
    else:
        distance_m = 0.5 * state.speed_mps**2 / -acceleration if acceleration < 0 else 0.0
        speed, acceleration = 0.0, 0.0
    # The mean steering angle of the step gives the arc's curvature
    curvature = math.tan(0.5 * (state.steering_rad + steering)) / vehicle.wheelbase_m
    x_m, y_m, yaw_rad = _along_arc(state.x_m, state.y_m, state.yaw_rad, distance_m, curvature)
    return BicycleState(x_m, y_m, yaw_rad, speed, steering, acceleration)


def yaw_rate_radps(state: BicycleState, vehicle: Vehicle = EGO) -> float:
    """Return the current yaw rate, rad/s, positive to the left."""
    return state.speed_mps * math.tan(state.steering_rad) / vehicle.wheelbase_m


def _along_arc(
    x_m: float, y_m: float, yaw_rad: float, distance_m: float, curvature: float
) -> tuple[float, float, float]:
    """Return the pose (x, y, yaw) at the end of an arc. The chord points along the mean of both headings."""
    half_turn = 0.5 * distance_m * curvature
    # Length of the chord of an arc: sin(x) / x, with x half the turned angle
    chord_m = distance_m * (math.sin(half_turn) / half_turn if abs(half_turn) > 1e-6 else 1.0)
    along = yaw_rad + half_turn
    turned = math.remainder(yaw_rad + 2 * half_turn, 2 * math.pi)
    return x_m + chord_m * math.cos(along), y_m + chord_m * math.sin(along), turned


def _clamped(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


def _towards(wanted: float, now: float, max_change: float) -> float:
    """Move from `now` towards `wanted` by at most `max_change`."""
    return _clamped(wanted, now - max_change, now + max_change)
