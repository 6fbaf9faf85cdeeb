"""nuPlan's LQR tracker and kinematic bicycle, with the settings of neuro-ncap.

Source: public repository motional/nuplan-devkit, `planning/simulation/controller` (`tracker/lqr.py`,
`tracker/tracker_utils.py`, `motion_model/kinematic_bicycle.py`); settings and the conversion of plans from
atonderski/neuro-ncap, `components/vehicle_model.py`. Two regulators follow a plan. One reaches the speed that
the plan has a horizon later, with one acceleration for the whole horizon. The other brings the lateral error
to 0 with one steering rate, over the linearised motion at that speed. Speed and curvature of the plan are
least-squares fits to its poses. Neuro-ncap sets both lags of the bicycle to 0.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from foredrive.driving.dynamics import Vehicle
from foredrive.scene import BicycleState

STEP_S = 0.1
"""Time between two commands, step of the bicycle and of the fits, s."""
HORIZON = 10
"""Steps that the regulators look ahead."""
SPEED_COST, ACCELERATION_COST = 10.0, 1.0
LATERAL_COST, STEERING_RATE_COST = 20.0, 0.05
"""Costs of neuro-ncap. Heading and steering angle cost nothing."""
JERK_PENALTY, CURVATURE_RATE_PENALTY, FIRST_CURVATURE_PENALTY = 1e-6, 1e-5, 1e-10
STOPPING_GAIN_PER_S, STOPPING_MPS = 1.5, 0.5


@dataclass(frozen=True, eq=False)
class LqrPlan:
    """A plan in the ego frame of the time at which it was made."""

    origin: BicycleState
    """The vehicle at that time."""
    xy_m: Float64[np.ndarray, "T 2"]
    dt_s: float
    """Time between two points. The first lies one such time ahead."""


def lqr_step(
    plan: LqrPlan, state: BicycleState, after_s: float, vehicle: Vehicle, near_m: float, pose_feedback: bool
) -> BicycleState:
    """Return the vehicle `STEP_S` later.

    Args:
        after_s: time since the plan was made, s.
        near_m: points of the plan nearer than this are ignored; if the last one is, the vehicle stops.
        pose_feedback: see `Rules.pose_feedback`.
    """
    # A plan that ends right here means: stop
    if np.hypot(*plan.xy_m[-1]) < near_m:
        acceleration, steering_rate = -STOPPING_GAIN_PER_S * state.speed_mps, 0.0
    else:
        local = _seen_from(plan.origin, state)
        # The released code sets the vehicle back to the plan's origin
        if not pose_feedback:
            local = dataclasses.replace(local, x_m=0.0, y_m=0.0, yaw_rad=0.0)
        times_s, poses = _reference(plan, local, after_s, near_m, pose_feedback)
        acceleration, steering_rate = _commands(times_s, poses, local, after_s, vehicle.wheelbase_m)
    acceleration = min(max(acceleration, -vehicle.max_braking_mps2), vehicle.max_acceleration_mps2)
    return _bicycle(state, acceleration, steering_rate, vehicle)


def _bicycle(
    state: BicycleState, acceleration_mps2: float, steering_radps: float, vehicle: Vehicle
) -> BicycleState:
    """Return the state after one explicit Euler step."""
    # Euler: positions and heading change by the speed and steering before the step
    v, yaw, most = state.speed_mps, state.yaw_rad, vehicle.max_steering_rad
    return BicycleState(
        x_m=state.x_m + STEP_S * v * math.cos(yaw),
        y_m=state.y_m + STEP_S * v * math.sin(yaw),
        yaw_rad=math.remainder(
            yaw + STEP_S * v * math.tan(state.steering_rad) / vehicle.wheelbase_m, 2 * math.pi
        ),
        speed_mps=v + STEP_S * acceleration_mps2,
        steering_rad=min(max(state.steering_rad + STEP_S * steering_radps, -most), most),
        acceleration_mps2=acceleration_mps2,
    )


def _seen_from(origin: BicycleState, state: BicycleState) -> BicycleState:
    """Return a state with its pose in the ego frame of another."""
    dx, dy = state.x_m - origin.x_m, state.y_m - origin.y_m
    cos, sin = math.cos(origin.yaw_rad), math.sin(origin.yaw_rad)
    # Heading difference in -π … π
    yaw = math.remainder(state.yaw_rad - origin.yaw_rad, 2 * math.pi)
    return dataclasses.replace(state, x_m=cos * dx + sin * dy, y_m=cos * dy - sin * dx, yaw_rad=yaw)


def _reference(
    plan: LqrPlan, local: BicycleState, after_s: float, near_m: float, pose_feedback: bool
) -> tuple[Float64[np.ndarray, "N"], Float64[np.ndarray, "N 3"]]:
    """Return times since the plan was made, s, and poses (x, y, heading) at steps of `STEP_S`.

    The reference begins at the plan's origin. Without pose feedback it begins there at each command.
    """
    # Headings by central differences; the last point is repeated
    ahead = np.vstack([np.zeros(2), plan.xy_m, plan.xy_m[-1:]])
    chord = ahead[2:] - ahead[:-2]
    heading = np.arctan2(chord[:, 1], chord[:, 0])
    # Points too close to the origin have no direction and are left out
    kept = np.hypot(*plan.xy_m.T) >= near_m
    first_s = 0.0 if pose_feedback else after_s
    first = np.array([[0.0, 0.0, 0.0]])
    times = np.concatenate([[first_s], plan.dt_s * np.arange(1, len(kept) + 1)[kept]])
    poses = np.vstack([first, np.column_stack([plan.xy_m, heading])[kept]])
    # Unwrapped headings can be interpolated
    poses[:, 2] = np.unwrap(poses[:, 2])
    # Poses at steps of the regulator, up to the last point
    at_s = first_s + STEP_S * np.arange(int((times[-1] - first_s) / STEP_S + 1e-6) + 1)
    return at_s, np.stack([np.interp(at_s, times, column) for column in poses.T], axis=1)


def _commands(
    times_s: Float64[np.ndarray, "N"],
    poses: Float64[np.ndarray, "N 3"],
    local: BicycleState,
    after_s: float,
    wheelbase_m: float,
) -> tuple[float, float]:
    """Return acceleration, m/s², and steering rate, rad/s."""
    speeds, curvatures = fitted_profiles(poses)
    # Speed wanted at the end of the horizon, and nuPlan's rule for stopping
    wanted_mps = float(np.interp(after_s + HORIZON * STEP_S, times_s[:-1], speeds))
    v = local.speed_mps
    if wanted_mps <= STOPPING_MPS and v <= STOPPING_MPS:
        return -STOPPING_GAIN_PER_S * (v - wanted_mps), 0.0
    horizon_s = HORIZON * STEP_S
    # Minimum of q (v + a T - v_wanted)² + r a² over the constant acceleration a
    acceleration = (
        -horizon_s * SPEED_COST * (v - wanted_mps) / (horizon_s**2 * SPEED_COST + ACCELERATION_COST)
    )
    x, y, heading = (float(np.interp(after_s, times_s, column)) for column in poses.T)
    # Lateral and heading error in the frame of the reference pose
    error_m = -(local.x_m - x) * math.sin(heading) + (local.y_m - y) * math.cos(heading)
    error_rad = math.remainder(local.yaw_rad - heading, 2 * math.pi)
    # Speeds and reference curvatures over the horizon
    steps_s = STEP_S * np.arange(HORIZON)
    rate = _steering_rate(
        np.array([error_m, error_rad, local.steering_rad]),
        v + acceleration * steps_s,
        np.interp(after_s + steps_s, times_s[:-1], curvatures),
        wheelbase_m,
    )
    return acceleration, rate


def _steering_rate(
    state: Float64[np.ndarray, "3"],
    speeds: Float64[np.ndarray, "H"],
    curvatures: Float64[np.ndarray, "H"],
    wheelbase_m: float,
) -> float:
    """Return the constant steering rate that costs least, rad/s.

    Args:
        state: lateral error, m, heading error, rad, steering angle, rad.
    """
    # State at the end without and with a unit steering rate, by the linearised dynamics
    free, forced = state, np.zeros(3)
    for v, curvature in zip(speeds.tolist(), curvatures.tolist(), strict=True):
        A = np.eye(3)
        A[0, 1], A[1, 2] = STEP_S * v, STEP_S * v / wheelbase_m
        free = A @ free - [0.0, STEP_S * v * curvature, 0.0]
        forced = A @ forced + [0.0, 0.0, STEP_S]
    # Minimum of q (free + rate · forced)² + r rate² over the rate
    return float(-LATERAL_COST * forced[0] * free[0] / (LATERAL_COST * forced[0] ** 2 + STEERING_RATE_COST))


def fitted_profiles(
    poses: Float64[np.ndarray, "N 3"],
) -> tuple[Float64[np.ndarray, "N-1"], Float64[np.ndarray, "N-1"]]:
    """Return speed, m/s, and curvature, 1/m, at all poses but the last, by regularised least squares.

    Unknowns are the first value and its rates. Differences of accelerations, and rates of the curvature, are
    penalised (nuPlan's `get_velocity_curvature_profiles_with_derivatives_from_poses`).
    """
    # Displacements and turns between poses, turns in -π … π
    moved = np.diff(poses, axis=0)
    turned = np.remainder(moved[:, 2] + np.pi, 2 * np.pi) - np.pi
    count = len(moved)
    # Cumulative sums turn the first value and its rates into values
    sums = np.tri(count) * STEP_S
    sums[:, 0] = 1.0  # value at step k = first + STEP_S · Σ rates before k
    # Displacements are linear in the speeds, along the known headings
    direction = np.stack([np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])], axis=1)
    rows = (STEP_S * direction[:, :, None] * sums[:, None, :]).reshape(2 * count, count)
    jerk = np.zeros((max(count - 2, 0), count))
    jerk[:, 1:] = np.diff(np.eye(count - 1), axis=0)
    # The jerk penalty acts on differences of the accelerations
    speeds = sums @ _least_squares(rows, moved[:, :2].reshape(-1), JERK_PENALTY * jerk.T @ jerk)
    penalty = CURVATURE_RATE_PENALTY * np.eye(count)
    penalty[0, 0] = FIRST_CURVATURE_PENALTY
    # Turns are linear in the curvatures, given the speeds
    curvatures = sums @ _least_squares(STEP_S * speeds[:, None] * sums, turned, penalty)
    return speeds, curvatures


def _least_squares(
    A: Float64[np.ndarray, "M n"], y: Float64[np.ndarray, "M"], penalty: Float64[np.ndarray, "n n"]
) -> Float64[np.ndarray, "n"]:
    solved: Float64[np.ndarray, n] = np.linalg.pinv(A.T @ A + penalty) @ A.T @ y
    return solved
