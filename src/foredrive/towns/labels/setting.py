"""Time of day, weather and kind of place, read back out of a caption of `towns.labels.captions`."""

from typing import NamedTuple

TIMES_OF_DAY = ("night", "dawn", "dusk", "morning", "afternoon", "midday", "noon")
WEATHERS = {
    "rain": ("rain",),
    "fog": ("fog",),
    "overcast": ("overcast", "grey sky"),
    "cloudy": ("cloudy", "broken cloud"),
    "clear": ("clear", "sunny", "dry"),
}
"""What weather is called, and the words of captions that tell it; what comes first counts."""


PLACES = {
    "junction": ("junction", "intersection"),
    "roundabout": ("roundabout",),
    "underpass": ("under a bridge", "underpass"),
    "bridge": ("bridge", "overpass"),
    "highway": ("highway", "motorway"),
    "street": ("street", "on the road"),
}
"""Likewise of kinds of places."""


class Setting(NamedTuple):
    """What a caption says of when, in what weather and at what kind of place; None where it does not."""

    time_of_day: str | None
    weather: str | None
    place: str | None


def read_setting(caption: str) -> Setting:
    """The setting of a caption: it stands in the first sentence."""
    first = caption.split(".")[0].lower()
    time = next((word for word in TIMES_OF_DAY if word in first), None)
    weather, place = _named(first, WEATHERS), _named(first.rsplit(", ", 1)[-1], PLACES)
    return Setting("midday" if time == "noon" else time, weather, place)


def _named(text: str, names: dict[str, tuple[str, ...]]) -> str | None:
    return next((name for name, words in names.items() if any(word in text for word in words)), None)
