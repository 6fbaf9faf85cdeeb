"""Comfort sub-scores of the EPDMS: HC (with the vehicle's past) and EC (two plans 0.5 s apart).

Signals are smoothed and derived as in the devkit. Its acceleration at the middle of the vehicle has no
lateral part at all, so that nuPlan's bound of it always holds. This is kept here.
"""

import numpy as np
from jaxtyping import Float64

from foredrive.driving.epdms.world import STEP_S, EgoBody, EgoMotion
from foredrive.errors import InputError

MIN_ALONG_MPS2, MAX_ALONG_MPS2 = -4.05, 2.40
MAX_JERK_MPS3, MAX_ALONG_JERK_MPS3 = 8.37, 4.13
MAX_YAW_ACCELERATION_RADPS2, MAX_YAW_RATE_RADPS = 1.93, 0.95
EC_ACCELERATION_MPS2, EC_JERK_MPS3, EC_YAW_RATE_RADPS, EC_YAW_ACCELERATION_RADPS2 = 0.7, 0.5, 0.1, 0.1
"""Largest root mean squares of the differences between two plans."""
SMOOTHED, JERK_WINDOW, YAW_WINDOW = 8, 15, 5
"""Windows of the filters (Savitzky & Golay), steps."""


def history_comfort(past: EgoMotion, ego: EgoMotion, body: EgoBody) -> float:
    """Return HC: 1 if acceleration, jerk and turning stay within nuPlan's bounds, else 0.

    Args:
        past: the vehicle before `ego`, with the same steps. It may have none.
    """
    whole = ego.after(past)
    along = _smoothed(_along_mps2(whole, body))
    jerk = _derived(_smoothed(np.abs(whole.acceleration_mps2)), JERK_WINDOW)
    along_jerk = _derived(along, JERK_WINDOW)
    yaw = np.unwrap(whole.yaw_rad)
    turning, turning_more = _derived(yaw, YAW_WINDOW), _derived(yaw, YAW_WINDOW, order=2, degree=3)
    return float(
        ((along > MIN_ALONG_MPS2) & (along < MAX_ALONG_MPS2)).all()
        and (np.abs(jerk) < MAX_JERK_MPS3).all()
        and (np.abs(along_jerk) < MAX_ALONG_JERK_MPS3).all()
        and (np.abs(turning) < MAX_YAW_RATE_RADPS).all()
        and (np.abs(turning_more) < MAX_YAW_ACCELERATION_RADPS2).all()
    )


def extended_comfort(before: EgoMotion, now: EgoMotion, apart_s: float) -> float:
    """Return EC: 1 if two simulated plans agree where they overlap in time, else 0.

    Args:
        before: the earlier plan, as many steps as `now`.
        now: the later one.
        apart_s: time between their starts, s.

    Raises:
        InputError: they are of different lengths, or hardly overlap.
    """
    # The later plan begins `apart` steps after the first: compare the steps that both have
    apart = round(apart_s / STEP_S)
    if len(before.yaw_rad) != len(now.yaw_rad) or not 0 < apart < len(now.yaw_rad) - JERK_WINDOW:
        raise InputError(
            f"extended comfort needs two plans of one length that overlap, got {len(before.yaw_rad)} and "
            f"{len(now.yaw_rad)} steps, {apart_s:g} s apart"
        )
    first, second = (
        _signals(plan) for plan in (before.steps(slice(apart, None)), now.steps(slice(0, -apart)))
    )
    bounds = (EC_ACCELERATION_MPS2, EC_JERK_MPS3, EC_YAW_RATE_RADPS, EC_YAW_ACCELERATION_RADPS2)
    return float(
        all(
            np.sqrt(np.mean((a - b) ** 2)) <= bound for a, b, bound in zip(first, second, bounds, strict=True)
        )
    )


def _signals(plan: EgoMotion) -> tuple[Float64[np.ndarray, "T"], ...]:
    """Return acceleration, jerk, yaw rate and yaw acceleration."""
    acceleration = _smoothed(np.abs(plan.acceleration_mps2))
    yaw = np.unwrap(plan.yaw_rad)
    return (
        acceleration,
        _derived(acceleration, JERK_WINDOW),
        _derived(yaw, YAW_WINDOW),
        _derived(yaw, YAW_WINDOW, order=2),
    )


def _along_mps2(ego: EgoMotion, body: EgoBody) -> Float64[np.ndarray, "T"]:
    """Return the acceleration at the middle as the devkit computes it: both shifts point forward."""
    # Turn rate squared and its change shift the acceleration from axle to middle, as the devkit has it
    turning_more = np.diff(ego.yaw_rate_radps, prepend=ego.yaw_rate_radps[:1]) / STEP_S
    return np.asarray(ego.acceleration_mps2 + body.axle_to_centre_m * (ego.yaw_rate_radps**2 + turning_more))


def _smoothed(values: Float64[np.ndarray, "T"]) -> Float64[np.ndarray, "T"]:
    from scipy.signal import savgol_filter  # takes 0.3 s

    # Rounded as in the devkit
    return np.round(savgol_filter(values, min(SMOOTHED, len(values)), 2), 8)


def _derived(
    values: Float64[np.ndarray, "T"], window: int, order: int = 1, degree: int = 2
) -> Float64[np.ndarray, "T"]:
    from scipy.signal import savgol_filter

    return np.round(savgol_filter(values, min(window, len(values)), degree, deriv=order, delta=STEP_S), 8)
