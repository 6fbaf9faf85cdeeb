"""Time of day and weather, read back out of a caption of `towns.labels.captions`."""

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


class Setting(NamedTuple):
    """What a caption says of when and in what weather; None where it does not."""

    time_of_day: str | None
    weather: str | None


def read_setting(caption: str) -> Setting:
    """The setting of a caption: it stands in the first sentence."""
    first = caption.split(".")[0].lower()
    time = next((word for word in TIMES_OF_DAY if word in first), None)
    weather = next((name for name, words in WEATHERS.items() if any(word in first for word in words)), None)
    return Setting("midday" if time == "noon" else time, weather)
