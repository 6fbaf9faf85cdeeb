"""Plays the scenarios of a route one after the other."""

import dataclasses
from collections.abc import Sequence

from foredrive.simulation.scenarios.acts import act
from foredrive.simulation.scenarios.cast import call
from foredrive.simulation.scenarios.kinds import Scenario
from foredrive.simulation.scenarios.scene import Ego, Play, Scene
from foredrive.simulation.scenarios.strays import (
    is_on_the_spot,
    pace_among,
    pace_to_begin,
    vehicle_boxes,
    walks_into,
)
from foredrive.towns.traffic.orders import Orders
from foredrive.towns.traffic.state import TrafficState
from foredrive.towns.traffic.traffic import Traffic

PASSED_M = 8.0


class Director:
    """Gives the traffic its orders for the scenarios of one route. All changing state is in `Play`."""

    def __init__(self, traffic: Traffic, scenarios: Sequence[Scenario]) -> None:
        self._traffic, self._scenarios = traffic, scenarios
        self._numbers = [number for number, scenario in enumerate(scenarios) if scenario.stray is not None]
        self._strays = tuple(scenario.stray for scenario in scenarios if scenario.stray is not None)

    def set_up(self, state: TrafficState, ego: Ego, dt_s: float) -> tuple[Play, TrafficState]:
        """Return the play and the traffic at the start of a drive.

        All crossing road users wait at their places, and the vehicles of a near scenario are on the road.
        """
        play = Play(pace_mps=(0.0,) * len(self._strays))
        state = dataclasses.replace(state, scripted_actors=self._strays)
        play, state, _ = self.direct(play, state, ego, dt_s, at_start=True)
        return play, state

    def direct(
        self, play: Play, state: TrafficState, ego: Ego, dt_s: float, at_start: bool = False
    ) -> tuple[Play, TrafficState, Orders]:
        """Return the updated play, the traffic, and the orders for its next step.

        The traffic includes newly placed vehicles.
        """
        orders = Orders.none(len(state.vehicles.active))
        if play.number < len(self._scenarios):
            scenario = self._scenarios[play.number]
            if scenario.stray is not None:
                play = self._cross(play, scenario, state, ego)
            else:
                scene = Scene(self._traffic, scenario, play, state, ego, orders)
                scene = act(scene if play.cast else call(scene, at_start), dt_s)
                play, state, orders = scene.play, scene.state, scene.orders
        return play, state, dataclasses.replace(orders, scripted_mps=self._paces(play, state, ego))

    def _cross(self, play: Play, scenario: Scenario, state: TrafficState, ego: Ego) -> Play:
        index = self._numbers.index(play.number)
        stray = state.scripted_actors[index]
        if ego.front_gap_m(scenario.at_m) < -PASSED_M or stray.s_m >= stray.length_m:
            return play.after()
        pace = pace_to_begin(scenario, stray, ego) if play.since_s is None else None
        if pace is None or walks_into(stray, pace, vehicle_boxes(self._traffic, state, ego)):
            return play
        paces = (*play.pace_mps[:index], pace, *play.pace_mps[index + 1 :])
        return dataclasses.replace(play.beginning(ego.t_s), pace_mps=paces)

    def _paces(self, play: Play, state: TrafficState, ego: Ego) -> tuple[float, ...]:
        """Return the current speed of each stray, m/s."""
        begun, paces, boxes = dict(play.begun), list(play.pace_mps), None
        for index, (number, stray) in enumerate(zip(self._numbers, state.scripted_actors, strict=True)):
            if paces[index] == 0.0 or stray.s_m >= stray.length_m:
                continue
            boxes = boxes or vehicle_boxes(self._traffic, state, ego)
            waits = is_on_the_spot(self._scenarios[number], stray, ego.t_s - begun[number])
            paces[index] = 0.0 if waits else pace_among(stray, paces[index], boxes)
        return tuple(paces)
