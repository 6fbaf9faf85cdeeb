"""What somebody on the road does to the ego vehicle, after the scenarios of CARLA's leaderboard 1.0.

All of them are fair: when somebody begins, there is still room to stop for who drives no faster than allowed,
and attentively (`kinematics.stopping_m`).
"""

import enum
import math
from dataclasses import dataclass

from foredrive.towns.traffic.strays import Stray


class ScenarioKind(enum.StrEnum):
    """Who does what."""

    LEAD_BRAKES = "lead_brakes"
    """The vehicle ahead brakes to a halt, and drives on a little later."""
    OBSTACLE_BEHIND_CORNER = "obstacle_behind_corner"
    """A vehicle stands in the lane after a turn, until somebody has waited behind it."""
    CROSSING_PEDESTRIAN = "crossing_pedestrian"
    CROSSING_CYCLIST = "crossing_cyclist"
    ONCOMING_TRAFFIC = "oncoming_traffic"
    """At a left turn that no light protects; nobody makes room."""
    RED_LIGHT_RUNNER = "red_light_runner"
    """From the side, at a green light."""
    CUT_IN = "cut_in"
    """A slower vehicle comes over from the next lane."""
    DOOR_ZONE = "door_zone"
    """Somebody steps out before a parked car, stays for a while, and goes back."""


MEETINGS = (ScenarioKind.ONCOMING_TRAFFIC, ScenarioKind.RED_LIGHT_RUNNER)
"""Whose vehicles come from elsewhere."""
ENDS_BEFORE = (ScenarioKind.LEAD_BRAKES, ScenarioKind.CUT_IN)
"""Where these are met is where they have to be over."""


@dataclass(frozen=True)
class Way:
    """Lanes that a vehicle takes, and where on them it meets the route."""

    lanes: tuple[int, ...]
    """Of the town's lane graph, one after the other."""
    meet_m: float
    """Way from the begin of the first lane."""
    line_m: float = math.inf
    """Where on the way the junction's line is, if they meet in one."""


@dataclass(frozen=True, eq=False)
class Scenario:
    """One thing that happens at a place of a route; nothing happens where the route is not driven."""

    kind: ScenarioKind
    at_m: float
    """Where on the route it is met. Of a lead vehicle, or one that cuts in, where it has to have happened."""
    limit_mps: float
    """How fast the ego vehicle may be there."""
    through_mps: float = math.inf
    """How fast it can be, as in a turn."""
    ways: tuple[Way, ...] = ()
    """Of vehicles: any of them will do."""
    side: int = 0
    """To which side a vehicle cuts in (0 left, 1 right)."""
    ego_lane: int = -1
    """The lane whose light the ego vehicle has, at junctions."""
    stray: Stray | None = None
    """Who crosses, as it waits before it does."""
    meet_m: float = 0.0
    """How far along its way it meets the route."""
