"""Real automotive lidars, with channels, firing times and limits from their manuals.

Values missing from the manuals are assumed. The divergence of the HDL-32E and the Pandar64 is that of
Velodyne's VLP-16. Beams are round cones, although the beams of real lasers are wider than high.
"""

import math

from jaxtyping import Float
from torch import Tensor

from foredrive.sensors.lidar import SpinningLidar

_DIVERGENCE_RAD = 3.0e-3

_PANDAR64_ELEVATION_DEG = (
    *(14.882, 11.032, 8.059, 5.057, 3.040, 2.028, 1.860, 1.688, 1.522, 1.351, 1.184, 1.013, 0.846),
    *(0.675, 0.508, 0.337, 0.169, 0.0, -0.169, -0.337, -0.508, -0.675, -0.845, -1.013, -1.184, -1.351),
    *(-1.522, -1.688, -1.860, -2.028, -2.198, -2.365, -2.536, -2.700, -2.873, -3.040, -3.210, -3.375),
    *(-3.548, -3.712, -3.884, -4.050, -4.221, -4.385, -4.558, -4.720, -4.892, -5.057, -5.229, -5.391),
    *(-5.565, -5.726, -5.898, -6.061, -7.063, -8.059, -9.060, -9.885, -11.032, -12.006, -12.974, -13.930),
    *(-18.889, -24.897),
)
_PANDAR64_CLOCKWISE_DEG = (
    *(-1.042,) * 6,
    *(1.042, 3.125, 5.208, -5.208, -3.125, -1.042) * 8,
    *(-1.042,) * 10,
)
_PANDAR64_PAIRS = (
    *((51, 61), (45, 60), (39, 57), (9, 55), (49, 63), (43, 59), (7, 56), (53, 64), (47, 62), (41, 58)),
    *((6, 54), (5, 48), (4, 50), (3, 52), (2, 46), (1, 44), (24, 33), (27, 42), (21, 36), (15, 30)),
    *((22, 37), (16, 31), (10, 25), (19, 34), (13, 28), (20, 35), (14, 29), (8, 23), (17, 32), (11, 26)),
    *((18, 38), (12, 40)),
)
"""Pairs of lasers that fire together. The last pair to fire comes first."""


def pandar64(T_ego_lidar: Float[Tensor, "4 4"], rate_hz: float = 10.0) -> SpinningLidar:
    """Return Hesai's Pandar64, the lidar of PandaSet.

    Its channels are dense from -6° to 2°. Channel 0 is the highest, as in Hesai's numbering. Angles, azimuth
    offsets and firing times are from the user's manual, appendices I and II. Each real device has its own
    calibration, which differs by some hundredths of a degree.
    """
    before_end_us = [0.0] * 64
    for k, pair in enumerate(_PANDAR64_PAIRS):
        # Firing sequence of the manual, counted backwards from the last pair
        for laser in pair:
            before_end_us[laser - 1] = 1.304 * min(k, 15) + 1.968 * max(k - 15, 0)
    first_us = max(before_end_us)
    return SpinningLidar(
        elevation_rad=_radians(_PANDAR64_ELEVATION_DEG),
        azimuth_steps=round(18_000 / rate_hz),
        rate_hz=rate_hz,
        min_range_m=0.3,
        max_range_m=200.0,
        range_noise_m=0.02,
        T_ego_lidar=T_ego_lidar,
        firing_s=tuple(1e-6 * (first_us - us) for us in before_end_us),
        azimuth_offset_rad=tuple(-x for x in _radians(_PANDAR64_CLOCKWISE_DEG)),
        divergence_rad=_DIVERGENCE_RAD,
    )


def hdl32e(T_ego_lidar: Float[Tensor, "4 4"], rate_hz: float = 10.0) -> SpinningLidar:
    """Return Velodyne's HDL-32E, the lidar of nuScenes (there at 20 Hz).

    Its channels run from -30.67° to 10.67°. Channel 0 is the lowest. By the user's manual a laser fires every
    1.152 µs, with lower and upper half alternating, and a column takes 46.08 µs.
    """
    elevation_deg = tuple((-92.0 + 4.0 * ring) / 3.0 for ring in range(32))
    return _two_halves(elevation_deg, 1.152, 46.08, 0.02, T_ego_lidar, rate_hz)


def vlp16(T_ego_lidar: Float[Tensor, "4 4"], rate_hz: float = 10.0) -> SpinningLidar:
    """Return Velodyne's VLP-16.

    Its channels run from -15° to 15° in steps of 2°. Channel 0 is the lowest. By the user's manual a laser
    fires every 2.304 µs, with lower and upper half alternating, and a column takes 55.296 µs.
    """
    elevation_deg = tuple(-15.0 + 2.0 * ring for ring in range(16))
    return _two_halves(elevation_deg, 2.304, 55.296, 0.03, T_ego_lidar, rate_hz)


def _two_halves(
    elevation_deg: tuple[float, ...],
    shot_us: float,
    column_us: float,
    range_noise_m: float,
    T_ego_lidar: Float[Tensor, "4 4"],
    rate_hz: float,
) -> SpinningLidar:
    """Return a Velodyne lidar whose lower and upper lasers fire alternately."""
    return SpinningLidar(
        elevation_rad=_radians(elevation_deg),
        azimuth_steps=round(1e6 / (column_us * rate_hz)),
        rate_hz=rate_hz,
        min_range_m=1.0,
        max_range_m=100.0,
        range_noise_m=range_noise_m,
        T_ego_lidar=T_ego_lidar,
        firing_s=_in_turn(len(elevation_deg), 1e-6 * shot_us),
        divergence_rad=_DIVERGENCE_RAD,
    )


def _radians(angles_deg: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(math.radians(a) for a in angles_deg)


def _in_turn(channels: int, step_s: float) -> tuple[float, ...]:
    """Return firing times, s: lower and upper half of the channels alternate, each from the bottom up."""
    half = channels // 2
    # Laser number by channel: even shots for the lower half, odd ones for the upper half
    order = [2 * ring if ring < half else 2 * (ring - half) + 1 for ring in range(channels)]
    return tuple(step_s * k for k in order)
