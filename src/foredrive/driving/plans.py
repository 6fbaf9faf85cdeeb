"""Plans of an agent, fixed in the world frame: a path, and the position along it over time.

The path passes near all waypoints, with little jerk, from the current pose. A path through every waypoint has
to correct any error of the first waypoint within the first half second. With latency this leads to growing
oscillations. Regularised least squares averages over several waypoints instead (nuPlan's tracker fits speeds
and curvatures in this way).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int
from scipy.interpolate import PchipInterpolator

from foredrive.driving.dynamics import EGO, Vehicle
from foredrive.errors import InputError
from foredrive.scene import BicycleState, Trajectory

KNOT_M = 2.0
"""Knots are waypoints at least this far apart, m. Nearer ones tell the speed but hardly the direction."""
SAMPLE_M = 0.25
BEYOND_M = 10.0
"""The path continues straight beyond its end, m, for vehicles that overshoot."""
SMOOTHING_S5 = 3e-4
"""Weight of the jerk: 1 m/s³ for 1 s costs as much as missing a knot by 1.7 cm."""
MIN_MPS = 4.0
"""Slower paths are smoothed as if driven at this speed, m/s."""
STEERING_S = 0.3
"""The initial curvature may differ from the current one by as much as steering changes in this time, s."""


class Path(NamedTuple):
    """A path in the plane, sampled every `SAMPLE_M`."""

    xy: Float64[np.ndarray, "N 2"]
    heading_rad: Float64[np.ndarray, "N"]
    """Continuous, so it exceeds ±π in loops."""
    curvature: Float64[np.ndarray, "N"]
    """1/m, positive to the left."""

    def project(self, xy: Float64[np.ndarray, "2"]) -> tuple[float, float]:
        """Return the distance of a point along the path, m, and its offset to the left of the path, m.

        Both are measured in the axes of the nearest sample.
        """
        offset = xy - self.xy
        # Nearest sample, then the offset in its axes
        near = int(np.argmin(np.einsum("ni,ni->n", offset, offset)))
        cos, sin = np.cos(self.heading_rad[near]), np.sin(self.heading_rad[near])
        dx, dy = offset[near]
        return near * SAMPLE_M + float(cos * dx + sin * dy), float(cos * dy - sin * dx)

    def course(self, way_m: float) -> tuple[float, float]:
        """Return the heading, rad, and the curvature, 1/m, at a distance along the path."""
        way = np.arange(len(self.xy)) * SAMPLE_M
        heading, curvature = (np.interp(way_m, way, column) for column in (self.heading_rad, self.curvature))
        return float(heading), float(curvature)


def fit_path(waypoints: Float64[np.ndarray, "T 2"], dt_s: float, curvature_now: float) -> Path:
    """Fit the path of a plan. It starts at the origin along x.

    The curvature κ is linear between the knots and minimises Σ offset² + `SMOOTHING_S5` ∫ (v³ dκ/ds)² dt. The
    offsets are those to each knot, and the jerk is the lateral jerk at the plan's speeds. The problem is
    linearised about the chords: along each chord the offset grows by the integral of heading minus chord
    direction, which is exact for circles.

    Args:
        waypoints: points in the ego frame at the time of the plan, m, `dt_s` apart; the first is at `dt_s`.
        curvature_now: curvature of the current steering angle, 1/m.
    """
    index = _knots(waypoints)
    if not len(index):
        return _integrated(np.zeros(1), np.zeros(1))
    # Chords between the knots, their lengths and directions
    chords = np.diff(waypoints[index], axis=0, prepend=np.zeros((1, 2)))
    chord_m = np.hypot(chords[:, 0], chords[:, 1])
    direction = np.unwrap(np.arctan2(chords[:, 1], chords[:, 0]))
    # Speed along each chord, but at least `MIN_MPS`
    pace_mps = np.hypot(chord_m / (dt_s * np.diff(index, prepend=-1)), MIN_MPS)
    unit = np.eye(len(index) + 1)
    heading, offset = np.zeros(len(unit)), np.zeros(len(unit))  # as linear functions of the curvatures
    # Soft constraint on the first curvature: as much as steering changes in `STEERING_S`
    firm = np.sqrt(SMOOTHING_S5 / STEERING_S) * pace_mps[0] ** 2
    rows, wanted = [firm * unit[0]], [firm * curvature_now]
    for k, (length, pace) in enumerate(zip(chord_m, pace_mps, strict=True)):
        # Offset and heading at the end of the chord: integrals of a linear curvature
        offset = offset + length * (heading + length * (unit[k] / 3 + unit[k + 1] / 6))
        heading = heading + 0.5 * length * (unit[k] + unit[k + 1])
        # Lateral jerk v³ dκ/ds of the piece, weighted by its duration
        jerk = pace**3 / length * (unit[k + 1] - unit[k])
        rows += [offset, np.sqrt(SMOOTHING_S5 * length / pace) * jerk]
        # The offset of the chord's end is given by the directions of the chords
        wanted += [float(chord_m[: k + 1] @ direction[: k + 1]), 0.0]
    curvature = np.linalg.lstsq(np.array(rows), np.array(wanted), rcond=None)[0]
    return _integrated(np.append(0.0, np.cumsum(chord_m)), curvature)


def _knots(waypoints: Float64[np.ndarray, "T 2"]) -> Int[np.ndarray, "K"]:
    """Return the indices of the waypoints that become knots.

    Each knot lies ahead of the one before. The last waypoint is a knot if possible.
    """
    index: list[int] = []
    point_xy, towards = np.zeros(2), np.array([1.0, 0.0])
    for k, point in enumerate(waypoints):
        offset = point - point_xy
        # Only points far enough and ahead of the last knot
        if np.linalg.norm(offset) >= KNOT_M and offset @ towards > 0:
            index.append(k)
            point_xy, towards = point, offset / np.linalg.norm(offset)
    # The last waypoint replaces the last knot if it lies beyond it
    beyond_m = float((waypoints[-1] - point_xy) @ towards)
    if beyond_m > (0.0 if index else 0.5 * KNOT_M):
        index[max(0, len(index) - 1) :] = [len(waypoints) - 1]
    return np.array(index, dtype=np.int64)


def _integrated(along_m: Float64[np.ndarray, "K"], knot_curvature: Float64[np.ndarray, "K"]) -> Path:
    """Integrate a curvature given at some distances along the path.

    It is linear between them and 0 beyond the last.
    """
    # Curvature at even steps, integrated once to headings and once more to points
    way_m = np.arange(0.0, along_m[-1] + BEYOND_M, SAMPLE_M)
    curvature = np.interp(way_m, along_m, knot_curvature, right=0.0)
    turned = 0.5 * SAMPLE_M * (curvature[1:] + curvature[:-1])
    heading = np.append(0.0, np.cumsum(turned))
    midway = heading[:-1] + 0.5 * turned
    steps = SAMPLE_M * np.stack([np.cos(midway), np.sin(midway)], axis=1)
    return Path(np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), heading, curvature)


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
    # Waypoints that project behind earlier ones count as standing still
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
    # Up to the first invalid step
    count = steps if valid.all() else int(np.argmin(valid))
    xy = trajectory.xy.detach().reshape(-1, steps, 2)[best, :count].cpu().double().numpy()
    if not count or not np.isfinite(xy).all():
        raise InputError(f"a plan needs finite waypoints, got {xy.tolist()}")
    return xy
