"""Recoveries: the steering is disturbed for a while, and the expert steers back to its path.

A policy that imitates flawless driving never sees how to recover (Codevilla et al. 2018, sec. IV-C). The
disturbance is temporally correlated noise on the steering wheel, an Ornstein-Uhlenbeck process.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

CORRELATION_S = 0.8
DISTURBED_S = 1.6
RECOVERY_S = 5.0
"""Minimum time from the end of one disturbance to the next, s. The mean is twice as long."""
RETURN_M, RETURN_S = 4.0, 0.8
"""Length scale of the return to the path: `RETURN_M` (m), plus the distance that is driven in `RETURN_S`
(s)."""
STEEPEST_PER_M = 0.12
"""Maximum curvature that steering adds, 1/m."""
LATERAL_MPS2 = 2.5
DISTURBING = 0.4
"""Maximum curvature of the disturbance, as a fraction of the maximum curvature of the steering back."""
FARTHEST_M = 0.8
"""Predicted offset at which the expert takes over from the disturbance, m."""


@dataclass(frozen=True)
class Sway:
    """The deviation of the vehicle from its path, and the disturbance."""

    aside_m: float = 0.0
    """Offset of the rear axle to the left of the path, m."""
    yaw_rad: float = 0.0
    """Heading to the left of the path's heading, rad."""
    curvature: float = 0.0
    """Curvature of the driven path minus that of the planned path, 1/m."""
    noise: float = 0.0
    """Steering angle of the disturbance, rad."""
    next_s: float = 2.0
    """Time until the next disturbance begins, s; negative during a disturbance."""

    def moved(self, distance_m: float) -> "Sway":
        """Return the deviation after a distance at the present steering; a negative distance moves
        backwards."""
        yaw_rad = self.yaw_rad + distance_m * self.curvature
        aside_m = self.aside_m + distance_m * float(np.sin(0.5 * (self.yaw_rad + yaw_rad)))
        return dataclasses.replace(self, aside_m=aside_m, yaw_rad=yaw_rad)


def step_sway(
    sway: Sway, speed_mps: float, wheelbase_m: float, noise_rad: float, dt_s: float, rng: np.random.Generator
) -> Sway:
    """Return the deviation one step later: a kinematic bicycle that is steered by feedback of offset and
    heading.

    d aside = v sin(yaw) dt and d yaw = v κ dt. While it is disturbed, κ = tan(noise) / wheelbase. Afterwards
    κ = -aside / ℓ² - 2 yaw / ℓ, critically damped over the length ℓ. Noise: dx = -x dt / τ + σ √(2 / τ) dW,
    exact for the step.

    Args:
        noise_rad: standard deviation σ of the disturbance, rad.
    """
    next_s = sway.next_s - dt_s if speed_mps > 1.0 or sway.next_s < 0 else sway.next_s
    if next_s < -DISTURBED_S:
        next_s = RECOVERY_S + float(rng.exponential(RECOVERY_S))
    kept = np.exp(-dt_s / CORRELATION_S)
    kick = noise_rad * np.sqrt(1 - kept**2) * float(rng.standard_normal())
    noise = float(sway.noise * kept + (kick if next_s < 0 else 0.0))
    length = RETURN_M + RETURN_S * speed_mps
    most = min(STEEPEST_PER_M, LATERAL_MPS2 / max(speed_mps, 1.0) ** 2)
    if next_s < 0 and abs(sway.aside_m + length * sway.yaw_rad) < FARTHEST_M:
        wanted = np.clip(np.tan(noise) / wheelbase_m, -DISTURBING * most, DISTURBING * most)
    else:
        wanted = -sway.aside_m / length**2 - 2 * sway.yaw_rad / length
    # The wheel turns over some tenths of a second.
    curvature = sway.curvature + (np.clip(wanted, -most, most) - sway.curvature) * (1 - np.exp(-dt_s / 0.2))
    steered = dataclasses.replace(sway, curvature=float(curvature), noise=noise, next_s=next_s)
    return steered.moved(speed_mps * dt_s)
