"""Conditions of a simulated drive: time of day, weather and the amount of traffic."""

from dataclasses import dataclass

import numpy as np

from foredrive.errors import InputError

CLEAR_VISIBILITY_M = 20_000.0
FOG_M = 1000.0
"""Visibility below which haze is called fog, m."""


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
