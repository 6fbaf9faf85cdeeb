"""Conditions of a simulated drive: time of day, weather and the amount of traffic."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from foredrive.errors import InputError

CLEAR_VISIBILITY_M = 20_000.0
FOG_M = 1000.0
"""Visibility below which haze is called fog, m."""
MAX_SUN_DEG, MIN_SUN_DEG = 75.0, -60.0
"""Altitude of CARLA's sun at noon and at midnight, degrees. It is 0 at 6 and at 18 o'clock."""
HEAVY_RAIN_MMPH = 50.0
THIN_FOG_PCT = 10.0
"""CARLA's fog density up to which the air is only hazy: its clear presets have 2 or 3."""


@dataclass(frozen=True)
class Conditions:
    """Time of day and weather, constant over a drive.

    Raises:
        InputError: a value is outside its range.
    """

    hour: float = 12.0
    """Solar time, 0 to 24 h. The sun rises at 6, sets at 18 and is highest at 12."""
    clouds: float = 0.2
    """Cloud cover, 0 (clear) to 1 (overcast)."""
    rain_mmph: float = 0.0
    """Rain rate, mm/h: 2 is light, 10 moderate, 50 heavy."""
    wetness: float = 0.0
    """Wetness of the ground, 0 (dry) to 1 (under water). In rain the ground is wet whatever this value is."""
    visibility_m: float = CLEAR_VISIBILITY_M
    """Visibility, m, as defined by Koschmieder: the distance at which 2 % of the contrast remains. Fog is
    below 1000 m."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("hour", 0.0, 24.0),
            ("clouds", 0.0, 1.0),
            ("rain_mmph", 0.0, 200.0),
            ("wetness", 0.0, 1.0),
            ("visibility_m", 10.0, 200_000.0),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"{name} lies between {low:g} and {high:g}, got {value:g}")


@dataclass(frozen=True)
class BackgroundTraffic:
    """The numbers of other road users within about 140 m of the ego vehicle."""

    vehicles: int = 30
    pedestrians: int = 20
    """Number of pedestrians, where the town has walkways."""


CONDITIONS = {
    "clear": Conditions(),
    "morning": Conditions(hour=8.0, clouds=0.1),
    "overcast": Conditions(clouds=1.0, visibility_m=8_000.0),
    "dusk": Conditions(hour=17.7, clouds=0.3),
    "night": Conditions(hour=23.0, clouds=0.2),
    "rain": Conditions(clouds=1.0, rain_mmph=15.0, wetness=0.8, visibility_m=2_500.0),
    "night_rain": Conditions(hour=22.0, clouds=1.0, rain_mmph=15.0, wetness=0.9, visibility_m=2_500.0),
    "fog": Conditions(hour=9.0, clouds=0.9, wetness=0.2, visibility_m=150.0),
    "night_fog": Conditions(hour=4.0, clouds=0.9, wetness=0.2, visibility_m=120.0),
}
"""Conditions by their names on the command line."""
ANY_CONDITIONS = "any"
"""Name for all conditions, distributed evenly."""
COSTLY = "night_fog"
"""A frame of these conditions costs five times as much as by night: every lamp lights the fog."""
DRAWN = tuple(name for name in CONDITIONS if name != COSTLY) * 4 + (COSTLY,)
"""Conditions among which a drive in `ANY_CONDITIONS` draws one: the costly ones are a quarter as frequent."""


def find_conditions(name: str) -> Conditions:
    """Return conditions by name.

    Raises:
        InputError: there are no conditions of this name.
    """
    if name not in CONDITIONS:
        raise InputError(f"unknown conditions {name}; the conditions are {', '.join(CONDITIONS)}")
    return CONDITIONS[name]


def draw_daylight(rng: np.random.Generator) -> Conditions:
    """Draw a bright day at a time between morning and afternoon, with a few clouds."""
    return Conditions(hour=float(rng.uniform(8.0, 16.0)), clouds=float(rng.uniform(0.0, 0.45)))


def carla_weather(conditions: Conditions) -> dict[str, float]:
    """Return the parameters of similar weather in CARLA, by the names of `carla.WeatherParameters`.

    CARLA's percentages have no unit, so the conversion is approximate.
    """
    phase = math.cos(2 * math.pi * (conditions.hour - 12.0) / 24.0)
    rain = 100.0 * min(conditions.rain_mmph / HEAVY_RAIN_MMPH, 1.0) ** 0.5
    # At a tenth of the visibility at which fog begins, or less, it has its maximum density
    thinned = math.log(FOG_M / min(conditions.visibility_m, FOG_M), 10.0)
    wet = 100.0 * max(conditions.wetness, 0.5 if conditions.rain_mmph > 0 else 0.0)
    return {
        "cloudiness": 100.0 * conditions.clouds,
        "precipitation": rain,
        "precipitation_deposits": wet if conditions.rain_mmph > 0 else 0.5 * wet,
        "wetness": wet,
        "sun_azimuth_angle": (15.0 * conditions.hour) % 360.0,
        "sun_altitude_angle": phase * (MAX_SUN_DEG if phase > 0 else -MIN_SUN_DEG),
        "fog_density": 100.0 * min(thinned, 1.0),
    }


def conditions_of_weather(weather: Mapping[str, float]) -> Conditions:
    """Return conditions similar to CARLA's weather, about the inverse of `carla_weather`.

    The sun stands in the west, because its altitude alone is read. What is not given is as on a clear noon.

    Args:
        weather: parameters by the names of `carla.WeatherParameters`.
    """
    altitude_deg = weather.get("sun_altitude_angle", MAX_SUN_DEG)
    phase = altitude_deg / (MAX_SUN_DEG if altitude_deg > 0 else -MIN_SUN_DEG)
    turned = math.acos(min(max(phase, -1.0), 1.0)) / (2 * math.pi)  # 0 at noon, a half at midnight
    share = {name: min(max(value / 100.0, 0.0), 1.0) for name, value in weather.items()}
    thick, thin = share.get("fog_density", 0.0), THIN_FOG_PCT / 100.0
    # From clear air to where fog begins, then down to a tenth of it, each by equal factors
    thin_m = FOG_M * 0.1**thin
    hazy_m = CLEAR_VISIBILITY_M * (thin_m / CLEAR_VISIBILITY_M) ** (thick / thin)
    return Conditions(
        hour=12.0 + 24.0 * turned,
        clouds=share.get("cloudiness", 0.0),
        rain_mmph=HEAVY_RAIN_MMPH * share.get("precipitation", 0.0) ** 2,
        wetness=max(share.get("wetness", 0.0), share.get("precipitation_deposits", 0.0)),
        visibility_m=hazy_m if thick < thin else FOG_M * 0.1**thick,
    )
