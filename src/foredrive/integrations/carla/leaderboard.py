"""A Foredrive agent with the interface of CARLA's leaderboards 1.0, 2.0 and 2.1 and of Bench2Drive's fork.

The data of `run_step` becomes a `Clip` twice a second. Foredrive's controller follows the agent's plan at 20
Hz. Only inputs of the track SENSORS are used: cameras, lidar, satellite navigation, IMU, speedometer and the
route.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

from foredrive.data.batches import stack_records
from foredrive.errors import InputError
from foredrive.scene import Agent, BicycleState, CameraRig, Clip
from foredrive.scene.actors import boxes_in_ego_frame
from foredrive.sensors import SpinningLidar
from foredrive.simulation.carla.control import CommandedSpeed, Pedals, actuate, steering_rad_of
from foredrive.simulation.carla.frames import ego_in_actor, pose_of, yaw_of_compass
from foredrive.simulation.carla.global_plan import GlobalPlan
from foredrive.simulation.carla.localization import (
    GeoFrame,
    PoseEstimate,
    fit_geo_frame,
    lat_lon_of,
    locate,
)
from foredrive.simulation.carla.sensors import camera_specs, image_of, lidar_spec, mounting, sweep_of
from foredrive.simulation.controller import ControllerState, follow
from foredrive.simulation.dynamics import STEP_S
from foredrive.simulation.observation import FRAME_DT_S, KeyFrame, no_images
from foredrive.simulation.plans import fixed_in_world
from foredrive.simulation.route_progress import RouteProgress

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

    def _see(self, input_data: Mapping[str, tuple[int, Any]], at: PoseEstimate, speed_mps: float) -> None:
        images = no_images()
        if self._rig is not None:
            images = torch.stack([_image(self._rig, name, input_data[name][1]) for name in self._rig.names])
        sweep = None
        if self._lidar is not None:
            points = np.concatenate(self._points)
            sweep = sweep_of(points, np.array([len(points)]), self._lidar)
        T = at.T_world_ego
        frame = KeyFrame(at.t_s, T, speed_mps, images, sweep, boxes_in_ego_frame([], T))
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
