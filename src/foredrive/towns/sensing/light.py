"""Daylight: where the sun stands and how bright sky, haze and ground are."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from foredrive.towns.conditions import Conditions

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


def sun_direction(hour: float, east_rad: float) -> Rgb:
    """Unit vector towards the sun at a solar time: it rises in the east at 6, sets in the west at 18.

    At noon it stands 60° high in the south, as on an equinox at 30° north. `east_rad` is where east lies,
    counter-clockwise from the world's x.
    """
    angle, highest = np.pi * (hour - 6.0) / 12.0, np.deg2rad(60.0)
    east, south = np.cos(angle), np.sin(angle) * np.cos(highest)
    cos, sin = np.cos(east_rad), np.sin(east_rad)
    xyz = (east * cos + south * sin, east * sin - south * cos, np.sin(angle) * np.sin(highest))
    return np.array(xyz, dtype=np.float32)


def make_light(conditions: Conditions, east_rad: float) -> LightArrays:
    """The light of a time of day under a sky."""
    sun = sun_direction(conditions.hour, east_rad)
    warm = 1.0 - float(sun[2])

    def rgb(r: float, g: float, b: float) -> Rgb:
        return np.array([r, g, b], dtype=np.float32)

    return LightArrays(
        sun=sun,
        sun_rgb=rgb(1.30, 1.25 - 0.12 * warm, 1.14 - 0.30 * warm),
        zenith=rgb(0.14, 0.28, 0.60),
        horizon=rgb(0.62, 0.72, 0.83),
        cloud_rgb=rgb(0.95, 0.96, 0.98),
        sky_rgb=rgb(0.42, 0.48, 0.57),
        bounce_rgb=rgb(0.27, 0.26, 0.235),
        haze_rgb=rgb(0.66, 0.73, 0.81),
        visibility_m=1000.0,
        clouds=conditions.clouds,
        exposure=0.78,
    )
