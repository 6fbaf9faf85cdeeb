"""Ride comfort: accelerations, jerks and turn rates of a drive against the bounds of nuPlan's metrics."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from foredrive.driving.dynamics import EGO, STEP_S, Vehicle, yaw_rate_radps
from foredrive.errors import InputError
from foredrive.scene import BicycleState

ACCELERATION_S, JERK_S = 0.8, 1.5
"""Window lengths, s. Derivatives are those of quadratics fitted over a window (Savitzky & Golay 1964), as
in nuPlan."""


class Bounds(NamedTuple):
    """Comfort bounds of nuPlan's ego_is_comfortable (Karnchanachari et al. 2024), taken from human drives."""

    min_longitudinal_mps2: float = -4.05
    max_longitudinal_mps2: float = 2.40
    max_lateral_mps2: float = 4.89
    max_jerk_mps3: float = 8.37
    max_longitudinal_jerk_mps3: float = 4.13
    max_yaw_rate_radps: float = 0.95
    max_yaw_acceleration_radps2: float = 1.93


BOUNDS = Bounds()


@dataclass(frozen=True)
class Comfort:
    """Extreme values of a drive, measured at the rear axle."""

    braking_mps2: float
    """Hardest braking, m/s², positive."""
    acceleration_mps2: float
    lateral_mps2: float
    jerk_mps3: float
    """Largest norm of the jerk vector, m/s³."""
    longitudinal_jerk_mps3: float
    yaw_rate_radps: float
    yaw_acceleration_radps2: float
    comfortable_share: float
    """Share of the time in which all bounds hold, 0 to 1."""

    @property
    def comfortable(self) -> bool:
        """Return whether all bounds hold all the time."""
        return self.comfortable_share == 1.0


def comfort_of(
    states: Sequence[BicycleState], dt_s: float = STEP_S, vehicle: Vehicle = EGO, bounds: Bounds = BOUNDS
) -> Comfort:
    """Compute the comfort of a drive.

    Args:
        states: one state every `dt_s`.

    Raises:
        InputError: the drive is shorter than `JERK_S`.
    """
    from scipy.signal import savgol_filter  # takes 0.3 s

    # Odd window lengths near the wanted durations
    window = {seconds: 2 * round(0.5 * seconds / dt_s) + 1 for seconds in (ACCELERATION_S, JERK_S)}
    if len(states) < window[JERK_S]:
        raise InputError(f"the comfort metrics need at least {window[JERK_S]} states, got {len(states)}")

    def smoothed(values: Float64[np.ndarray, "T"], seconds: float, derivative: int) -> np.ndarray:
        return savgol_filter(values, window[seconds], 2, deriv=derivative, delta=dt_s)

    speed = np.array([state.speed_mps for state in states])
    yaw_rate = np.array([yaw_rate_radps(state, vehicle) for state in states])
    # Acceleration along is the derivative of the speed, across it is v ω
    along = smoothed(speed, ACCELERATION_S, 1)
    aside = smoothed(speed * yaw_rate, ACCELERATION_S, 0)
    jerk_along = smoothed(speed, JERK_S, 2)
    # Jerk in the turning frame of the vehicle: (a_x' - ω a_y, a_y' + ω a_x)
    jerk = np.hypot(
        smoothed(along, JERK_S, 1) - yaw_rate * aside, smoothed(aside, JERK_S, 1) + yaw_rate * along
    )
    turning = smoothed(yaw_rate, ACCELERATION_S, 0)
    turning_more = smoothed(yaw_rate, JERK_S, 1)
    # Steps at which all bounds hold
    kept = (along >= bounds.min_longitudinal_mps2) & (along <= bounds.max_longitudinal_mps2)
    for values, bound in (
        (aside, bounds.max_lateral_mps2),
        (jerk, bounds.max_jerk_mps3),
        (jerk_along, bounds.max_longitudinal_jerk_mps3),
        (turning, bounds.max_yaw_rate_radps),
        (turning_more, bounds.max_yaw_acceleration_radps2),
    ):
        kept &= np.abs(values) <= bound
    return Comfort(
        braking_mps2=max(0.0, float(-along.min())),
        acceleration_mps2=max(0.0, float(along.max())),
        lateral_mps2=float(np.abs(aside).max()),
        jerk_mps3=float(jerk.max()),
        longitudinal_jerk_mps3=float(np.abs(jerk_along).max()),
        yaw_rate_radps=float(np.abs(turning).max()),
        yaw_acceleration_radps2=float(np.abs(turning_more).max()),
        comfortable_share=float(kept.mean()),
    )
