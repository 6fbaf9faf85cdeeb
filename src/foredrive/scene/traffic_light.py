"""The state of a traffic light."""

import enum


class LightState(enum.IntEnum):
    """What a traffic light shows; NONE where there is no light."""

    NONE = 0
    RED = 1
    YELLOW = 2
    GREEN = 3
