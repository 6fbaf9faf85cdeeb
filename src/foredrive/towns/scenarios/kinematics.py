"""Stopping distance, arrival time and required speed of a vehicle or a person."""

import math

REACTION_S, BITES_S, BRAKING_MPS2 = 1.0, 0.2, 4.0
"""Reaction time of an attentive driver, s, delay of the brakes, s, and deceleration, m/s²."""
SPARE_M = 2.0
"""Distance that scenarios leave beyond the stopping distance, m."""
SLOWS_MPS2 = 2.0
"""Deceleration before a turn, m/s²."""


def stopping_m(speed_mps: float, acceleration_mps2: float = 0.0) -> float:
    """Return the stopping distance of an attentive driver, m.

    Until the brakes take effect the vehicle keeps its acceleration, if that is positive.
    """
    gaining = max(acceleration_mps2, 0.0)
    until_s = REACTION_S + BITES_S
    # Accelerate until the brakes take effect, then brake: v²/(2b)
    then_mps = speed_mps + gaining * until_s
    return 0.5 * (speed_mps + then_mps) * until_s + then_mps**2 / (2 * BRAKING_MPS2)


def arrival_s(
    way_m: float, speed_mps: float, acceleration_mps2: float, limit_mps: float, through_mps: float = math.inf
) -> float:
    """Return the time to drive a distance, s, with the current acceleration up to the limit.

    The time is infinite for a vehicle that stands and does not accelerate.

    Args:
        through_mps: maximum speed at the end, m/s, for instance in a turn. The vehicle slows down for it with
            `SLOWS_MPS2`.
    """
    # Gain until the limit; a small number avoids a division by zero
    gains = max(acceleration_mps2, 1e-3) if speed_mps < limit_mps else 1e-3
    if speed_mps < 1e-3 and acceleration_mps2 < 1e-3:
        return math.inf
    limit_mps, through_mps = max(limit_mps, speed_mps), min(through_mps, max(limit_mps, speed_mps))
    # v₀ → peak with `gains`, peak → through with `SLOWS_MPS2`: solve for the peak's square
    # The distance gained up to the peak speed and lost after it make up the way.
    peak2 = (way_m + speed_mps**2 / (2 * gains) + through_mps**2 / (2 * SLOWS_MPS2)) / (
        0.5 / gains + 0.5 / SLOWS_MPS2
    )
    if peak2 < max(speed_mps, through_mps) ** 2:  # no way left to accelerate, or too little to slow down
        return _gaining_s(way_m, speed_mps, gains if speed_mps < through_mps else -SLOWS_MPS2)
    # The limit may cap the peak: the rest of the way is driven at constant speed
    peak = min(math.sqrt(peak2), limit_mps)
    gained_m = (peak**2 - speed_mps**2) / (2 * gains)
    lost_m = (peak**2 - through_mps**2) / (2 * SLOWS_MPS2)
    kept_s = max(way_m - gained_m - lost_m, 0.0) / peak
    return (peak - speed_mps) / gains + kept_s + (peak - through_mps) / SLOWS_MPS2


def _gaining_s(way_m: float, speed_mps: float, gains_mps2: float) -> float:
    """Return the time for a distance at constant acceleration, s."""
    then_mps = math.sqrt(max(speed_mps**2 + 2 * gains_mps2 * way_m, 0.0))
    return 2 * way_m / max(speed_mps + then_mps, 1e-3)


def cruise_mps(way_m: float, time_s: float, speed_mps: float, acceleration_mps2: float) -> float:
    """Return the speed, m/s, that covers a distance in a time if first reached at constant acceleration.

    Solves d = c t - (c - v)² / 2a for c. If the time is too short, the result is as near as possible. If
    there is more time than needed, the vehicle slows down at once.
    """
    # Enough time: a constant speed suffices
    missing_m = way_m - speed_mps * time_s
    if missing_m <= 0:
        return max(way_m, 0.0) / time_s
    # Root of the quadratic equation for c; the discriminant is clamped if the time is too short
    reach_mps = acceleration_mps2 * time_s
    return speed_mps + reach_mps - math.sqrt(max(reach_mps**2 - 2 * acceleration_mps2 * missing_m, 0.0))
