"""Daylight: where the sun stands and how bright sky, haze and ground are."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

Rgb = Float32[np.ndarray, "3"]


class LightArrays(NamedTuple):
    """Linear radiances, white diffuse in full sun being about 1."""

    sun: Rgb
    """Unit direction towards the sun."""
    sun_rgb: Rgb
    zenith: Rgb
    horizon: Rgb
    cloud_rgb: Rgb
    sky_rgb: Rgb
    """Light from above that falls on a level surface in the shade."""
    bounce_rgb: Rgb
    """Light from below."""
    haze_rgb: Rgb
    visibility_m: float
    """At this distance haze hides all but 1/e."""
    clouds: float
    """0 clear, 1 overcast."""
    exposure: float


def daylight(rng: np.random.Generator) -> LightArrays:
    """A bright day: sun 25° to 65° high, from any side, a few clouds."""
    elevation, azimuth = np.deg2rad(rng.uniform(25.0, 65.0)), rng.uniform(0.0, 2.0 * np.pi)
    level = np.cos(elevation)
    warm = 1.0 - np.sin(elevation)

    def rgb(r: float, g: float, b: float) -> Rgb:
        return np.array([r, g, b], dtype=np.float32)

    return LightArrays(
        sun=rgb(level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)),
        sun_rgb=rgb(1.30, 1.25 - 0.12 * warm, 1.14 - 0.30 * warm),
        zenith=rgb(0.14, 0.28, 0.60),
        horizon=rgb(0.62, 0.72, 0.83),
        cloud_rgb=rgb(0.95, 0.96, 0.98),
        sky_rgb=rgb(0.42, 0.48, 0.57),
        bounce_rgb=rgb(0.27, 0.26, 0.235),
        haze_rgb=rgb(0.66, 0.73, 0.81),
        visibility_m=float(rng.uniform(700.0, 1400.0)),
        clouds=float(rng.uniform(0.1, 0.6)),
        exposure=0.78,
    )
