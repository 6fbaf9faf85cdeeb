"""How fast a driver wants to go: the intelligent driver model and its integration in time."""

import numpy as np
from jaxtyping import Float64

EXPONENT = 4.0
SLOWING_TIME_S = 0.5
HARDEST_BRAKING_MPS2 = 8.0
JERK_UP_MPS3 = 3.0
JERK_DOWN_MPS3 = 5.0
JERK_EMERGENCY_MPS3 = 40.0
SOFT_STOP_S = 0.35
CRAWL_MPS = 0.02
"""Braking fades with the speed in `SOFT_STOP_S`; what is slower than this stands."""
EMERGENCY_MPS2 = 3.5
"""A wish to brake harder than this is followed at once, without regard to comfort."""


def free_acceleration(
    speed_mps: Float64[np.ndarray, "*n"],
    wanted_mps: Float64[np.ndarray, "*n"],
    accel_mps2: Float64[np.ndarray, "*n"],
    decel_mps2: Float64[np.ndarray, "*n"],
) -> Float64[np.ndarray, "*n"]:
    """Acceleration on an open road, m/s².

    Up to the wanted speed that of Treiber, Hennecke & Helbing (2000), a (1 - (v / v0)^4). Above it, where
    their model brakes without bound, the excess is taken off within `SLOWING_TIME_S`, no harder than twice
    the comfortable deceleration: the wanted speed falls before curves and has to be kept up with.
    """
    wanted = np.maximum(wanted_mps, 0.1)
    below = accel_mps2 * (1 - (np.minimum(speed_mps, wanted) / wanted) ** EXPONENT)
    above = -np.minimum((speed_mps - wanted) / SLOWING_TIME_S, 2 * decel_mps2)
    return np.where(speed_mps <= wanted, below, above)


def follow_acceleration(
    free_mps2: Float64[np.ndarray, "*n"],
    speed_mps: Float64[np.ndarray, "*n"],
    closing_mps: Float64[np.ndarray, "*n"],
    gap_m: Float64[np.ndarray, "*n"],
    standstill_m: Float64[np.ndarray, "*n"],
    time_gap_s: Float64[np.ndarray, "*n"],
    accel_mps2: Float64[np.ndarray, "*n"],
    decel_mps2: Float64[np.ndarray, "*n"],
) -> Float64[np.ndarray, "*n"]:
    """Acceleration behind something, m/s²: the improved IDM (Treiber & Kesting 2013, eq. 11.26).

    The desired gap is s* = s0 + max(0, v T + v Δv / (2 √(a b))) (Treiber et al. 2000, eq. 3). In contrast to
    the first model, whoever follows at the wanted speed keeps exactly this gap.

    Args:
        free_mps2: what `free_acceleration` gives.
        closing_mps: own speed minus that of what is ahead.
        gap_m: bumper to bumper; infinite for an open road.
    """
    dynamic = speed_mps * time_gap_s + speed_mps * closing_mps / (2 * np.sqrt(accel_mps2 * decel_mps2))
    z = (standstill_m + np.maximum(0.0, dynamic)) / np.maximum(gap_m, 0.05)
    eager = np.maximum(free_mps2, 1e-3)
    too_near = accel_mps2 * (1 - z**2)
    closing_in = free_mps2 * (1 - np.minimum(z, 1) ** (2 * accel_mps2 / eager))
    below_wanted = np.where(z >= 1, too_near, closing_in)
    above_wanted = np.where(z >= 1, free_mps2 + too_near, free_mps2)
    return np.where(free_mps2 > 0, below_wanted, above_wanted)
