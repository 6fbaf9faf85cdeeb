"""A Foredrive agent with the interface of CARLA's leaderboards 1.0, 2.0 and 2.1 and of Bench2Drive's fork.

The data of `run_step` becomes a `Clip` twice a second. Foredrive's controller follows the agent's plan at 20
Hz. Only inputs of the track SENSORS are used: cameras, lidar, satellite navigation, IMU, speedometer and the
route.

The vehicle is localized by satellite navigation, compass and speedometer, which the leaderboard allows. No
map is needed to read the satellite positions. The route is given both in world coordinates and in latitude
and longitude, related by a Mercator projection of unknown scale and origin. CARLA 0.9.15 projects its
satellites as the leaderboard does its routes. CARLA 0.9.16 uses a transverse Mercator projection about the
same origin, with north and south exchanged. A reading may therefore mean two places, and the one nearer to
the expected position is taken.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64, UInt8
from torch import Tensor

from foredrive.data.batches import stack_records
from foredrive.data.commands import LOOKAHEAD_M
from foredrive.driving.controller import ControllerState, follow
from foredrive.driving.dynamics import STEP_S
from foredrive.driving.observation import FRAME_DT_S, KeyFrame, no_images
from foredrive.driving.plans import fixed_in_world
from foredrive.driving.route_progress import RouteLine, RouteProgress
from foredrive.errors import InputError
from foredrive.geometry.polylines import arc_lengths
from foredrive.integrations.carla.control import CommandedSpeed, Pedals, actuate, steering_rad_of
from foredrive.integrations.carla.frames import ego_in_actor, pose_of, xyz_of, yaw_of_compass
from foredrive.integrations.carla.sensors import camera_specs, image_of, lidar_spec, mounting, sweep_of
from foredrive.scene import Agent, BicycleState, CameraRig, Clip, Command
from foredrive.scene.actors import boxes_in_ego_frame
from foredrive.sensors import SpinningLidar

GAIN = 0.02
"""Share of the difference between satellites and dead reckoning that is corrected in one step of 0.05 s.
It balances satellites with an error of 0.56 m (the leaderboard's 5e-6 degrees) and dead reckoning with an
error of 1 cm per step."""
RADIUS_M = 0.9996 * 6378137.0
"""Radius of the sphere that CARLA 0.9.16 projects, with the scale along its meridian."""
SPREAD_M = 1.0
"""A shorter route, m, does not determine the scale."""


@dataclass(frozen=True)
class GeoFrame:
    """Map from latitude φ and longitude λ to our world: x = a·λ + b, y = a·ln tan(45° + φ/2) + c.

    Latitude and longitude are given in degrees; the formula takes radians.
    """

    scale_m: float
    x_m: float
    y_m: float

    def xy(
        self, lat_deg: float, lon_deg: float, near_xy: Float64[np.ndarray, "2"]
    ) -> Float64[np.ndarray, "2"]:
        """Return the place in our world, m, by CARLA 0.9.15 or 0.9.16, whichever is nearer to `near_xy`."""
        east, north = _mercator(lat_deg, lon_deg)
        xy = np.array([self.scale_m * east + self.x_m, self.scale_m * north + self.y_m])
        transverse = self._transverse(lat_deg, lon_deg)
        is_nearer = np.hypot(*(transverse - near_xy)) < np.hypot(*(xy - near_xy))
        return transverse if is_nearer else xy

    def _transverse(self, lat_deg: float, lon_deg: float) -> Float64[np.ndarray, "2"]:
        """Return the place by CARLA 0.9.16: a spherical transverse Mercator projection (Snyder, 1987, §8)."""
        # The origin of the world is where both coordinates of the route's projection are 0
        lat_0 = 2 * math.atan(math.exp(-self.y_m / self.scale_m)) - 0.5 * math.pi
        lat, aside = math.radians(lat_deg), math.radians(lon_deg) + self.x_m / self.scale_m
        east = math.atanh(math.cos(lat) * math.sin(aside))
        north = math.atan2(math.tan(lat), math.cos(aside)) - lat_0
        # CARLA's y, which points to the right of x, counts as north
        return RADIUS_M * np.array([east, -north])


def fit_geo_frame(lat_lon_deg: Float64[np.ndarray, "N 2"], xy: Float64[np.ndarray, "N 2"]) -> GeoFrame:
    """Fit the frame to points that are known in both coordinate systems, by least squares.

    Raises:
        InputError: the points are at one place.
    """
    unit = np.array([_mercator(lat, lon) for lat, lon in lat_lon_deg.tolist()]).reshape(-1, 2)
    about = unit - unit.mean(axis=0), xy - xy.mean(axis=0)
    if np.linalg.norm(np.ptp(xy, axis=0)) < SPREAD_M:
        raise InputError(
            "the route's points coincide, so they cannot relate latitude and longitude to metres"
        )
    scale_m = float((about[0] * about[1]).sum() / (about[0] ** 2).sum())
    origin = xy.mean(axis=0) - scale_m * unit.mean(axis=0)
    return GeoFrame(scale_m, float(origin[0]), float(origin[1]))


@dataclass(frozen=True)
class PoseEstimate:
    """Estimated pose of the rear axle in our world."""

    x_m: float
    y_m: float
    yaw_rad: float
    t_s: float
    steps: int = 1
    """Number of measurements in the estimate."""

    @property
    def T_world_ego(self) -> Float64[np.ndarray, "4 4"]:
        """Return the pose on flat ground: satellite heights are no better than half a metre."""
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        T = np.eye(4)
        T[:2, :2] = [[cos, -sin], [sin, cos]]
        T[:2, 3] = self.x_m, self.y_m
        return T


def locate(
    before: PoseEstimate | None,
    satellites_xy: Float64[np.ndarray, "2"],
    yaw_rad: float,
    speed_mps: float,
    t_s: float,
) -> PoseEstimate:
    """Return the estimate one step later: dead reckoning, corrected towards the satellites.

    Args:
        yaw_rad: heading by the compass. If it is not finite, as CARLA's is at times, the last heading is
            kept.
    """
    if before is None:
        x, y = satellites_xy.tolist()
        return PoseEstimate(x, y, yaw_rad if math.isfinite(yaw_rad) else 0.0, t_s)
    yaw_rad = yaw_rad if math.isfinite(yaw_rad) else before.yaw_rad
    way_m = speed_mps * (t_s - before.t_s)
    along = before.yaw_rad + 0.5 * math.remainder(yaw_rad - before.yaw_rad, 2 * math.pi)
    gone = np.array([before.x_m, before.y_m]) + way_m * np.array([math.cos(along), math.sin(along)])
    steps = before.steps + 1
    x, y = gone + max(GAIN, 1 / steps) * (satellites_xy - gone)
    return dataclasses.replace(before, x_m=float(x), y_m=float(y), yaw_rad=yaw_rad, t_s=t_s, steps=steps)


def lat_lon_of(plan: Sequence[tuple[dict[str, float], object]]) -> Float64[np.ndarray, "N 2"]:
    """Return latitudes and longitudes of the leaderboard's route, degrees."""
    return np.array([(point["lat"], point["lon"]) for point, _ in plan], dtype=float).reshape(-1, 2)


def _mercator(lat_deg: float, lon_deg: float) -> tuple[float, float]:
    return math.radians(lon_deg), math.log(math.tan(0.25 * math.pi + 0.5 * math.radians(lat_deg)))


COMMAND_OF_OPTION = {
    "LEFT": Command.LEFT,
    "RIGHT": Command.RIGHT,
    "CHANGELANELEFT": Command.LEFT,
    "CHANGELANERIGHT": Command.RIGHT,
}
"""By the names of CARLA's `RoadOption`. All others (STRAIGHT, LANEFOLLOW, VOID) mean straight on."""


class GlobalPlan(RouteLine):
    """A route of N points, up to 50 or 200 m apart, with a smooth line through them along their lanes.

    Args:
        plan: a `carla.Transform` and a `RoadOption` for each point, as `set_global_plan` keeps them. An
            option holds from its point to the next.

    Raises:
        InputError: there are fewer than two points, or the route has no length.
    """

    def __init__(self, plan: Sequence[tuple[Any, Any]]) -> None:
        self.xy: Float64[np.ndarray, "N 2"] = np.array(
            [xyz_of(transform.location)[:2] for transform, _ in plan], dtype=float
        ).reshape(-1, 2)
        if len(plan) < 2 or not arc_lengths(self.xy)[-1] > 0:
            raise InputError(f"a route needs at least two different points, got {len(plan)} points")
        self._commands = [COMMAND_OF_OPTION.get(option.name, Command.STRAIGHT) for _, option in plan]
        yaw_rad = -np.radians([transform.rotation.yaw for transform, _ in plan])  # CARLA is left-handed
        line, knots = _smooth_line(self.xy, yaw_rad)
        self._point_arc_m = arc_lengths(line)[knots]
        super().__init__(np.column_stack([line, np.zeros(len(line))]))

    def command(self, progress: RouteProgress) -> Command:
        """Return the first turn or lane change that is under way or begins within `LOOKAHEAD_M`.

        In training (`data.commands`) commands change at about the same place. The difference is bends outside
        of junctions, which the few points do not show.
        """
        first = int(np.searchsorted(self._point_arc_m, progress.done_m, side="right")) - 1
        last = int(np.searchsorted(self._point_arc_m, progress.done_m + LOOKAHEAD_M))
        soon = self._commands[max(first, 0) : max(last, 1)]
        return next((command for command in soon if command is not Command.STRAIGHT), Command.STRAIGHT)


def _smooth_line(
    xy: Float64[np.ndarray, "N 2"], yaw_rad: Float64[np.ndarray, "N"]
) -> tuple[Float64[np.ndarray, "M 2"], Int64[np.ndarray, "N"]]:
    """Return a smooth line through points in the directions of their lanes, and the points' indices in it.

    Straight lines between the points would leave the lane in bends and cut the corners of turns.
    """
    length_m = np.hypot(*np.diff(xy, axis=0).T)
    heading = np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], axis=1)
    # A cubic of each segment, at points about a metre apart; tangents of this length make it almost an arc
    cos_half = np.sqrt(np.clip(0.5 + 0.5 * (heading[:-1] * heading[1:]).sum(axis=1), 0.0, 1.0))
    parts, knots = [xy[:1]], [0]
    for k, metres in enumerate(length_m.tolist()):
        tangent_m = metres / (0.5 + 0.5 * cos_half[k])
        t = np.linspace(0.0, 1.0, max(int(np.ceil(metres)), 1) + 1)[1:, None]
        parts.append(
            (1 + 2 * t) * (1 - t) ** 2 * xy[k]
            + t**2 * (3 - 2 * t) * xy[k + 1]
            + tangent_m * (t * (1 - t) ** 2 * heading[k] - t**2 * (1 - t) * heading[k + 1])
        )
        knots.append(knots[-1] + len(t))
    return np.concatenate(parts), np.array(knots)


GPS, IMU, SPEED, LIDAR = "GPS", "IMU", "SPEED", "LIDAR"
COMPASS_AT = 6
"""Index of the compass in the IMU's data, after three accelerations and three turn rates."""


LIDAR_STEPS = 2
"""Number of steps per revolution: the leaderboards' lidar turns at 10 Hz."""


class LeaderboardDriver:
    """Drives one route.

    Args:
        agent: agent that drives; it observes batches of one clip.
        rig: cameras of the agent, without leading dimensions. None for an agent without cameras. Leaderboard
            1.0 allows four, 2.x and Bench2Drive eight.
        lidar: lidar whose mounting is used; the leaderboards define its other properties. None without lidar.
        past_frames: number of key frames before now that the agent observes. The vehicle stands until they
            exist.

    Raises:
        InputError: CARLA has no such cameras.
    """

    def __init__(
        self, agent: Agent, rig: CameraRig | None, lidar: SpinningLidar | None, past_frames: int
    ) -> None:
        T_actor_ego = ego_in_actor()
        self._agent, self._rig, self._lidar, self._past_frames = agent, rig, lidar, past_frames
        axle = mounting(pose_of(T_actor_ego))
        self._sensors = [
            *([] if rig is None else camera_specs(rig, T_actor_ego)),
            *([] if lidar is None else [lidar_spec(lidar, LIDAR, T_actor_ego)]),
            {"type": "sensor.other.gnss", "id": GPS} | axle,
            {"type": "sensor.other.imu", "id": IMU} | axle,
            {"type": "sensor.speedometer", "id": SPEED},
        ]
        self._plan: GlobalPlan | None = None
        self._frames: tuple[KeyFrame, ...] = ()
        self._points: tuple[Float32[np.ndarray, "_ 4"], ...] = ()
        self._where: PoseEstimate | None = None
        self._following, self._asked, self._progress = ControllerState(), CommandedSpeed(), RouteProgress()
        self._steer = 0.0
        self._next_frame_s = 0.0

    def sensors(self) -> list[dict[str, Any]]:
        """Return the sensors that the leaderboard is to mount."""
        return [dict(sensor) for sensor in self._sensors]

    def set_route(
        self, plan_gps: Sequence[tuple[dict[str, float], Any]], plan_world: Sequence[tuple[Any, Any]]
    ) -> None:
        """Set the route, as the base class keeps it in `_global_plan` and `_global_plan_world_coord`.

        Raises:
            InputError: the route has no length, or the two plans do not match.
        """
        if len(plan_gps) != len(plan_world):
            raise InputError(
                f"the route has {len(plan_world)} points in metres, but {len(plan_gps)} in degrees"
            )
        self._plan = GlobalPlan(plan_world)
        self._geo: GeoFrame = fit_geo_frame(lat_lon_of(plan_gps), self._plan.xy)

    def step(self, input_data: Mapping[str, tuple[int, Any]], t_s: float) -> Pedals:
        """Return the pedals for the step that begins now.

        Args:
            input_data: frame number and data of each sensor.

        Raises:
            InputError: there is no route, or a sensor has sent nothing.
        """
        if self._plan is None:
            raise InputError("the leaderboard has not set a route")
        if missing := sorted({sensor["id"] for sensor in self._sensors} - set(input_data)):
            raise InputError(f"sensors without data: {', '.join(missing)}")
        lat, lon, _ = (float(value) for value in input_data[GPS][1])
        speed_mps = max(float(input_data[SPEED][1]["speed"]), 0.0)
        yaw_rad = yaw_of_compass(float(input_data[IMU][1][COMPASS_AT]))
        last = self._where
        near = self._plan.xy[0] if last is None else np.array([last.x_m, last.y_m])
        self._where = locate(last, self._geo.xy(lat, lon, near), yaw_rad, speed_mps, t_s)
        here = np.array([self._where.x_m, self._where.y_m])
        self._progress = self._plan.advance(self._progress, here, speed_mps, t_s)
        where, steering_rad = self._where, steering_rad_of(self._steer)
        ego = BicycleState(where.x_m, where.y_m, where.yaw_rad, speed_mps, steering_rad)
        if self._lidar is not None:
            self._points = (*self._points, input_data[LIDAR][1])[-LIDAR_STEPS:]
        if t_s > self._next_frame_s - 0.5 * STEP_S:
            self._next_frame_s = t_s + FRAME_DT_S
            self._see(input_data, self._where, speed_mps)
            if len(self._frames) > self._past_frames:
                plan = fixed_in_world(self._agent.act(stack_records([self._clip()])), ego, t_s)
                self._following = self._following.expecting(plan, t_s)
        control, self._following = follow(self._following, ego, t_s)
        pedals, self._asked = actuate(control, speed_mps, self._asked)
        self._steer = pedals.steer
        return pedals

    def _see(self, input_data: Mapping[str, tuple[int, Any]], pose: PoseEstimate, speed_mps: float) -> None:
        images = no_images()
        if self._rig is not None:
            images = torch.stack([_image(self._rig, name, input_data[name][1]) for name in self._rig.names])
        sweep = None
        if self._lidar is not None:
            points = np.concatenate(self._points)
            sweep = sweep_of(points, np.array([len(points)]), self._lidar)
        T = pose.T_world_ego
        frame = KeyFrame(pose.t_s, T, speed_mps, images, sweep, boxes_in_ego_frame([], T))
        self._frames = (*self._frames, frame)[-1 - self._past_frames :]

    def _clip(self) -> Clip:
        assert self._plan is not None
        clip = self._plan.observe(self._frames, self._progress, self._rig)
        unknown = torch.zeros_like(clip.boxes_valid)
        return dataclasses.replace(clip, boxes_valid=unknown, misses_known=unknown)


def _image(rig: CameraRig, name: str, sent: UInt8[np.ndarray, "H W 4"]) -> UInt8[Tensor, "3 H W"]:
    if sent.shape[:2] != rig.size_hw:
        raise InputError(f"camera {name} sent {sent.shape[:2]} pixels instead of {rig.size_hw}")
    return image_of(sent)
