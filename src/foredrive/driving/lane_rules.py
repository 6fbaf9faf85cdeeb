"""Lane rules of CARLA's leaderboard 1.0: red lights, stop signs, and driving outside of the lanes.

The rules are the same in every simulator. `town_lanes` and `carla.road` read the lanes that they apply to.
"""

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int

from foredrive.driving.dynamics import EGO
from foredrive.scene import BicycleState, DriveProgress, Event
from foredrive.scene.traffic_light import LightState

TAIL = 0.8
"""The vehicle runs a red light when a reference point crosses the line. This point lies behind the
vehicle's middle by `TAIL` times half the vehicle's length (CARLA's RunningRedLightTest)."""
STOPPED_MPS = 0.1
"""Speed below which the vehicle counts as stopped, m/s (CARLA's RunningStopTest)."""
STOP_WITHIN_M = 6.0
"""A stop counts if the front bumper is at most this far before the line, m, or beyond it by at most half a
vehicle."""
LINE_MARGIN_M = 0.3
LINES_WITHIN_M = EGO.length_m + STOP_WITHIN_M
LEVEL_M = 2.5
"""Height difference above which a line is on another level than the vehicle, m."""
OUTSIDE_BY_M = 1.3
WRONG_WAY_RAD = np.deg2rad(120.0)
"""CARLA's OutsideRouteLanesTest: the vehicle is more than `OUTSIDE_BY_M` beside all lanes, or its heading
differs by more than `WRONG_WAY_RAD` from that of its lane."""
MIN_LEFT_M = 0.5
"""A shorter distance outside of the lanes, m, gives no event, but still counts in the score."""


class StopLines(NamedTuple):
    """Stop lines of K lanes. A line lies where the lane behind it begins."""

    zone: Int[np.ndarray, "K"]
    """Index of the stop zone."""
    is_sign: Bool[np.ndarray, "K"]
    """True for a stop sign, False for a light."""
    xyz: Float64[np.ndarray, "K 3"]
    ahead: Float64[np.ndarray, "K 2"]
    half_width_m: Float64[np.ndarray, "K"]


@dataclass(frozen=True)
class RuleState:
    """Memory of the rules between steps."""

    stopped_at: frozenset[int] = frozenset()
    """Stop zones at whose lines the vehicle has stopped and which it has not passed yet."""
    driven_m: float = 0.0
    outside_m: float = 0.0
    """Part of `driven_m` outside of all lanes or against their direction, m."""
    left_at: tuple[float, float] | None = None
    """Position where the vehicle left the lanes, m, world frame. None while it is inside."""
    left_m: float = 0.0
    """Distance driven since then, m."""

    @property
    def outside_share(self) -> float:
        """Return the share of the distance that was driven outside of the lanes."""
        return self.outside_m / max(self.driven_m, 1e-9)

    def progress(self, completion: float) -> DriveProgress:
        """Return the progress of a drive that has completed a share of its route."""
        return DriveProgress(completion, min(1.0, self.outside_share), self.driven_m)

    def final_events(self, t_s: float) -> list[Event]:
        """Return the events to add at the end of a drive: one if it ends outside of the lanes."""
        return [] if self.left_at is None else [left_lanes(self.left_at, self.left_m, t_s)]


def lines_run(
    lines: StopLines,
    before: BicycleState,
    after: BicycleState,
    z_m: float,
    lights: Int[np.ndarray, "Z"],
    stopped_at: frozenset[int],
    t_s: float,
) -> tuple[list[Event], frozenset[int]]:
    """Detect red lights and stop signs that were run in one step.

    Returns the events and the stop zones at which the vehicle has stopped.

    Args:
        lines: stop lines of the road; those near the vehicle are checked.
        lights: a `LightState` for each stop zone.
        stopped_at: stop zones returned by the last step.
    """
    middle = body_middle(after)
    near = _near_lines(lines, np.append(middle, z_m))
    if near is None:
        return [], frozenset()
    events, xy = [], (float(middle[0]), float(middle[1]))
    tail_m = EGO.axle_to_centre_m - TAIL * 0.5 * EGO.length_m
    run = ~near.is_sign & (lights[near.zone] == LightState.RED) & _crossed(near, before, after, tail_m)
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
    """Update the distances driven inside and outside of the lanes.

    Returns an event if the vehicle has just come back to the lanes.

    Args:
        outside: whether the vehicle is now outside of all lanes or drives against them.
    """
    events, middle = [], body_middle(after)
    moved_m = float(np.hypot(after.x_m - before.x_m, after.y_m - before.y_m))
    left_at, left_m = state.left_at, state.left_m
    if outside:
        left_at = left_at or (float(middle[0]), float(middle[1]))
        left_m += moved_m
    elif left_at is not None:
        if left_m > MIN_LEFT_M:
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
    """Return the middle of the vehicle, m, in the plane."""
    return _point(state, EGO.axle_to_centre_m)


def _near_lines(lines: StopLines, xyz: Float64[np.ndarray, "3"]) -> StopLines | None:
    """Return the lines near a vehicle whose middle is at `xyz`. None if there are none."""
    offset = np.abs(lines.xyz - xyz)
    near = np.flatnonzero((offset[:, 0] < LINES_WITHIN_M) & (offset[:, 1] < LINES_WITHIN_M))
    near = near[offset[near, 2] < LEVEL_M]
    return StopLines(*(column[near] for column in lines)) if len(near) else None


def _beside(
    lines: StopLines, xy: Float64[np.ndarray, "2"]
) -> tuple[Float64[np.ndarray, "K"], Float64[np.ndarray, "K"]]:
    """Return how far a point lies beyond each line, m, and how far beside the middle of its lane, m."""
    dx, dy = (xy - lines.xyz[:, :2]).T
    ahead_x, ahead_y = lines.ahead.T
    return ahead_x * dx + ahead_y * dy, np.abs(ahead_x * dy - ahead_y * dx)


def _crossed(
    lines: StopLines, before: BicycleState, after: BicycleState, ahead_m: float
) -> Bool[np.ndarray, "K"]:
    """Return which lines a point of the vehicle has crossed in the direction of travel."""
    first, _ = _beside(lines, _point(before, ahead_m))
    then, aside = _beside(lines, _point(after, ahead_m))
    return (first < 0) & (then >= 0) & (aside < lines.half_width_m)


def left_lanes(left_at: tuple[float, float], left_m: float, t_s: float) -> Event:
    """Build the event of a drive outside of the lanes that ends now."""
    return Event("outside_lane", t_s, left_at, f"for {left_m:.1f} m", "lane", left_m)


def _point(state: BicycleState, ahead_m: float) -> Float64[np.ndarray, "2"]:
    """Return a point on the vehicle's longitudinal axis, `ahead_m` before its rear axle."""
    forward = np.array([np.cos(state.yaw_rad), np.sin(state.yaw_rad)])
    return np.array([state.x_m, state.y_m]) + ahead_m * forward
