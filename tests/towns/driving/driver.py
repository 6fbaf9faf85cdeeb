"""A driver for tests: along a route, at the limit or slower in curves, attentive or not."""

import dataclasses
import math

import numpy as np

from foredrive.driving.dynamics import EGO
from foredrive.scene import Control, Event
from foredrive.scene.conditions import BackgroundTraffic
from foredrive.towns.driving.routes import DriveRoute
from foredrive.towns.driving.town import TownScenario, TownSimulator, TownState
from foredrive.towns.scenarios.kinematics import BRAKING_MPS2, REACTION_S
from foredrive.towns.scenarios.scenario import Scenario

SEED = 3
LOOK_S, LOOK_M = 0.6, 3.0
LATERAL_MPS2, GAINS_MPS2, SLOWS_MPS2 = 2.5, 2.0, 2.0


@dataclasses.dataclass(frozen=True)
class Driver:
    """Who is attentive brakes as hard and as late as scenarios allow, and waits for a while."""

    route: DriveRoute
    limit_mps: float
    attentive: bool
    waits_s: float = 14.0

    def control(self, state: TownState) -> Control:
        """For the step that begins now."""
        ego = state.ego
        done_m = state.progress.done_m
        at_m = done_m + LOOK_M + LOOK_S * ego.speed_mps
        x, y = (np.interp(at_m, self.route.arc_m, axis) for axis in self.route.xyz.T[:2])
        dx, dy = x - ego.x_m, y - ego.y_m
        aside = -math.sin(ego.yaw_rad) * dx + math.cos(ego.yaw_rad) * dy
        steering = math.atan(2 * EGO.wheelbase_m * aside / (dx**2 + dy**2))
        return Control(self._acceleration(state, done_m), steering)

    def _acceleration(self, state: TownState, done_m: float) -> float:
        speed = state.ego.speed_mps
        begun_s = state.scenarios.begun[-1][1] if state.scenarios.begun else -math.inf
        if self.attentive and REACTION_S <= state.t_s - begun_s < self.waits_s:
            return -BRAKING_MPS2
        return min(max((self._wanted_mps(done_m, speed) - speed) / 0.3, -SLOWS_MPS2 - 1.0), GAINS_MPS2)

    def _wanted_mps(self, done_m: float, speed: float) -> float:
        """No faster than curves ahead allow."""
        ways = done_m + np.arange(0.0, 40.0, 1.0)
        x, y = (np.interp(ways, self.route.arc_m, axis) for axis in self.route.xyz.T[:2])
        heading = np.unwrap(np.arctan2(np.diff(y), np.diff(x) + 1e-9))
        bend = np.abs(heading[6:] - heading[:-6]) / 6.0
        allowed = np.sqrt(LATERAL_MPS2 / np.maximum(bend, 1e-3))
        in_time = np.sqrt(allowed**2 + 2 * SLOWS_MPS2 * np.arange(len(allowed)))
        return float(min(self.limit_mps, in_time.min()))


def town_scenario(route: DriveRoute, scenarios: tuple[Scenario, ...], seed: int = SEED) -> TownScenario:
    """A drive along a route on an empty road."""
    nobody = BackgroundTraffic(vehicles=0, pedestrians=0)
    return TownScenario(route.town, route.xyz, seed, nobody, lanes=route.lanes, scenarios=scenarios)


def drive(
    simulator: TownSimulator, driver: Driver, after_s: float = 10.0, most_s: float = 40.0
) -> tuple[list[Event], list[TownState]]:
    """What goes wrong until some time after a scenario began, and all states."""
    events: list[Event] = []
    states = [simulator.state]
    while simulator.state.ended is None:
        begun_s = min((s for _, s in simulator.state.scenarios.begun), default=math.inf)
        if simulator.state.t_s > min(begun_s + after_s, most_s):
            break
        events += simulator.step(driver.control(simulator.state)).events
        states.append(simulator.state)
    return events, states
