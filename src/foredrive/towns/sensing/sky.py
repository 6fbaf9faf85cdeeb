"""Radiance of the sky along a ray."""

import math
from typing import no_type_check

from foredrive.towns.sensing.patterns import kernel_part, noise

FOG_TOP_M = 100.0
"""Upper limit of fog, rain and haze, m."""


@kernel_part
@no_type_check
def sky(light, dx, dy, dz, out):
    """Fill out [3] with the sky: a gradient, a glow around the sun, clouds, and haze in front of all of
    it."""
    cloud = 0.0
    # Clouds on a plane above; the offset keeps the horizon finite
    if dz > 0.02:
        x, y = dx / (dz + 0.12) * 1.3, dy / (dz + 0.12) * 1.3
        # Three octaves of noise against a threshold that falls with the cloud cover
        n = noise(x, y, 0.0, 81)
        n += 0.5 * noise(2.1 * x, 2.1 * y, 0.0, 82) + 0.25 * noise(4.3 * x, 4.3 * y, 0.0, 83)
        cloud = min(max(1.1 * n + 1.6 * light.clouds - 0.8, 0.0), 1.0) * min(1.0, 6.0 * dz)
        cloud *= 1.0 - 0.25 * max(0.0, n) * light.clouds
    _air_and_sun(light, dx, dy, dz, cloud, out)


@kernel_part
@no_type_check
def blurred_sky(light, dx, dy, dz, out):
    """Fill out [3] with the sky as a rough mirror shows it: its clouds are blurred into one layer."""
    _air_and_sun(light, dx, dy, dz, light.clouds * min(1.0, 6.0 * dz), out)


@kernel_part
@no_type_check
def _air_and_sun(light, dx, dy, dz, cloud, out):
    up = max(dz, 0.0)
    # From the colour of the horizon to that of the zenith
    blend = 1.0 - (1.0 - up) ** 5
    near = max(
        dx * light.glow_direction[0] + dy * light.glow_direction[1] + dz * light.glow_direction[2], 0.0
    )
    # Wide and narrow halo around the sun, and its disc
    halo = 0.25 * near**6 + 0.6 * near**64
    disc = 8.0 if near > 0.9999 else 0.0
    # Haze in front of the sky: the way through the layer grows towards the horizon
    veil = 1.0 - math.exp(-light.air.extinction_per_m * FOG_TOP_M / max(dz, 0.02))
    for c in range(3):
        clear = light.horizon[c] * (1.0 - blend) + light.zenith[c] * blend
        clear += light.glow_rgb[c] * halo + light.sun_rgb[c] * disc
        clear = clear * (1.0 - cloud) + cloud * light.cloud_rgb[c]
        out[c] = clear * (1.0 - veil) + veil * light.haze_rgb[c]
