"""Plays the scenarios of a route one after the other."""

import dataclasses
from collections.abc import Sequence

from foredrive.simulation.scenarios.context import ScenarioContext, ScenarioEgo, ScenarioProgress
from foredrive.simulation.scenarios.crossing_actors import (
    is_on_the_spot,
    pace_among,
    pace_to_begin,
    vehicle_boxes,
    would_hit,
)
from foredrive.simulation.scenarios.scenario import Scenario
from foredrive.simulation.scenarios.vehicle_orders import give_orders
from foredrive.simulation.scenarios.vehicles import place_vehicles
from foredrive.towns.traffic.orders import Orders
from foredrive.towns.traffic.state import TrafficState
from foredrive.towns.traffic.traffic import Traffic

PASSED_M = 8.0


class Director:
    """Gives the traffic its orders for the scenarios of one route. All state is in `ScenarioProgress`."""

    def __init__(self, traffic: Traffic, scenarios: Sequence[Scenario]) -> None:
        self._traffic, self._scenarios = traffic, scenarios
        self._numbers = [number for number, scenario in enumerate(scenarios) if scenario.actor is not None]
        self._crossing_actors = tuple(scenario.actor for scenario in scenarios if scenario.actor is not None)

    def set_up(
        self, state: TrafficState, ego: ScenarioEgo, dt_s: float
    ) -> tuple[ScenarioProgress, TrafficState]:
        """Return the progress and the traffic at the start of a drive.

        All crossing road users wait at their places, and the vehicles of a near scenario are on the road.
        """
        progress = ScenarioProgress(pace_mps=(0.0,) * len(self._crossing_actors))
        state = dataclasses.replace(state, scripted_actors=self._crossing_actors)
        progress, state, _ = self.direct(progress, state, ego, dt_s, at_start=True)
        return progress, state

    def direct(
        self,
        progress: ScenarioProgress,
        state: TrafficState,
        ego: ScenarioEgo,
        dt_s: float,
        at_start: bool = False,
    ) -> tuple[ScenarioProgress, TrafficState, Orders]:
        """Return the updated progress, the traffic, and the orders for its next step.

        The traffic includes newly placed vehicles.
        """
        orders = Orders.none(len(state.vehicles.active))
        if progress.number < len(self._scenarios):
            scenario = self._scenarios[progress.number]
            if scenario.actor is not None:
                progress = self._direct_crossing(progress, scenario, state, ego)
            else:
                context = ScenarioContext(self._traffic, scenario, progress, state, ego, orders)
                context = give_orders(context if progress.slots else place_vehicles(context, at_start), dt_s)
                progress, state, orders = context.progress, context.state, context.orders
        speeds_mps = self._crossing_mps(progress, state, ego)
        return progress, state, dataclasses.replace(orders, scripted_mps=speeds_mps)

    def _direct_crossing(
        self, progress: ScenarioProgress, scenario: Scenario, state: TrafficState, ego: ScenarioEgo
    ) -> ScenarioProgress:
        index = self._numbers.index(progress.number)
        actor = state.scripted_actors[index]
        if ego.front_gap_m(scenario.at_m) < -PASSED_M or actor.s_m >= actor.length_m:
            return progress.after()
        pace = pace_to_begin(scenario, actor, ego) if progress.since_s is None else None
        if pace is None or would_hit(actor, pace, vehicle_boxes(self._traffic, state, ego)):
            return progress
        paces = (*progress.pace_mps[:index], pace, *progress.pace_mps[index + 1 :])
        return dataclasses.replace(progress.beginning(ego.t_s), pace_mps=paces)

    def _crossing_mps(
        self, progress: ScenarioProgress, state: TrafficState, ego: ScenarioEgo
    ) -> tuple[float, ...]:
        """Return the current speed of each crossing actor, m/s."""
        begun, paces, boxes = dict(progress.begun), list(progress.pace_mps), None
        for index, (number, actor) in enumerate(zip(self._numbers, state.scripted_actors, strict=True)):
            if paces[index] == 0.0 or actor.s_m >= actor.length_m:
                continue
            boxes = boxes or vehicle_boxes(self._traffic, state, ego)
            waits = is_on_the_spot(self._scenarios[number], actor, ego.t_s - begun[number])
            paces[index] = 0.0 if waits else pace_among(actor, paces[index], boxes)
        return tuple(paces)
