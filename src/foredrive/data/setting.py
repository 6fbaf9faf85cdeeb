"""The setting of a recorded frame: when, in what weather, where, and what the vehicle does."""

import dataclasses
import enum
from dataclasses import dataclass
from typing import Any


class TimeOfDay(enum.StrEnum):
    """By the sun."""

    NIGHT = "night"
    DAWN = "dawn"
    MORNING = "morning"
    MIDDAY = "midday"
    AFTERNOON = "afternoon"
    DUSK = "dusk"


class Weather(enum.StrEnum):
    """Rain comes before fog, fog before the state of the sky."""

    CLEAR = "clear"
    CLOUDY = "cloudy"
    OVERCAST = "overcast"
    RAIN = "rain"
    FOG = "fog"


class Place(enum.StrEnum):
    """Where the vehicle is."""

    STREET = "street"
    JUNCTION = "junction"
    ROUNDABOUT = "roundabout"
    BRIDGE = "bridge"
    UNDERPASS = "underpass"
    HIGHWAY = "highway"


class ObjectKind(enum.StrEnum):
    """Kinds of road users and obstacles, finer than `Category`."""

    CAR = "car"
    VAN = "van"
    TRUCK = "truck"
    BUS = "bus"
    TRAILER = "trailer"
    CONSTRUCTION_VEHICLE = "construction vehicle"
    MOTORCYCLE = "motorcycle"
    CYCLIST = "cyclist"
    PEDESTRIAN = "pedestrian"
    ANIMAL = "animal"
    TRAFFIC_CONE = "traffic cone"
    BARRIER = "barrier"
    OBJECT = "object"


class Doing(enum.StrEnum):
    """What the vehicle does."""

    DRIVES = "drives"
    TURNS_LEFT = "turns left"
    TURNS_RIGHT = "turns right"
    CHANGES_LEFT = "changes left"
    CHANGES_RIGHT = "changes right"
    FOLLOWS = "follows"
    SLOWS = "slows"
    SPEEDS_UP = "speeds up"
    WAITS = "waits"


class LightColour(enum.StrEnum):
    """What a traffic light shows."""

    RED = "red"
    YELLOW = "yellow"
    GREEN = "green"


@dataclass(frozen=True)
class Setting:
    """Facts of one frame that are not in its boxes."""

    time_of_day: TimeOfDay
    weather: Weather
    place: Place
    doing: Doing
    speed_mps: float
    leader: ObjectKind | None
    """The vehicle right ahead on the same way, if one is seen."""
    light: LightColour | None
    """Of the vehicle's own traffic light, if it is in view."""
    hour: float
    """Solar time, 0 to 24."""
    clouds: float
    """Share of the sky."""
    rain_mmph: float
    wetness: float
    """Of the ground, 0 dry to 1 under water."""
    visibility_m: float
    """Meteorological range; fog is below 1000 m."""


def pack_setting(setting: Setting) -> dict[str, Any]:
    """Return plain words and numbers by the names of the fields."""
    facts = dataclasses.asdict(setting)
    return {name: fact.value if isinstance(fact, enum.Enum) else fact for name, fact in facts.items()}


def unpack_setting(data: dict[str, Any]) -> Setting:
    """Invert `pack_setting`.

    Raises:
        KeyError: a field is missing.
        ValueError: a word is none of those that its field may hold, or a number is none.
    """
    leader, light = data["leader"], data["light"]
    return Setting(
        time_of_day=TimeOfDay(data["time_of_day"]),
        weather=Weather(data["weather"]),
        place=Place(data["place"]),
        doing=Doing(data["doing"]),
        speed_mps=float(data["speed_mps"]),
        leader=None if leader is None else ObjectKind(leader),
        light=None if light is None else LightColour(light),
        hour=float(data["hour"]),
        clouds=float(data["clouds"]),
        rain_mmph=float(data["rain_mmph"]),
        wetness=float(data["wetness"]),
        visibility_m=float(data["visibility_m"]),
    )
