"""How far somebody drives until he stands, when he is somewhere, how fast he has to be for that."""

import math

REACTION_S, BITES_S, BRAKING_MPS2 = 1.0, 0.2, 4.0
"""An attentive driver reacts within so long; his brakes take effect a little later, and this hard."""
SPARE_M = 2.0
"""What scenarios leave him beyond the way that he needs to stop."""
SLOWS_MPS2 = 2.0
"""How hard one brakes for a turn."""


def stopping_m(speed_mps: float, acceleration_mps2: float = 0.0) -> float:
    """The way to a halt of an attentive driver, who until he reacts drives on as he does."""
    gaining = max(acceleration_mps2, 0.0)
    until_s = REACTION_S + BITES_S
    then_mps = speed_mps + gaining * until_s
    return 0.5 * (speed_mps + then_mps) * until_s + then_mps**2 / (2 * BRAKING_MPS2)


def arrival_s(
    way_m: float, speed_mps: float, acceleration_mps2: float, limit_mps: float, through_mps: float = math.inf
) -> float:
    """When somebody has driven a way who accelerates as now up to the limit; infinite if he stands.

    Args:
        through_mps: how fast he can be there, as in a turn: he slows down for it with `SLOWS_MPS2`.
    """
    gains = max(acceleration_mps2, 1e-3) if speed_mps < limit_mps else 1e-3
    if speed_mps < 1e-3 and acceleration_mps2 < 1e-3:
        return math.inf
    limit_mps, through_mps = max(limit_mps, speed_mps), min(through_mps, max(limit_mps, speed_mps))
    # What is gained up to the peak and lost from there on makes the way.
    peak2 = (way_m + speed_mps**2 / (2 * gains) + through_mps**2 / (2 * SLOWS_MPS2)) / (
        0.5 / gains + 0.5 / SLOWS_MPS2
    )
    if peak2 < max(speed_mps, through_mps) ** 2:  # there is no way left to gain on, or none to slow down
        return _gaining_s(way_m, speed_mps, gains if speed_mps < through_mps else -SLOWS_MPS2)
    peak = min(math.sqrt(peak2), limit_mps)
    gained_m = (peak**2 - speed_mps**2) / (2 * gains)
    lost_m = (peak**2 - through_mps**2) / (2 * SLOWS_MPS2)
    kept_s = max(way_m - gained_m - lost_m, 0.0) / peak
    return (peak - speed_mps) / gains + kept_s + (peak - through_mps) / SLOWS_MPS2


def _gaining_s(way_m: float, speed_mps: float, gains_mps2: float) -> float:
    """Time for a way with a constant acceleration."""
    then_mps = math.sqrt(max(speed_mps**2 + 2 * gains_mps2 * way_m, 0.0))
    return 2 * way_m / max(speed_mps + then_mps, 1e-3)


def cruise_mps(way_m: float, time_s: float, speed_mps: float, acceleration_mps2: float) -> float:
    """The speed that, taken up with an acceleration and then kept, makes a way in a time.

    From d = c t - (c - v)² / 2a; as near as can be where the time is too short. Who has more time than he
    needs slows down at once.
    """
    missing_m = way_m - speed_mps * time_s
    if missing_m <= 0:
        return max(way_m, 0.0) / time_s
    reach_mps = acceleration_mps2 * time_s
    return speed_mps + reach_mps - math.sqrt(max(reach_mps**2 - 2 * acceleration_mps2 * missing_m, 0.0))
