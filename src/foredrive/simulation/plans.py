"""Plans of an agent, fixed in the world frame: a path, and the position along it over time."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import PchipInterpolator

from foredrive.errors import InputError
from foredrive.scene import BicycleState, Trajectory
from foredrive.simulation.dynamics import EGO, Vehicle
from foredrive.simulation.smooth_path import Path, fit_path

STANDS_M = 0.25
"""A plan that moves no further than this, m, means that the vehicle stands."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A path with a time for each position along it."""

    made_s: float
    """Time of the observation that the agent planned from, s. The plan's times count from here."""
    path: Path
    """Path in the world frame, from the vehicle's pose at `made_s`."""
    progress: PchipInterpolator
    """Distance along the path, m, over the time since `made_s`, s. Monotone, through the waypoints."""
    horizon_s: float

    def progress_m(self, after_s: float) -> float:
        """Return the planned distance along the path, m.

        From the horizon on it stays at the last waypoint.
        """
        return float(self.progress(min(max(after_s, 0.0), self.horizon_s)))

    def speed_mps(self, after_s: float) -> float:
        """Return the planned speed, m/s. It is 0 beyond the horizon, where the plan says nothing."""
        return float(self.progress(max(after_s, 0.0), 1)) if after_s <= self.horizon_s else 0.0


def fixed_in_world(
    trajectory: Trajectory, seen_from: BicycleState, made_s: float, vehicle: Vehicle = EGO
) -> Plan:
    """Fix an agent's plan in the world frame, given the pose and the time that the agent observed.

    Args:
        trajectory: one item. The most probable alternative is used, up to its first invalid step. Headings
            are derived from the points.

    Raises:
        InputError: the trajectory has no valid step, a step that is not finite, or more than one item.
    """
    waypoints = waypoints_of(trajectory)
    local = fit_path(waypoints, trajectory.dt_s, math.tan(seen_from.steering_rad) / vehicle.wheelbase_m)
    way_m = np.maximum.accumulate([0.0, *(local.project(point)[0] for point in waypoints)])
    times_s = trajectory.dt_s * np.arange(len(way_m))
    cos, sin = math.cos(seen_from.yaw_rad), math.sin(seen_from.yaw_rad)
    xy = local.xy @ np.array([[cos, sin], [-sin, cos]]) + [seen_from.x_m, seen_from.y_m]
    return Plan(
        made_s=made_s,
        path=Path(xy, local.heading_rad + seen_from.yaw_rad, local.curvature),
        progress=PchipInterpolator(times_s, way_m if way_m[-1] > STANDS_M else np.zeros_like(way_m)),
        horizon_s=float(times_s[-1]),
    )


def waypoints_of(trajectory: Trajectory) -> Float64[np.ndarray, "T 2"]:
    """Return the points of the most probable alternative, up to its first invalid step, m, ego frame.

    Raises:
        InputError: the trajectory has no valid step, a step that is not finite, or more than one item.
    """
    if trajectory.log_prob.shape[:-1].numel() != 1:
        raise InputError(f"expected one plan, got a batch of {tuple(trajectory.log_prob.shape[:-1])}")
    best, steps = int(trajectory.log_prob.reshape(-1).argmax()), trajectory.xy.shape[-2]
    valid = trajectory.valid.reshape(-1, steps)[best].cpu().numpy()
    count = steps if valid.all() else int(np.argmin(valid))
    xy = trajectory.xy.detach().reshape(-1, steps, 2)[best, :count].cpu().double().numpy()
    if not count or not np.isfinite(xy).all():
        raise InputError(f"a plan needs finite waypoints, got {xy.tolist()}")
    return xy
