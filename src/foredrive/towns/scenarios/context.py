"""State of a scenario: its progress, the ego vehicle, the traffic and the orders given."""

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from foredrive.driving.dynamics import EGO
from foredrive.towns.scenarios.kinematics import arrival_s, stopping_m
from foredrive.towns.scenarios.scenario import Scenario, Way
from foredrive.towns.traffic.leaders import find_leaders
from foredrive.towns.traffic.orders import Orders
from foredrive.towns.traffic.state import TrafficState
from foredrive.towns.traffic.traffic import Traffic
from foredrive.towns.traffic.vehicles import BEHIND, path_starts

SET_OUT_M = 1.0
STANDS_MPS = 0.3
ROUNDED_M = 0.5
FRONT_M = EGO.axle_to_centre_m + 0.5 * EGO.length_m
"""Distance from the rear axle to the front bumper, m."""
SOON_S, TO_SPEED_MPS2 = 0.5, 3.0
"""Time in which a vehicle is to reach its ordered speed, s, and maximum deceleration and acceleration for
it, m/s²."""


@dataclass(frozen=True)
class ScenarioProgress:
    """Progress of the scenarios of a route. They are played one after the other, never two at a time."""

    number: int = 0
    """Number of the current scenario. Those before are over, or have been missed."""
    slots: tuple[int, ...] = ()
    """Slots of the vehicles that have been placed for it."""
    way: int = 0
    """Index of the way that they take, among the scenario's ways."""
    since_s: float | None = None
    """Time at which the scenario began, s. None if it has not begun."""
    cruise_mps: float = 0.0
    """Speed of a vehicle that is on its way to meet the ego vehicle, m/s, kept once the scenario has
    begun."""
    waited_s: float = 0.0
    """Time for which the scenario's waiting condition has held, s: the ego vehicle follows, stands behind,
    or is waited for."""
    holds_up_s: float = 0.0
    """Time for which others have stood behind its vehicles, s."""
    begun: tuple[tuple[int, float], ...] = ()
    """Numbers of all scenarios that have begun, and their start times in the drive, s."""
    pace_mps: tuple[float, ...] = ()
    """Speed of each crossing actor, m/s, once it has begun."""

    def after(self) -> "ScenarioProgress":
        """Return the progress with the next scenario as the current one."""
        return ScenarioProgress(self.number + 1, begun=self.begun, pace_mps=self.pace_mps)

    def beginning(self, t_s: float) -> "ScenarioProgress":
        """Return the progress in which the current scenario begins now."""
        return dataclasses.replace(self, since_s=t_s, begun=(*self.begun, (self.number, t_s)))


class ScenarioEgo(NamedTuple):
    """The ego vehicle as scenarios see it."""

    t_s: float
    """Time since the drive began, s."""
    done_m: float
    """Position of the rear axle along the route, m."""
    speed_mps: float
    acceleration_mps2: float
    centre_m: Float64[np.ndarray, "3"]
    """Middle of the vehicle on the ground, m."""
    yaw_rad: float

    @property
    def has_set_out(self) -> bool:
        """Return whether the vehicle has left the place where the drive began."""
        return self.done_m > SET_OUT_M

    def stopping_m(self) -> float:
        """Return the stopping distance of an attentive driver, m."""
        return stopping_m(self.speed_mps, self.acceleration_mps2)

    def front_gap_m(self, at_m: float) -> float:
        """Return the distance from the bumper to a place of the route, m.

        `ROUNDED_M` is subtracted, because the position on the route is known to the metre only.
        """
        return at_m - self.done_m - FRONT_M - ROUNDED_M

    def middle_gap_m(self, at_m: float) -> float:
        """Return the distance from the vehicle's middle to a place of the route, m."""
        return at_m - self.done_m - EGO.axle_to_centre_m

    def arrival_s(self, scenario: Scenario) -> float:
        """Return the time until the vehicle's middle reaches the place of the scenario, s."""
        gap_m = max(self.middle_gap_m(scenario.at_m), 0.0)
        motion = (self.speed_mps, self.acceleration_mps2, scenario.limit_mps, scenario.through_mps)
        return arrival_s(gap_m, *motion)


class ScenarioContext(NamedTuple):
    """A scenario at one time."""

    traffic: Traffic
    scenario: Scenario
    progress: ScenarioProgress
    state: TrafficState
    ego: ScenarioEgo
    orders: Orders
    """Filled in while the scenario is played."""

    @property
    def way(self) -> Way:
        """Return the way that the vehicles take."""
        return self.scenario.ways[self.progress.way]

    def along_m(self, slot: int) -> float | None:
        """Return the position of a vehicle's middle along the way, m. None if it has left the way."""
        v, graph, lanes = self.state.vehicles, self.traffic.lanes, self.way.lanes
        lane = int(v.path[slot, BEHIND])
        if not v.active[slot] or lane not in lanes:
            return None
        # Length of the lanes before the current one, plus the arc length on it
        before_m = graph.length_m[list(lanes[: lanes.index(lane)])].sum()
        return float(before_m + v.s_m[slot])

    def speed_mps(self, slot: int) -> float:
        """Return the speed of a vehicle, m/s."""
        return float(self.state.vehicles.speed_mps[slot])

    def holds_up(self) -> bool:
        """Return whether another vehicle stands because of the scenario's first vehicle."""
        v, graph = self.state.vehicles, self.traffic.lanes
        leader = find_leaders(graph, v, path_starts(graph, v.path)).leader
        return bool((v.active & (leader == self.progress.slots[0]) & (v.speed_mps < STANDS_MPS))[1:].any())

    def half_m(self, slot: int) -> float:
        """Return half the length of a vehicle, m."""
        return 0.5 * float(self.state.vehicles.size_lwh[slot, 0])

    def towards_mps(self, slot: int, wanted_mps: float) -> None:
        """Order a vehicle to drive no faster than a speed, reached within `SOON_S`."""
        # Acceleration that reaches the wanted speed in `SOON_S`, limited
        wanted = (wanted_mps - self.speed_mps(slot)) / SOON_S
        self.orders.max_mps2[slot] = min(max(wanted, -TO_SPEED_MPS2), TO_SPEED_MPS2)
