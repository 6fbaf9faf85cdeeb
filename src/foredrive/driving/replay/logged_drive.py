"""The ego vehicle's drive in a log, as a route to follow: poses at any time, and the ground along them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from jaxtyping import Float, Float64
from torch import Tensor

from foredrive.driving.dynamics import EGO
from foredrive.errors import InputError
from foredrive.methods.reconstruction.vehicle import LoggedVehicle
from foredrive.scene import BicycleState

SPEED_OVER_S = 0.2
"""Speeds are averaged from this long before to this long after a time, s, because logged poses are noisy."""
SPACING_M = 0.5
"""Distance between points of a route, m."""
BEYOND_M = 100.0
"""Length of the straight line that continues the logged path, m."""
STEERS_FROM_MPS = 1.0
"""Below this speed, m/s, the steering angle cannot be derived from the motion and is set to 0."""


@dataclass(frozen=True, eq=False)
class LoggedDrive:
    """The drive of a reconstructed log's ego vehicle, or of a vehicle at a fixed offset from it.

    Raises:
        InputError: there are fewer than two poses.
    """

    vehicle: LoggedVehicle
    T_ego_shifted: Float[Tensor, "4 4"]
    """The offset, as `Edited.T_ego_shifted`."""

    def __post_init__(self) -> None:
        if len(self.vehicle.t_s) < 2:
            raise InputError("a drive in a log needs at least two ego poses")

    @property
    def first_s(self) -> float:
        """Return the first time of the log, s, on the log's clock."""
        return float(self.vehicle.t_s[0])

    @property
    def end_s(self) -> float:
        """Return the last time of the log, s."""
        return float(self.vehicle.t_s[-1])

    def check_start(self, start_s: float, before_s: float) -> None:
        """Check that the log covers a time before a start, and the start itself.

        Raises:
            InputError: it does not.
        """
        first_s = self.first_s + before_s
        if not first_s - 1e-6 <= start_s < self.end_s:
            raise InputError(
                f"a drive can begin at {first_s:.1f} to {self.end_s:.1f} s of this log, not at {start_s:g} s"
            )

    def pose_at(self, t_s: float) -> Float64[np.ndarray, "4 4"]:
        """Return `T_world_ego` at a time. Before and after the log the motion is extrapolated."""
        T_scene_ego = self.vehicle.at(t_s).shifted(self.T_ego_shifted).T_scene_ego.double()
        T_world_ego: np.ndarray = (self.vehicle.T_world_scene @ T_scene_ego).numpy()
        return T_world_ego

    def state_at(self, t_s: float) -> BicycleState:
        """Return the vehicle's state at a time. Its steering angle follows from its turn rate.

        Its acceleration is the change from the mean speed before to that after, over twice `SPEED_OVER_S`
        each. At the log's ends it is that of the nearest time at which both are known.
        """
        # Speed and turn rate from poses before and after, within the log
        from_s, to_s = max(t_s - SPEED_OVER_S, self.first_s), min(t_s + SPEED_OVER_S, self.end_s)
        before, now, after = (self.pose_at(time_s) for time_s in (from_s, t_s, to_s))
        speed = float(np.hypot(*(after - before)[:2, 3])) / (to_s - from_s)
        turned = np.remainder(_yaw(after) - _yaw(before) + np.pi, 2 * np.pi) - np.pi
        # Curvature is turn per distance; at low speed it is not measurable
        curvature = turned / (to_s - from_s) / speed if speed > STEERS_FROM_MPS else 0.0
        max_rad = EGO.max_steering_rad
        steering = np.clip(np.arctan(EGO.wheelbase_m * curvature), -max_rad, max_rad)
        x_m, y_m = float(now[0, 3]), float(now[1, 3])
        return BicycleState(x_m, y_m, _yaw(now), speed, float(steering), self._acceleration_mps2(t_s))

    def _acceleration_mps2(self, t_s: float) -> float:
        """Return the acceleration at a time; 0 if the log is too short to tell."""
        over_s = 2 * SPEED_OVER_S
        first_s, last_s = self.first_s + over_s, self.end_s - over_s
        if first_s > last_s:
            return 0.0
        # Near the log's ends: the nearest time at which both speeds are known
        middle_s = min(max(t_s, first_s), last_s)
        before, now, after = (
            self.pose_at(time_s)[:2, 3] for time_s in (middle_s - over_s, middle_s, middle_s + over_s)
        )
        return float(np.hypot(*(after - now)) - np.hypot(*(now - before))) / over_s**2

    def route_from(self, t_s: float) -> Float64[np.ndarray, "M 3"]:
        """Return the route from the vehicle's position at a time to the end of the log, m, world frame.

        Raises:
            InputError: the route is shorter than the vehicle.
        """
        if (left_m := self.way_left_m(t_s)) < EGO.length_m:
            raise InputError(f"from {t_s:.1f} s on, the path of the log is only {left_m:.1f} m long")
        return self._way(t_s)

    def way_left_m(self, t_s: float) -> float:
        """Return the distance that the log drives from a time on, m, in the plane."""
        return float(np.hypot(*np.diff(self._way(t_s)[:, :2], axis=0).T).sum())

    def _way(self, t_s: float) -> Float64[np.ndarray, "M 3"]:
        points = [self.pose_at(t_s)[:3, 3]]
        # Points closer than `SPACING_M` are left out
        for point in self.poses[self.vehicle.t_s.numpy() > t_s, :3, 3]:
            if np.hypot(*(point - points[-1])[:2]) >= SPACING_M:
                points.append(point)
        return np.stack(points)

    @cached_property
    def line(self) -> shapely.LineString:
        """Return the logged path in the plane, m, world frame. Behind the log's end it goes straight on."""
        xy, forward = self.poses[:, :2, 3], self.poses[-1, :2, 0]
        # Beyond the end the path goes on in the direction of the last pose
        return shapely.LineString(np.vstack([xy, xy[-1] + BEYOND_M * forward / np.linalg.norm(forward)]))

    def path_ahead(self, T_world_ego: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "N 2"]:
        """Return `line` from beside a vehicle on, in its ego frame, m, at steps of `SPACING_M`."""
        from_m = self.line.project(shapely.Point(T_world_ego[:2, 3]))
        at_m = np.arange(from_m, self.line.length, SPACING_M)
        xy = shapely.get_coordinates(shapely.line_interpolate_point(self.line, at_m))
        forward = T_world_ego[:2, 0] / np.linalg.norm(T_world_ego[:2, 0])
        dx, dy = (xy - T_world_ego[:2, 3]).T
        return np.stack([dx * forward[0] + dy * forward[1], dy * forward[0] - dx * forward[1]], axis=1)

    def on_ground(self, ego: BicycleState) -> Float64[np.ndarray, "4 4"]:
        """Return `T_world_ego` of a vehicle beside the logged path.

        The vehicle stands on the ground plane of the nearest logged pose.
        """
        # The ground is the plane of the nearest logged pose
        away_m = np.hypot(*(self.poses[:, :2, 3] - [ego.x_m, ego.y_m]).T)
        near = self.poses[int(np.argmin(away_m))]
        up = near[:3, 2]
        aside_m = np.array([ego.x_m, ego.y_m]) - near[:2, 3]
        forward = np.array([np.cos(ego.yaw_rad), np.sin(ego.yaw_rad), 0.0])
        # Heading within this plane: perpendicular to its normal
        forward[2] = -(forward[:2] @ up[:2]) / up[2]
        forward /= np.linalg.norm(forward)
        T = np.eye(4)
        T[:3, :3] = np.stack([forward, np.cross(up, forward), up], axis=1)
        # Height of the plane at the vehicle's place
        T[:3, 3] = ego.x_m, ego.y_m, near[2, 3] - (aside_m @ up[:2]) / up[2]
        return T

    @cached_property
    def poses(self) -> Float64[np.ndarray, "K 4 4"]:
        """Return `T_world_ego` at the times of the log's frames."""
        T_scene_ego = (self.vehicle.T_scene_ego @ self.T_ego_shifted).double()
        return np.asarray((self.vehicle.T_world_scene @ T_scene_ego).numpy())


def _yaw(T: Float64[np.ndarray, "4 4"]) -> float:
    return float(np.arctan2(T[1, 0], T[0, 0]))
