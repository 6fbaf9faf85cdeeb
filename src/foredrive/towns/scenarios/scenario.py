"""Scenarios that the ego vehicle can meet, after those of CARLA's leaderboard 1.0.

All of them are fair: when a scenario begins, an attentive driver within the speed limit still has room to
stop (`kinematics.stopping_m`).
"""

import enum
import math
from dataclasses import dataclass

from foredrive.towns.traffic.scripted_actors import ScriptedActor


class ScenarioKind(enum.StrEnum):
    """Kinds of scenarios."""

    LEAD_BRAKES = "lead_brakes"
    """The vehicle ahead brakes to a halt, and drives on a little later."""
    OBSTACLE_BEHIND_CORNER = "obstacle_behind_corner"
    """A vehicle stands in the lane after a turn, until another vehicle has waited behind it."""
    CROSSING_PEDESTRIAN = "crossing_pedestrian"
    CROSSING_CYCLIST = "crossing_cyclist"
    ONCOMING_TRAFFIC = "oncoming_traffic"
    """Oncoming traffic at a left turn without a protected light. It does not make room."""
    RED_LIGHT_RUNNER = "red_light_runner"
    """A vehicle from the side runs its red light while the ego vehicle has a green one."""
    CUT_IN = "cut_in"
    """A slower vehicle comes over from the next lane."""
    DOOR_ZONE = "door_zone"
    """A pedestrian steps out before a parked car, stays for a while, and goes back."""


MEETINGS = (ScenarioKind.ONCOMING_TRAFFIC, ScenarioKind.RED_LIGHT_RUNNER)
"""Kinds whose vehicles come from another road or direction."""
ENDS_BEFORE = (ScenarioKind.LEAD_BRAKES, ScenarioKind.CUT_IN)
"""Kinds that must be over at the point where they are met."""


@dataclass(frozen=True)
class Way:
    """Lanes that a vehicle takes, and the point at which it meets the route."""

    lanes: tuple[int, ...]
    """Consecutive lanes of the town's lane graph."""
    meet_m: float
    """Distance of the meeting point from the beginning of the first lane, m."""
    line_m: float = math.inf
    """Distance of the junction's line along the way, m, if they meet in a junction."""


@dataclass(frozen=True, eq=False)
class Scenario:
    """A scenario at a place of a route. Nothing happens if the ego vehicle does not drive there."""

    kind: ScenarioKind
    at_m: float
    """Position on the route where the scenario is met, m. For a lead or cut-in vehicle, the position where
    it must be over."""
    limit_mps: float
    """Speed limit of the ego vehicle there, m/s."""
    through_mps: float = math.inf
    """Maximum speed that the ego vehicle can drive there, m/s, for instance in a turn."""
    ways: tuple[Way, ...] = ()
    """Alternative ways of the vehicles."""
    side: int = 0
    """Side to which a vehicle cuts in (0 left, 1 right)."""
    ego_lane: int = -1
    """Lane of the ego vehicle in the junction, whose light it has. -1 outside of junctions."""
    actor: ScriptedActor | None = None
    """The crossing road user in its waiting state, if there is one."""
    meet_m: float = 0.0
    """Distance along the crossing road user's way at which it meets the route, m."""
