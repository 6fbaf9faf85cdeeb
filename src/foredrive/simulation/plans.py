"""What an agent wants, fixed in the world: a path, and how far along it to be at which time."""

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
"""A plan that gets no further than this means to stand."""


@dataclass(frozen=True, eq=False)
class Plan:
    """Where to be when."""

    made_s: float
    """When the agent saw what it planned from; the plan's times count from here."""
    path: Path
    """In the world frame, from where the vehicle was then."""
    progress: PchipInterpolator
    """Way along the path, m, by time since `made_s`, s: monotone, through the waypoints."""
    horizon_s: float

    def progress_m(self, after_s: float) -> float:
        """How far along the path to be; at the last waypoint from the horizon on."""
        return float(self.progress(min(max(after_s, 0.0), self.horizon_s)))

    def speed_mps(self, after_s: float) -> float:
        """How fast to be; 0 beyond the horizon: nobody planned that far."""
        return float(self.progress(max(after_s, 0.0), 1)) if after_s <= self.horizon_s else 0.0


def fixed_in_world(
    trajectory: Trajectory, seen_from: BicycleState, made_s: float, vehicle: Vehicle = EGO
) -> Plan:
    """The plan of an agent that saw the world from a pose at a time.

    Args:
        trajectory: one item; of several alternatives the most probable counts, up to its first invalid step.
            Headings are taken from the points.

    Raises:
        InputError: it has no valid step, a step that is not finite, or more than one item.
    """
    waypoints = _waypoints(trajectory)
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


def _waypoints(trajectory: Trajectory) -> Float64[np.ndarray, "T 2"]:
    """The points of the most probable alternative, up to its first invalid step."""
    if trajectory.log_prob.shape[:-1].numel() != 1:
        raise InputError(f"one plan at a time, got a batch of {tuple(trajectory.log_prob.shape[:-1])}")
    best, steps = int(trajectory.log_prob.reshape(-1).argmax()), trajectory.xy.shape[-2]
    valid = trajectory.valid.reshape(-1, steps)[best].cpu().numpy()
    count = steps if valid.all() else int(np.argmin(valid))
    xy = trajectory.xy.detach().reshape(-1, steps, 2)[best, :count].cpu().double().numpy()
    if not count or not np.isfinite(xy).all():
        raise InputError(f"a plan needs finite waypoints, got {xy.tolist()}")
    return xy
