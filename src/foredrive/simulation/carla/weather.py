"""Conversion of Foredrive's conditions to CARLA's weather."""

import math
from typing import Any

from foredrive.scene.conditions import Conditions
from foredrive.simulation.carla.client import import_carla

MAX_SUN_DEG, MIN_SUN_DEG = 75.0, -60.0
"""Altitude of the sun at noon and at midnight, degrees. It is 0 at 6 and at 18 o'clock."""
HEAVY_RAIN_MMPH = 50.0
FOG_VISIBILITY_M = 1000.0
"""Visibility below which fog begins, m. At a tenth of it or less CARLA's fog has its maximum density."""


def weather_of(conditions: Conditions) -> Any:
    """Return similar `carla.WeatherParameters`.

    CARLA's percentages have no unit, so the conversion is approximate.
    """
    carla = import_carla()
    phase = math.cos(2 * math.pi * (conditions.hour - 12.0) / 24.0)
    rain = 100.0 * min(conditions.rain_mmph / HEAVY_RAIN_MMPH, 1.0) ** 0.5
    thinned = math.log(FOG_VISIBILITY_M / min(conditions.visibility_m, FOG_VISIBILITY_M), 10.0)
    wet = 100.0 * max(conditions.wetness, 0.5 if conditions.rain_mmph > 0 else 0.0)
    return carla.WeatherParameters(
        cloudiness=100.0 * conditions.clouds,
        precipitation=rain,
        precipitation_deposits=wet if conditions.rain_mmph > 0 else 0.5 * wet,
        wind_intensity=10.0,
        sun_azimuth_angle=(15.0 * conditions.hour) % 360.0,
        sun_altitude_angle=phase * (MAX_SUN_DEG if phase > 0 else -MIN_SUN_DEG),
        fog_density=100.0 * min(thinned, 1.0),
        fog_distance=0.0,
        fog_falloff=0.2,
        wetness=wet,
        scattering_intensity=1.0,
        mie_scattering_scale=0.03,
        rayleigh_scattering_scale=0.0331,
    )
