"""The intelligent driver model (IDM): the acceleration that a driver wants."""

import numpy as np
from jaxtyping import Float64

EXPONENT = 4.0
SLOWING_TIME_S = 0.5
MAX_BRAKING_MPS2 = 8.0
JERK_UP_MPS3 = 3.0
JERK_DOWN_MPS3 = 5.0
JERK_EMERGENCY_MPS3 = 40.0
SOFT_STOP_S = 0.35
CRAWL_MPS = 0.02
"""Time in which braking fades with the speed, s, and the speed below which a vehicle stands, m/s."""
EMERGENCY_MPS2 = 3.5
"""Deceleration above which braking is applied at once, without regard to comfort, m/s²."""


def free_acceleration(
    speed_mps: Float64[np.ndarray, "*n"],
    desired_mps: Float64[np.ndarray, "*n"],
    accel_mps2: Float64[np.ndarray, "*n"],
    decel_mps2: Float64[np.ndarray, "*n"],
) -> Float64[np.ndarray, "*n"]:
    """Return the acceleration on an open road, m/s².

    Up to the wanted speed it is that of Treiber, Hennecke & Helbing (2000), a (1 - (v / v0)^4). Above it
    their model brakes without bound. Here the excess speed is removed within `SLOWING_TIME_S`, with at most
    twice the comfortable deceleration, because the wanted speed falls before curves and drivers have to
    follow it.
    """
    desired = np.maximum(desired_mps, 0.1)
    # a (1 - (v / v0)⁴) up to the wanted speed
    below = accel_mps2 * (1 - (np.minimum(speed_mps, desired) / desired) ** EXPONENT)
    # Above it: remove the excess within a fixed time, with bounded braking
    above = -np.minimum((speed_mps - desired) / SLOWING_TIME_S, 2 * decel_mps2)
    return np.where(speed_mps <= desired, below, above)


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
    """Return the acceleration behind a leader, m/s²: the improved IDM (Treiber & Kesting 2013, eq. 11.26).

    The desired gap is s* = s0 + max(0, v T + v Δv / (2 √(a b))) (Treiber et al. 2000, eq. 3). In contrast to
    the first model, a vehicle that follows at the wanted speed keeps exactly this gap.

    Args:
        free_mps2: the result of `free_acceleration`.
        closing_mps: own speed minus the leader's speed.
        gap_m: gap from bumper to bumper; infinite for an open road.
    """
    # Dynamic part of the desired gap s*
    dynamic = speed_mps * time_gap_s + speed_mps * closing_mps / (2 * np.sqrt(accel_mps2 * decel_mps2))
    # Ratio of desired and present gap: below 1 the vehicle may come closer
    z = (standstill_m + np.maximum(0.0, dynamic)) / np.maximum(gap_m, 0.05)
    eager = np.maximum(free_mps2, 1e-3)
    # Too close: brake by a (1 - z²)
    closer = accel_mps2 * (1 - z**2)
    # Far enough: the free acceleration, reduced as the gap closes
    closing_in = free_mps2 * (1 - np.minimum(z, 1) ** (2 * accel_mps2 / eager))
    below_wanted = np.where(z >= 1, closer, closing_in)
    # Faster than wanted: braking for the speed and for the gap add up
    above_wanted = np.where(z >= 1, free_mps2 + closer, free_mps2)
    return np.where(free_mps2 > 0, below_wanted, above_wanted)
