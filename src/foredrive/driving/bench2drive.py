"""Bench2Drive's metrics of drives (Jia et al. 2024), after its tools at 7ec25d1.

A drive succeeds if it completes its route without any infraction. Efficiency is the speed of the vehicle as a
share of that of the traffic around it, over twenty parts of the route. Smoothness is the share of pieces of
twenty steps in which all of nuPlan's bounds of comfort hold. An ability is the success in drives with certain
scenarios.
"""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float64

from foredrive.driving.comfort import BOUNDS
from foredrive.driving.dynamics import EGO, STEP_S, yaw_rate_radps
from foredrive.driving.scores import Ending, InfractionKind, RouteScore
from foredrive.scene import Attribute, BicycleState, Boxes
from foredrive.scene.boxes import VEHICLES

PARTS = 20
"""Number of parts of a route for each of which the efficiency is computed."""
MAX_PCT = 1000.0
"""A part with a greater efficiency does not count: the traffic around stood."""
PIECE, ASSUMED_STEP_S = 20, 0.1
"""Steps of a piece, and the time that the tool takes for one, s."""
WINDOW, ORDER = 7, 2
"""Samples and degree of the polynomials that smooth them."""
ABILITIES: Mapping[str, tuple[str, ...]] = {
    "merging": ("cut_in", "oncoming_traffic"),
    "emergency_brake": (
        "lead_brakes",
        "obstacle_behind_corner",
        "crossing_pedestrian",
        "crossing_cyclist",
        "red_light_runner",
    ),
    "traffic_signs": ("oncoming_traffic", "red_light_runner", "obstacle_behind_corner"),
}
"""The scenarios of towns by the abilities of Bench2Drive's that they resemble: HighwayCutIn,
SignalizedJunctionLeftTurn, HardBreakRoute, VehicleTurningRoute, DynamicObjectCrossing and
OppositeVehicleRunningRedLight. None asks for overtaking or giving way."""


def succeeds(score: RouteScore) -> bool:
    """Return whether a drive completed its route without an infraction. Low speeds do not count as one."""
    kinds = {infraction.kind for infraction in score.infractions} - {InfractionKind.MIN_SPEED}
    return score.ending is Ending.COMPLETED and not kinds and not score.outside_lanes


@dataclass
class EfficiencyMeter:
    """Measures the efficiency of a drive from its key frames."""

    parts_pct: list[float] = field(default_factory=list)
    """The efficiency of each part that is done, %."""
    _done: float = 0.0
    _own_mps: list[float] = field(default_factory=list)
    _traffic_mps: list[float] = field(default_factory=list)

    def see(self, speed_mps: float, boxes: Boxes, completion: float) -> None:
        """Take a key frame: the vehicle's speed, the boxes around it, and the driven share of the route."""
        if completion - self._done > 1 / PARTS:
            self._end_part()
            self._done = completion
        others = boxes.valid & torch.isin(boxes.category, torch.tensor(sorted(VEHICLES)))
        others &= boxes.attribute != Attribute.VEHICLE_PARKED
        speeds = boxes.velocity[others].norm(dim=-1)
        speeds = speeds[speeds.isfinite()]
        if len(speeds):
            self._own_mps.append(speed_mps)
            self._traffic_mps.append(float(speeds.mean()))

    def result(self, completion: float) -> float | None:
        """Return the mean over the parts, %. None if no part was done, or the traffic stood in all."""
        if completion > 1 - 1 / PARTS:
            self._end_part()
        counted = [part for part in self.parts_pct if part <= MAX_PCT]
        return statistics.fmean(counted) if counted else None

    def _end_part(self) -> None:
        traffic_mps = statistics.fmean(self._traffic_mps) if self._traffic_mps else 0.0
        own = statistics.fmean(self._own_mps) if self._own_mps else 0.0
        self.parts_pct.append(100.0 * own / traffic_mps if traffic_mps else 100.0)
        self._own_mps, self._traffic_mps = [], []


def smoothness_of(states: Sequence[BicycleState]) -> float | None:
    """Return the share of pieces of twenty steps in which all bounds hold, %. None for less than a piece.

    Bench2Drive's tool takes CARLA's steps of 0.05 s for 0.1 s, and its turn rates in degrees per second for
    radians. So does this, because all published figures are made so: hardly any turn is smooth.

    Args:
        states: one state every `STEP_S`.
    """
    speed = np.array([state.speed_mps for state in states])
    turning = np.array([yaw_rate_radps(state, EGO) for state in states])[1:]
    smooth = smooth_pieces(np.diff(speed) / STEP_S, speed[1:] * turning, np.degrees(turning))
    return 100.0 * statistics.fmean(smooth) if smooth else None


def smooth_pieces(
    along_mps2: Float64[np.ndarray, "T"],
    aside_mps2: Float64[np.ndarray, "T"],
    turning: Float64[np.ndarray, "T"],
) -> list[bool]:
    """Return for each whole piece whether its accelerations, jerks and turn rates stay within the bounds."""
    from scipy.signal import savgol_filter  # takes 0.3 s

    smooth = []
    for begin in range(0, len(along_mps2) - PIECE + 1, PIECE):
        along, aside, turn = (values[begin : begin + PIECE] for values in (along_mps2, aside_mps2, turning))
        # Turn rates are unwrapped as if they were angles
        turn = turn - 2 * np.pi * np.cumsum(np.round(np.diff(turn, prepend=turn[0]) / (2 * np.pi)))
        along, aside, norm, turn = (
            savgol_filter(values, WINDOW, ORDER) for values in (along, aside, np.hypot(along, aside), turn)
        )
        jerk, jerk_along = (
            savgol_filter(values, WINDOW, ORDER, deriv=1, delta=ASSUMED_STEP_S) for values in (norm, along)
        )
        bounds = (
            (along, BOUNDS.min_longitudinal_mps2, BOUNDS.max_longitudinal_mps2),
            (aside, -BOUNDS.max_lateral_mps2, BOUNDS.max_lateral_mps2),
            (jerk, -BOUNDS.max_jerk_mps3, BOUNDS.max_jerk_mps3),
            (jerk_along, -BOUNDS.max_longitudinal_jerk_mps3, BOUNDS.max_longitudinal_jerk_mps3),
            (turn, -BOUNDS.max_yaw_rate_radps, BOUNDS.max_yaw_rate_radps),
        )
        smooth.append(all(bool(((low < values) & (values < high)).all()) for values, low, high in bounds))
    return smooth


@dataclass(frozen=True)
class Bench2DriveDrive:
    """The parts of one drive that the metrics use."""

    success: bool
    efficiency_pct: float | None
    smoothness_pct: float | None
    scenarios: frozenset[str]
    """Kinds of the scenarios that began."""


def bench2drive_figures(drives: Sequence[Bench2DriveDrive]) -> dict[str, float | int | None]:
    """Return the metrics of a suite, %: means over its drives, and the success by ability.

    An ability that no drive has asked for is None.
    """

    def mean(values: Sequence[float | None]) -> float | None:
        defined = [value for value in values if value is not None and math.isfinite(value)]
        return statistics.fmean(defined) if defined else None

    figures: dict[str, float | int | None] = {
        "success_pct": mean([100.0 * drive.success for drive in drives]),
        "efficiency_pct": mean([drive.efficiency_pct for drive in drives]),
        "smoothness_pct": mean([drive.smoothness_pct for drive in drives]),
    }
    for ability, kinds in ABILITIES.items():
        asked = [100.0 * drive.success for drive in drives if drive.scenarios & set(kinds)]
        figures |= {f"ability.{ability}_pct": mean(asked), f"ability.{ability}_drives": len(asked)}
    return figures
