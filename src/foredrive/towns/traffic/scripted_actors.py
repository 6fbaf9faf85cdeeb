"""Scripted actors: people and cyclists on paths of their own, off walkways and across lanes.

The caller sets their speed.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from foredrive.geometry.polylines import arc_lengths, points_at
from foredrive.scene import Category

ACCELERATION_MPS2 = 4.0
FIRST_TRACK_ID = 40_000
"""First track id of scripted actors. Neither traffic nor parked cars use ids from here on."""


@dataclass(frozen=True, eq=False)
class ScriptedActor:
    """A person or a cyclist on a path of its own. Equal paths and speeds give equal motion."""

    track_id: int
    category: Category
    style: int
    size_lwh: Float64[np.ndarray, "3"]
    path_xyz: Float64[np.ndarray, "W 3"]
    """Points of the path, world frame, m, on the ground. No two points coincide."""
    s_m: float = 0.0
    """Distance along the path, seen from above, m."""
    speed_mps: float = 0.0

    @property
    def arc_m(self) -> Float64[np.ndarray, "W"]:
        """Return the arc length of the path's points, m."""
        return arc_lengths(self.path_xyz[:, :2])

    @property
    def length_m(self) -> float:
        """Return the length of the path, m."""
        return float(self.arc_m[-1])

    @property
    def is_under_way(self) -> bool:
        """Return whether it has left the start of the path and has not reached the end."""
        return 0.0 < self.s_m < self.length_m

    @property
    def xyz(self) -> Float64[np.ndarray, "3"]:
        """Return the position of the feet, m."""
        return points_at(self.path_xyz, self.arc_m, self.s_m)

    @property
    def ahead(self) -> Float64[np.ndarray, "2"]:
        """Return the unit heading, seen from above."""
        arc_m = self.arc_m
        # Leg of the path at this arc length; `side="right"` takes the next one at a vertex
        leg = min(int(np.searchsorted(arc_m, self.s_m, side="right")), len(arc_m) - 1)
        step = (self.path_xyz[leg] - self.path_xyz[leg - 1])[:2]
        return np.asarray(step / np.hypot(*step))

    @property
    def yaw_rad(self) -> float:
        """Return the heading about z, rad."""
        return float(np.arctan2(*self.ahead[::-1]))

    def moved(self, target_mps: float, dt_s: float) -> "ScriptedActor":
        """Return the actor one time step later, with its speed changed towards `target_mps`.

        A negative speed moves it backwards. It stands at the ends of its path.
        """
        # Limited change of speed, then the mean speed over the step
        max_change = ACCELERATION_MPS2 * dt_s
        speed = min(max(target_mps, self.speed_mps - max_change), self.speed_mps + max_change)
        s_m = self.s_m + 0.5 * (self.speed_mps + speed) * dt_s
        if not 0.0 < s_m < self.length_m:
            s_m, speed = min(max(s_m, 0.0), self.length_m), 0.0
        return dataclasses.replace(self, s_m=s_m, speed_mps=speed)


def step_scripted_actors(
    actors: tuple[ScriptedActor, ...], target_mps: tuple[float, ...], dt_s: float
) -> tuple[ScriptedActor, ...]:
    """Return all scripted actors one time step later. Without speeds they stand."""
    targets = target_mps or (0.0,) * len(actors)
    return tuple(actor.moved(target, dt_s) for actor, target in zip(actors, targets, strict=True))
