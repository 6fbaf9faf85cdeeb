"""The state of a traffic light."""

import enum


class LightState(enum.IntEnum):
    """Colour that a traffic light shows; NONE means that there is no light."""

    NONE = 0
    RED = 1
    YELLOW = 2
    GREEN = 3
