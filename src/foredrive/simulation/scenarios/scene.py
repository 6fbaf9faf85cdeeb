"""What those who play a scenario know: how far it is, where everybody is, what they have been told."""

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from foredrive.simulation.dynamics import EGO
from foredrive.simulation.scenarios.kinds import Scenario, Way
from foredrive.simulation.scenarios.kinematics import arrival_s, stopping_m
from foredrive.towns.traffic.leaders import find_leaders
from foredrive.towns.traffic.orders import Orders
from foredrive.towns.traffic.state import TrafficState
from foredrive.towns.traffic.traffic import Traffic
from foredrive.towns.traffic.vehicles import BEHIND, path_starts

SET_OUT_M = 1.0
STANDS_MPS = 0.3
ROUNDED_M = 0.5
FRONT_M = EGO.axle_to_centre_m + 0.5 * EGO.length_m
"""From the rear axle to the front bumper."""
SOON_S, TO_SPEED_MPS2 = 0.5, 3.0
"""How soon a vehicle is to drive at the speed it is told, and how hard it may brake or speed up for that."""


@dataclass(frozen=True)
class Play:
    """How far the scenarios of a route have come: one after the other, never two at a time."""

    number: int = 0
    """Of the one whose turn it is; those before are over, or have been missed."""
    cast: tuple[int, ...] = ()
    """Slots of the vehicles that have been called in for it."""
    way: int = 0
    """Which of its ways they take."""
    since_s: float | None = None
    """Since when it goes on; None: it has not begun."""
    cruise_mps: float = 0.0
    """How fast a vehicle goes that is on its way to meet the ego vehicle, from then on."""
    waited_s: float = 0.0
    """How long it has been waited for."""
    holds_up_s: float = 0.0
    """For how long others have stood behind its vehicles."""
    begun: tuple[tuple[int, float], ...] = ()
    """The numbers of all that have begun, and when in the drive, s."""
    pace_mps: tuple[float, ...] = ()
    """Of each stray, once it has begun."""

    def after(self) -> "Play":
        """With the next one's turn."""
        return Play(self.number + 1, begun=self.begun, pace_mps=self.pace_mps)

    def beginning(self, t_s: float) -> "Play":
        """With the one whose turn it is going on from now."""
        return dataclasses.replace(self, since_s=t_s, begun=(*self.begun, (self.number, t_s)))


class Ego(NamedTuple):
    """The ego vehicle as scenarios see it."""

    t_s: float
    """Since the drive began."""
    done_m: float
    """How far along the route its rear axle is."""
    speed_mps: float
    acceleration_mps2: float
    centre_m: Float64[np.ndarray, "3"]
    """On the ground."""
    yaw_rad: float

    @property
    def has_set_out(self) -> bool:
        """Whether it has left the place where the drive began."""
        return self.done_m > SET_OUT_M

    def stopping_m(self) -> float:
        """Its way to a halt if it is driven attentively."""
        return stopping_m(self.speed_mps, self.acceleration_mps2)

    def front_gap_m(self, at_m: float) -> float:
        """From its bumper to a place of the route, rather too little: it is known to the metre."""
        return at_m - self.done_m - FRONT_M - ROUNDED_M

    def middle_gap_m(self, at_m: float) -> float:
        """From its middle to a place of the route."""
        return at_m - self.done_m - EGO.axle_to_centre_m

    def arrival_s(self, scenario: Scenario) -> float:
        """When its middle is where the scenario is met."""
        gap_m = max(self.middle_gap_m(scenario.at_m), 0.0)
        motion = (self.speed_mps, self.acceleration_mps2, scenario.limit_mps, scenario.through_mps)
        return arrival_s(gap_m, *motion)


class Scene(NamedTuple):
    """A scenario at one time."""

    traffic: Traffic
    scenario: Scenario
    play: Play
    state: TrafficState
    ego: Ego
    orders: Orders
    """Filled in by who plays it."""

    @property
    def way(self) -> Way:
        """That the vehicles take."""
        return self.scenario.ways[self.play.way]

    def along_m(self, slot: int) -> float | None:
        """How far along the way the middle of a vehicle is; None: it is not there any more."""
        v, graph, lanes = self.state.vehicles, self.traffic.lanes, self.way.lanes
        lane = int(v.path[slot, BEHIND])
        if not v.active[slot] or lane not in lanes:
            return None
        before_m = graph.length_m[list(lanes[: lanes.index(lane)])].sum()
        return float(before_m + v.s_m[slot])

    def speed_mps(self, slot: int) -> float:
        """Of a vehicle."""
        return float(self.state.vehicles.speed_mps[slot])

    def holds_up(self) -> bool:
        """Whether somebody else stands because of the first vehicle."""
        v, graph = self.state.vehicles, self.traffic.lanes
        leader = find_leaders(graph, v, path_starts(graph, v.path)).leader
        return bool((v.active & (leader == self.play.cast[0]) & (v.speed_mps < STANDS_MPS))[1:].any())

    def half_m(self, slot: int) -> float:
        """Half a vehicle's length."""
        return 0.5 * float(self.state.vehicles.size_lwh[slot, 0])

    def towards_mps(self, slot: int, wanted_mps: float) -> None:
        """Order a vehicle to drive no faster than a speed, soon."""
        wanted = (wanted_mps - self.speed_mps(slot)) / SOON_S
        self.orders.most_mps2[slot] = min(max(wanted, -TO_SPEED_MPS2), TO_SPEED_MPS2)
