"""Progress of the ego vehicle along its route, and the conditions that end a drive."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from foredrive.data.commands import RouteAhead, command_of, route_ahead, route_offset_m
from foredrive.driving.dynamics import EGO
from foredrive.driving.observation import KeyFrame, make_clip
from foredrive.errors import InputError
from foredrive.geometry.polylines import arc_lengths, points_at
from foredrive.scene import BicycleState, CameraRig, Clip, Command, Event

SPACING_M = 1.0
AHEAD_M, BACK_M = 20.0, 5.0
"""Part of the route, ahead and behind, m, that is searched for the vehicle's position: routes may cross
themselves."""
ARRIVED_M = 5.0
"""A vehicle this near to the end, m, has completed the route."""
DEVIATION_M = 30.0
BLOCKED_S, BLOCKED_MPS = 180.0, 0.1
"""Bounds of leaderboard 1.0. Further than `DEVIATION_M` from the route is a deviation. Slower than
`BLOCKED_MPS` for `BLOCKED_S` is blocked."""


@dataclass(frozen=True)
class RouteProgress:
    """Progress along one route."""

    done_m: float = 0.0
    beside_m: float = 0.0
    """Distance from the route, m."""
    moved_s: float = 0.0
    """Time of the last movement, s."""


def first_step(xyz: Float64[np.ndarray, "M 3"]) -> Float64[np.ndarray, "3"]:
    """Return the vector from a route's start to its first point that is more than a wheelbase away, m.

    A vehicle at the start of the route points in this direction.

    Raises:
        InputError: no point is that far away.
    """
    # The first point beyond a wheelbase gives a direction that rounding does not spoil
    away_m = np.hypot(*(xyz[:, :2] - xyz[0, :2]).T)
    ahead = np.flatnonzero(away_m > EGO.wheelbase_m)
    if not len(ahead):
        raise InputError("the route must be longer than the vehicle")
    return np.asarray(xyz[ahead[0]] - xyz[0])


class RouteLine:
    """A route to follow.

    Args:
        xyz: polyline, m, world frame.
    """

    def __init__(self, xyz: Float64[np.ndarray, "M 3"]) -> None:
        arc_m = arc_lengths(xyz[:, :2])
        self.length_m = float(arc_m[-1])
        # Even spacing of about a metre
        self._arc_m = np.linspace(0.0, self.length_m, max(2, int(np.ceil(self.length_m / SPACING_M)) + 1))
        self._xy = points_at(xyz[:, :2], arc_m, self._arc_m)

    def advance(
        self, progress: RouteProgress, xy: Float64[np.ndarray, "2"], speed_mps: float, t_s: float
    ) -> RouteProgress:
        """Return the progress of a vehicle that is now at `xy`. Progress never decreases."""
        # Search only near the last position: a route may cross itself
        first, last = np.searchsorted(self._arc_m, [progress.done_m - BACK_M, progress.done_m + AHEAD_M])
        part = slice(int(first), int(last) + 1)
        away_m = np.hypot(*(self._xy[part] - xy).T)
        nearest = int(np.argmin(away_m))
        # Progress never decreases
        done_m = max(progress.done_m, float(self._arc_m[part][nearest]))
        arrived = done_m > self.length_m - ARRIVED_M and away_m[nearest] < ARRIVED_M
        return dataclasses.replace(
            progress,
            done_m=self.length_m if arrived else done_m,
            beside_m=float(away_m[nearest]),
            moved_s=t_s if speed_mps >= BLOCKED_MPS else progress.moved_s,
        )

    def end_of(self, progress: RouteProgress, t_s: float, limit_s: float) -> str | None:
        """Return why a drive is over: "completed", "deviation", "blocked" or "timeout". None if it is not."""
        if progress.done_m >= self.length_m:
            return "completed"
        if progress.beside_m > DEVIATION_M:
            return "deviation"
        if t_s - progress.moved_s > BLOCKED_S:
            return "blocked"
        return "timeout" if t_s >= limit_s else None

    def completion(self, progress: RouteProgress) -> float:
        """Return the share of the route that has been driven, 0 to 1."""
        return min(1.0, progress.done_m / self.length_m)

    def end_event(self, ended: str, progress: RouteProgress, ego: BicycleState, t_s: float) -> Event:
        """Return the event of the end of a drive, for a reason as `end_of` returns it."""
        text = f"{progress.done_m:.0f} of {self.length_m:.0f} m"
        return Event(ended, t_s, (ego.x_m, ego.y_m), text)

    def observe(self, frames: Sequence[KeyFrame], progress: RouteProgress, rig: CameraRig | None) -> Clip:
        """Return the clip of some key frames, with the command and the next points of the route."""
        route = self.ahead(progress, frames[-1].T_world_ego)
        return make_clip(frames, rig, self.command(progress), route)

    def command(self, progress: RouteProgress) -> Command:
        """Return the next command of the route, computed as for recorded logs."""
        return command_of(route_offset_m(self._arc_m, self._xy, progress.done_m))

    def ahead(self, progress: RouteProgress, T_world_ego: Float64[np.ndarray, "4 4"]) -> RouteAhead:
        """Return the next points of the route in the ego frame, computed as for recorded logs."""
        return route_ahead(self._arc_m, self._xy, progress.done_m, T_world_ego)
