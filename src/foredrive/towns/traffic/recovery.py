"""Recoveries: the steering is disturbed for a while, and the expert steers back to its path.

A policy that imitates flawless driving never sees how to recover (Codevilla et al. 2018, sec. IV-C). The
disturbance is temporally correlated noise on the steering wheel, an Ornstein-Uhlenbeck process.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

CORRELATION_S = 0.8
DISTURBANCE_S = 1.6
RECOVERY_S = 5.0
"""Minimum time from the end of one disturbance to the next, s. The mean is twice as long."""
RETURN_M, RETURN_S = 4.0, 0.8
"""Length scale of the return to the path: `RETURN_M` (m), plus the distance that is driven in `RETURN_S`
(s)."""
MAX_CURVATURE_PER_M = 0.12
"""Maximum curvature that steering adds, 1/m."""
LATERAL_MPS2 = 2.5
DISTURBANCE_SHARE = 0.4
"""Maximum curvature of the disturbance, as a fraction of the maximum curvature of the steering back."""
MAX_OFFSET_M = 0.8
"""Predicted offset at which the expert takes over from the disturbance, m."""


@dataclass(frozen=True)
class PathDeviation:
    """The deviation of the vehicle from its path, and the disturbance."""

    lateral_m: float = 0.0
    """Offset of the rear axle to the left of the path, m."""
    yaw_rad: float = 0.0
    """Heading to the left of the path's heading, rad."""
    curvature: float = 0.0
    """Curvature of the driven path minus that of the planned path, 1/m."""
    noise: float = 0.0
    """Steering angle of the disturbance, rad."""
    next_s: float = 2.0
    """Time until the next disturbance begins, s; negative during a disturbance."""

    def moved(self, distance_m: float) -> "PathDeviation":
        """Return the deviation after a distance at the present steering; a negative distance moves
        backwards."""
        # Curvature is constant over the distance: heading is linear, position by the mean heading
        yaw_rad = self.yaw_rad + distance_m * self.curvature
        lateral_m = self.lateral_m + distance_m * float(np.sin(0.5 * (self.yaw_rad + yaw_rad)))
        return dataclasses.replace(self, lateral_m=lateral_m, yaw_rad=yaw_rad)


def step_deviation(
    deviation: PathDeviation,
    speed_mps: float,
    wheelbase_m: float,
    noise_rad: float,
    dt_s: float,
    rng: np.random.Generator,
) -> PathDeviation:
    """Return the deviation one step later: a kinematic bicycle that is steered by feedback of offset and
    heading.

    d aside = v sin(yaw) dt and d yaw = v κ dt. While it is disturbed, κ = tan(noise) / wheelbase. Afterwards
    κ = -aside / ℓ² - 2 yaw / ℓ, critically damped over the length ℓ. Noise: dx = -x dt / τ + σ √(2 / τ) dW,
    exact for the step.

    Args:
        noise_rad: standard deviation σ of the disturbance, rad.
    """
    # The clock runs only while driving; a disturbance always runs to its end
    next_s = deviation.next_s - dt_s if speed_mps > 1.0 or deviation.next_s < 0 else deviation.next_s
    if next_s < -DISTURBANCE_S:
        # Draw the next time: at least `RECOVERY_S`, on average twice that
        next_s = RECOVERY_S + float(rng.exponential(RECOVERY_S))
    # Exact step of the Ornstein-Uhlenbeck process; without disturbance the noise decays
    decay = np.exp(-dt_s / CORRELATION_S)
    innovation = noise_rad * np.sqrt(1 - decay**2) * float(rng.standard_normal())
    noise = float(deviation.noise * decay + (innovation if next_s < 0 else 0.0))
    length = RETURN_M + RETURN_S * speed_mps
    # Limit by the vehicle's steering and by lateral acceleration v² κ
    max_curvature = min(MAX_CURVATURE_PER_M, LATERAL_MPS2 / max(speed_mps, 1.0) ** 2)
    # Disturb while the predicted offset stays small, else steer back
    if next_s < 0 and abs(deviation.lateral_m + length * deviation.yaw_rad) < MAX_OFFSET_M:
        target = np.clip(
            np.tan(noise) / wheelbase_m, -DISTURBANCE_SHARE * max_curvature, DISTURBANCE_SHARE * max_curvature
        )
    else:
        # Critically damped: both poles at -1 / ℓ
        target = -deviation.lateral_m / length**2 - 2 * deviation.yaw_rad / length
    # The wheel turns over some tenths of a second.
    curvature = deviation.curvature + (
        np.clip(target, -max_curvature, max_curvature) - deviation.curvature
    ) * (1 - np.exp(-dt_s / 0.2))
    steered = dataclasses.replace(deviation, curvature=float(curvature), noise=noise, next_s=next_s)
    return steered.moved(speed_mps * dt_s)
