"""Traffic lights with fixed cycles. Their state is a function of time alone."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int

from foredrive.scene.traffic_light import LightState
from foredrive.towns.traffic.lane_graph import LaneControl, LaneGraph

GREEN_S = 8.0
YELLOW_S = 4.0
ALL_RED_S = 1.0
PHASE_S = GREEN_S + YELLOW_S + ALL_RED_S
SAME_AXIS_COS = 0.7
"""Cosine of the maximum angle between approaches with a common green phase: 45 degrees to one axis, from
either end."""


@dataclass(frozen=True)
class SignalPlan:
    """For each lane that a light guards, the green time in the cycle of its junction."""

    guarded: Bool[np.ndarray, "L"]
    green_from_s: Float64[np.ndarray, "L"]
    cycle_s: Float64[np.ndarray, "L"]

    def light_states(self, time_s: float) -> Int[np.ndarray, "L"]:
        """Return the `LightState` at the start of each lane."""
        # Time since the lane's last green began, within the cycle
        into_s = (time_s - self.green_from_s) % self.cycle_s
        light = np.where(
            into_s < GREEN_S,
            LightState.GREEN,
            np.where(into_s < GREEN_S + YELLOW_S, LightState.YELLOW, LightState.RED),
        )
        return np.where(self.guarded, light, LightState.NONE)


def plan_signals(graph: LaneGraph, rng: np.random.Generator) -> SignalPlan:
    """Plan one phase per axis of a junction, in turn. Each junction starts at a random point of its cycle."""
    guarded = graph.control == LaneControl.LIGHT
    green_from_s = np.zeros(len(guarded))
    cycle_s = np.full(len(guarded), PHASE_S)
    # Approach direction of each guarded lane
    start = graph.xyz[graph.first + 1] - graph.xyz[graph.first]
    heading = np.arctan2(start[:, 1], start[:, 0])
    for junction in np.unique(graph.junction[guarded]):
        lanes = np.flatnonzero(guarded & (graph.junction == junction))
        axes: list[float] = []
        phase = np.zeros(len(lanes), dtype=np.int64)
        # Assign each approach to an existing axis within 45° (from either end), or begin a new one
        for k, angle in enumerate(heading[lanes]):
            along = [i for i, axis in enumerate(axes) if abs(np.cos(angle - axis)) > SAME_AXIS_COS]
            if not along:
                axes.append(angle)
            phase[k] = along[0] if along else len(axes) - 1
        # A junction with one axis shows red for as long as a second axis would have green.
        cycle_s[lanes] = PHASE_S * max(2, len(axes))
        green_from_s[lanes] = phase * PHASE_S + rng.uniform(0, cycle_s[lanes[0]])
    return SignalPlan(guarded, green_from_s, cycle_s)
