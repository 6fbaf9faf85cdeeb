"""Lights run, stop signs run, lanes left: what CARLA's leaderboard 1.0 watches on the road."""

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int

from foredrive.scene import BicycleState, Event
from foredrive.simulation.dynamics import EGO
from foredrive.towns.map.town_map import StopZoneKind, TownMap
from foredrive.towns.traffic.lights import Light
from foredrive.towns.traffic.near_lanes import LEVEL_M, NearLanes
from foredrive.towns.traffic.traffic import Traffic

TAIL = 0.8
"""A red light is run when the point so far from the middle to the rear bumper crosses the line (CARLA's
RunningRedLightTest)."""
STOPPED_MPS = 0.1
"""Slower than this is a stop (CARLA's RunningStopTest)."""
STOP_WITHIN_M = 6.0
"""A stop counts with the front bumper this far before the line at most, or over it by half a vehicle."""
LINE_MARGIN_M = 0.3
LINES_WITHIN_M = EGO.length_m + STOP_WITHIN_M
OUTSIDE_BY_M = 1.3
WRONG_WAY_RAD = np.deg2rad(120.0)
"""CARLA's OutsideRouteLanesTest: further than this beside all lanes, or more than this against one."""
LANES_WITHIN_M = 6.0
LEAST_LEFT_M = 0.5
"""Less than this outside is not reported as an event; it counts all the same."""


class Lines(NamedTuple):
    """The stop lines of K lanes: where the lanes behind them begin."""

    zone: Int[np.ndarray, "K"]
    """Index of the stop zone."""
    is_sign: Bool[np.ndarray, "K"]
    """A stop sign's, not a light's."""
    xyz: Float64[np.ndarray, "K 3"]
    ahead: Float64[np.ndarray, "K 2"]
    half_width_m: Float64[np.ndarray, "K"]


@dataclass(frozen=True)
class RuleState:
    """What has to be remembered to tell whether rules were kept."""

    stopped_at: frozenset[int] = frozenset()
    """Stop zones at whose lines the vehicle has stopped, and that it has not passed yet."""
    driven_m: float = 0.0
    outside_m: float = 0.0
    """Of it outside of all lanes, or against their direction."""
    left_at: tuple[float, float] | None = None
    """Where it has left the lanes, if it is outside now."""
    left_m: float = 0.0
    """How far it has driven since."""

    @property
    def outside_share(self) -> float:
        """Part of the way that was driven outside of the lanes."""
        return self.outside_m / max(self.driven_m, 1e-9)


def stop_lines(town: TownMap) -> Lines:
    """The lines before lights and at stop signs."""
    lanes = {lane.lane_id: lane for lane in town.lanes}
    kinds = (StopZoneKind.TRAFFIC_LIGHT, StopZoneKind.STOP_SIGN)
    rows = [
        (index, zone.kind is StopZoneKind.STOP_SIGN, lanes[name])
        for index, zone in enumerate(town.stop_zones)
        for name in zone.lane_ids
        if zone.kind in kinds and name in lanes
    ]
    starts = np.array([lane.centreline_xyz[:2] for *_, lane in rows]).reshape(-1, 2, 3)
    ahead = starts[:, 1, :2] - starts[:, 0, :2]
    return Lines(
        zone=np.array([zone for zone, *_ in rows], dtype=np.int64),
        is_sign=np.array([sign for _, sign, _ in rows], dtype=np.bool_),
        xyz=starts[:, 0],
        ahead=ahead / np.linalg.norm(ahead, axis=1, keepdims=True),
        half_width_m=0.5 * np.array([lane.width_m for *_, lane in rows]) + LINE_MARGIN_M,
    )


class LaneRules:
    """Watches one drive in a town."""

    def __init__(self, town: TownMap, traffic: Traffic) -> None:
        self._lines = stop_lines(town)
        self._near: NearLanes = traffic.near_lanes
        self._graph = traffic.lanes

    def check(
        self,
        before: BicycleState,
        after: BicycleState,
        z_m: float,
        lights: Int[np.ndarray, "Z"],
        state: RuleState,
        t_s: float,
    ) -> tuple[list[Event], RuleState]:
        """What was run or left in one step, and what is remembered from now on.

        Args:
            lights: a `Light` for each of the town's stop zones.
        """
        events, stopped_at = lines_run(self._lines, before, after, z_m, lights, state.stopped_at, t_s)
        outside = self._is_outside(np.append(body_middle(after), z_m), after.yaw_rad)
        more, state = way_driven(state, before, after, outside, t_s)
        return events + more, dataclasses.replace(state, stopped_at=stopped_at)

    def _is_outside(self, xyz: Float64[np.ndarray, "3"], yaw_rad: float) -> bool:
        samples = self._near.within(xyz, LANES_WITHIN_M)
        if not len(samples):
            return True
        lane = self._near.lane[samples]
        away_m = np.hypot(*(self._near.xyz[samples, :2] - xyz[:2]).T)
        if (away_m - 0.5 * self._graph.width_m[lane]).min() > OUTSIDE_BY_M:
            return True
        inside = away_m < 0.5 * self._graph.width_m[lane]
        if not inside.any() or (self._graph.junction[lane[inside]] >= 0).any():
            return False  # between lanes, or in a junction, where they cross
        turned = np.abs((yaw_rad - self._near.heading[samples[inside]] + np.pi) % (2 * np.pi) - np.pi)
        return bool((turned > WRONG_WAY_RAD).all())


def lines_run(
    lines: Lines,
    before: BicycleState,
    after: BicycleState,
    z_m: float,
    lights: Int[np.ndarray, "Z"],
    stopped_at: frozenset[int],
    t_s: float,
) -> tuple[list[Event], frozenset[int]]:
    """Red lights and stop signs run in one step, and the stop zones at which the vehicle has stopped.

    Args:
        lines: those that may be met.
        lights: a `Light` for each stop zone.
        stopped_at: what the last step returned.
    """
    middle = body_middle(after)
    near = _near_lines(lines, np.append(middle, z_m))
    if near is None:
        return [], frozenset()
    events, xy = [], (float(middle[0]), float(middle[1]))
    tail_m = EGO.axle_to_centre_m - TAIL * 0.5 * EGO.length_m
    run = ~near.is_sign & (lights[near.zone] == Light.RED) & _crossed(near, before, after, tail_m)
    for zone in np.unique(near.zone[run]).tolist():
        events.append(Event("red_light", t_s, xy, f"at {after.speed_mps:.1f} m/s", f"light {zone}"))
    if not near.is_sign.any():
        return events, stopped_at
    along, aside = _beside(near, middle)
    front_m = along + 0.5 * EGO.length_m
    waits = near.is_sign & (aside < near.half_width_m) & (front_m > -STOP_WITHIN_M) & (along < 0)
    if after.speed_mps < STOPPED_MPS:
        stopped_at = stopped_at | set(near.zone[waits].tolist())
    passed = near.is_sign & _crossed(near, before, after, EGO.axle_to_centre_m)
    zones = set(near.zone[passed].tolist())
    for zone in sorted(zones - stopped_at):
        events.append(Event("stop_sign", t_s, xy, f"at {after.speed_mps:.1f} m/s", f"sign {zone}"))
    return events, stopped_at - zones


def way_driven(
    state: RuleState, before: BicycleState, after: BicycleState, outside: bool, t_s: float
) -> tuple[list[Event], RuleState]:
    """What is remembered of the lanes after one step, and the event of having come back to them.

    Args:
        outside: whether the vehicle is outside of all lanes now, or goes against them.
    """
    events, middle = [], body_middle(after)
    moved_m = float(np.hypot(after.x_m - before.x_m, after.y_m - before.y_m))
    left_at, left_m = state.left_at, state.left_m
    if outside:
        left_at = left_at or (float(middle[0]), float(middle[1]))
        left_m += moved_m
    elif left_at is not None:
        if left_m > LEAST_LEFT_M:
            events.append(left_lanes(left_at, left_m, t_s))
        left_at, left_m = None, 0.0
    return events, dataclasses.replace(
        state,
        driven_m=state.driven_m + moved_m,
        outside_m=state.outside_m + (moved_m if outside else 0.0),
        left_at=left_at,
        left_m=left_m,
    )


def body_middle(state: BicycleState) -> Float64[np.ndarray, "2"]:
    """The middle of the vehicle, seen from above."""
    return _point(state, EGO.axle_to_centre_m)


def _near_lines(lines: Lines, xyz: Float64[np.ndarray, "3"]) -> Lines | None:
    """The lines that a vehicle with its middle at a point may concern; None if there are none."""
    offset = np.abs(lines.xyz - xyz)
    near = np.flatnonzero((offset[:, 0] < LINES_WITHIN_M) & (offset[:, 1] < LINES_WITHIN_M))
    near = near[offset[near, 2] < LEVEL_M]
    return Lines(*(column[near] for column in lines)) if len(near) else None


def _beside(
    lines: Lines, xy: Float64[np.ndarray, "2"]
) -> tuple[Float64[np.ndarray, "K"], Float64[np.ndarray, "K"]]:
    """How far beyond each line a point is, and how far beside the middle of its lane."""
    dx, dy = (xy - lines.xyz[:, :2]).T
    ahead_x, ahead_y = lines.ahead.T
    return ahead_x * dx + ahead_y * dy, np.abs(ahead_x * dy - ahead_y * dx)


def _crossed(
    lines: Lines, before: BicycleState, after: BicycleState, ahead_m: float
) -> Bool[np.ndarray, "K"]:
    """Which lines a point of the vehicle has crossed in the direction of travel."""
    first, _ = _beside(lines, _point(before, ahead_m))
    then, aside = _beside(lines, _point(after, ahead_m))
    return (first < 0) & (then >= 0) & (aside < lines.half_width_m)


def left_lanes(left_at: tuple[float, float], left_m: float, t_s: float) -> Event:
    """The event of having driven outside of the lanes until now."""
    return Event("outside_lane", t_s, left_at, f"for {left_m:.1f} m", "lane", left_m)


def _point(state: BicycleState, ahead_m: float) -> Float64[np.ndarray, "2"]:
    """A point on the vehicle's middle line, ahead of its rear axle."""
    forward = np.array([np.cos(state.yaw_rad), np.sin(state.yaw_rad)])
    return np.array([state.x_m, state.y_m]) + ahead_m * forward
