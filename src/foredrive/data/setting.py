"""The setting of a recorded frame: time, weather, place, and behaviour of the vehicle."""

import dataclasses
import enum
from dataclasses import dataclass
from typing import Any

from foredrive.scene.conditions import FOG_M, Conditions


class TimeOfDay(enum.StrEnum):
    """Time of day by the position of the sun."""

    NIGHT = "night"
    DAWN = "dawn"
    MORNING = "morning"
    MIDDAY = "midday"
    AFTERNOON = "afternoon"
    DUSK = "dusk"

    @classmethod
    def at_hour(cls, hour: float) -> "TimeOfDay":
        """Return the time of day by the height of the sun and, during the day, by the hour (solar time)."""
        if hour < 5.3 or hour >= 18.7:
            return cls.NIGHT
        if hour < 6.7:
            return cls.DAWN
        if hour >= 17.3:
            return cls.DUSK
        if hour < 11.0:
            return cls.MORNING
        return cls.MIDDAY if hour < 13.0 else cls.AFTERNOON


class Weather(enum.StrEnum):
    """Weather. Rain has priority over fog, and fog over the state of the sky."""

    CLEAR = "clear"
    CLOUDY = "cloudy"
    OVERCAST = "overcast"
    RAIN = "rain"
    FOG = "fog"

    @classmethod
    def under(cls, conditions: Conditions) -> "Weather":
        """Return the weather of some conditions in one word."""
        if conditions.rain_mmph > 0:
            return cls.RAIN
        if conditions.visibility_m < FOG_M:
            return cls.FOG
        if conditions.clouds >= 0.9:
            return cls.OVERCAST
        return cls.CLOUDY if conditions.clouds >= 0.5 else cls.CLEAR


class Place(enum.StrEnum):
    """Type of place of the vehicle."""

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
    """Behaviour of the vehicle."""

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
    """Colour of a traffic light."""

    RED = "red"
    YELLOW = "yellow"
    GREEN = "green"


@dataclass(frozen=True)
class Setting:
    """Facts of one frame, in addition to its boxes."""

    time_of_day: TimeOfDay
    weather: Weather
    place: Place
    doing: Doing
    speed_mps: float
    leader: ObjectKind | None
    """Type of the visible vehicle directly ahead on the same route. None if there is none."""
    light: LightColour | None
    """Colour of the vehicle's own traffic light. None if it is not in view."""
    hour: float
    """Solar time, 0 to 24."""
    clouds: float
    """Cloud cover, share of the sky."""
    rain_mmph: float
    wetness: float
    """Wetness of the ground: 0 is dry, 1 is under water."""
    visibility_m: float
    """Meteorological visibility. Fog is below 1000 m."""


def pack_setting(setting: Setting) -> dict[str, Any]:
    """Return plain words and numbers by field name."""
    facts = dataclasses.asdict(setting)
    return {name: fact.value if isinstance(fact, enum.Enum) else fact for name, fact in facts.items()}


def unpack_setting(data: dict[str, Any]) -> Setting:
    """Invert `pack_setting`.

    Raises:
        KeyError: a field is missing.
        ValueError: a word is not valid for its field, or a value is not a number.
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
