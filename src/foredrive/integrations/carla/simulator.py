"""CARLA as a simulator (`scene.Simulator`), with the steps and events of a town."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float64, UInt8
from torch import Tensor

from foredrive.driving.dynamics import EGO, STEP_S
from foredrive.driving.lane_rules import RuleState
from foredrive.driving.observation import FRAME_STEPS, KeyFrame, no_images
from foredrive.driving.route_progress import RouteLine, RouteProgress, first_step
from foredrive.driving.route_scenario import SETTLE_S, RouteScenario
from foredrive.errors import InputError
from foredrive.integrations.carla import sensors as carla_sensors
from foredrive.integrations.carla.actors import LastCollision, actor_state, collision
from foredrive.integrations.carla.background_traffic import ABOVE_M, add_background_traffic
from foredrive.integrations.carla.client import answering, import_carla
from foredrive.integrations.carla.control import CommandedSpeed, Pedals, actuate, steering_rad_of
from foredrive.integrations.carla.frames import CarlaPose, ego_in_actor, matrix_of, pose_of, xyz_of
from foredrive.integrations.carla.road import CarlaLaneRules
from foredrive.integrations.carla.session import TRAFFIC_PORT, CarlaSession, SensorQueue
from foredrive.scene import BicycleState, Boxes, Clip, Control, DriveProgress, Event, LidarSweep, Step
from foredrive.scene.actors import boxes_in_ego_frame, in_box_range
from foredrive.scene.conditions import Conditions, carla_weather, draw_daylight
from foredrive.sensors import SpinningLidar

OF_CLEAR_AIR = {
    "wind_intensity": 10.0,
    "fog_distance": 0.0,
    "fog_falloff": 0.2,
    "scattering_intensity": 1.0,
    "mie_scattering_scale": 0.03,
    "rayleigh_scattering_scale": 0.0331,
}
"""CARLA's parameters of the weather that no conditions change."""


def weather_of(conditions: Conditions) -> Any:
    """Return similar `carla.WeatherParameters`."""
    return import_carla().WeatherParameters(**carla_weather(conditions), **OF_CLEAR_AIR)


EGO_BLUEPRINT = "vehicle.lincoln.mkz_2020"
"""Vehicle with the dimensions of `dynamics.EGO`."""
HOLD = Pedals(throttle=0.0, brake=1.0, steer=0.0)


@dataclass(frozen=True, eq=False)
class CarlaState:
    """State of a drive at one time, as far as the client knows it. The world itself is on the server."""

    step_index: int
    ego: BicycleState
    T_world_ego: Float64[np.ndarray, "4 4"]
    frames: tuple[KeyFrame, ...] = ()
    commanded: CommandedSpeed = field(default_factory=CommandedSpeed)
    contact: LastCollision = field(default_factory=LastCollision)
    rules: RuleState = field(default_factory=RuleState)
    progress: RouteProgress = field(default_factory=RouteProgress)
    ended: str | None = None
    """Reason why the drive is over. None while it goes on."""

    @property
    def t_s(self) -> float:
        """Return the time since the drive began, s."""
        return self.step_index * STEP_S


class _Ego(NamedTuple):
    """The ego vehicle and its sensors."""

    vehicle: Any
    T_actor_ego: Float64[np.ndarray, "4 4"]
    cameras: Sequence[SensorQueue]
    lidar: SensorQueue | None
    collisions: SensorQueue


class CarlaSimulator:
    """A `Simulator` over a CARLA server. Drives are not repeatable bit by bit, and cannot be saved.

    It is a context manager. At the end, even after errors, the server's actors are destroyed and it returns
    to asynchronous mode. An interrupt between two steps is covered by this, or by the end of the process.

    Args:
        client: a `carla.Client`, see `client.connect`.
        timeout_s: maximum time to wait for sensor data, s.
        traffic_port: port of the traffic manager; each simulator on a machine needs its own.
    """

    state: CarlaState

    def __init__(self, client: Any, timeout_s: float = 20.0, traffic_port: int = TRAFFIC_PORT) -> None:
        self._client, self._timeout_s, self._traffic_port = client, timeout_s, traffic_port
        self._session: CarlaSession | None = None

    def ego(self) -> BicycleState:
        """Return the current state of the ego vehicle."""
        return self.state.ego

    def progress(self) -> DriveProgress:
        """Return the progress of the drive."""
        return self.state.rules.progress(self._route.completion(self.state.progress))

    def reset(self, scenario: RouteScenario) -> Clip:
        """Load the town and start a drive. The vehicle stands until traffic has started to move.

        Raises:
            InputError: the server lacks the town, a blueprint or an answer; there is no room for the vehicle;
                or CARLA has no such cameras as the rig's.
        """
        self.close()
        self._scenario, self._route = scenario, RouteLine(scenario.route_xyz)
        start = _start(scenario.route_xyz)
        self._session = CarlaSession(self._client, scenario.town, scenario.seed, self._traffic_port)
        try:
            with answering("setting the scene"):
                return self._set_scene(self._session, start)
        except BaseException:
            self.close()
            raise

    def step(self, control: Control) -> Step:
        """Drive on for `STEP_S`. The clip is that of the latest key frame.

        Raises:
            InputError: the drive is over, the control is not finite, or the server does not answer.
        """
        if self._session is None or self.state.ended is not None:
            raise InputError("no drive has begun, or it is over: reset the simulator")
        if not math.isfinite(control.acceleration_mps2 + control.steering_rad):
            raise InputError(f"a step needs finite controls, got {control}")
        try:
            with answering("a simulation step"):
                return self._drive(self._session, control)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Restore the server to its original state."""
        if self._session is not None:
            session, self._session = self._session, None
            session.close()

    def __enter__(self) -> "CarlaSimulator":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _set_scene(self, session: CarlaSession, start: CarlaPose) -> Clip:
        scenario, rng = self._scenario, np.random.default_rng(self._scenario.seed)
        self._make_control = import_carla().VehicleControl
        session.world.set_weather(weather_of(scenario.conditions or draw_daylight(rng)))
        session.world.reset_all_traffic_lights()
        self._ego = self._spawn_ego(session, start)
        add_background_traffic(session, scenario.background_traffic, scenario.route_xyz, rng)
        session.tick()  # actors of a new world are listed from the next frame on
        self._road = CarlaLaneRules(session.world)
        before = max(round(SETTLE_S / STEP_S), scenario.past_frames * FRAME_STEPS)
        self.state = CarlaState(-before, BicycleState(0.0, 0.0, 0.0, 0.0), np.eye(4))
        for index in range(-before + 1, 1):
            frame, T, ego = self._advance(session, HOLD)
            self.state = dataclasses.replace(self.state, step_index=index, ego=ego, T_world_ego=T)
            if index % FRAME_STEPS == 0:
                self.state = dataclasses.replace(
                    self.state, frames=self._with_frame(session, self.state, frame)
                )
        self._ego.collisions.all()  # drop contacts from the vehicle's drop onto the road
        self._clip = self._make_clip(self.state)
        return self._clip

    def _spawn_ego(self, session: CarlaSession, start: CarlaPose) -> _Ego:
        vehicle = session.spawn(EGO_BLUEPRINT, start, {"role_name": "hero"})
        if vehicle is None:
            raise InputError(f"there is no room for the ego vehicle in {self._scenario.town} at {start}")
        T_actor_ego = ego_in_actor(vehicle.bounding_box.location.x)
        suite, cameras, lidar = self._scenario.sensors, list[SensorQueue](), None

        def mount(kind: str, name: str, pose: CarlaPose, attributes: dict[str, str]) -> SensorQueue:
            sensor = session.spawn(kind, pose, attributes, attach_to=vehicle)
            if sensor is None:
                raise InputError(f"CARLA cannot mount {name} at {pose}")
            return SensorQueue(sensor, name)

        if suite is not None:
            for spec in carla_sensors.camera_specs(suite.rig, T_actor_ego):
                pose = CarlaPose(*(spec[key] for key in ("x", "y", "z", "roll", "pitch", "yaw")))
                attributes = carla_sensors.camera_attributes(spec)
                cameras.append(mount(carla_sensors.CAMERA, spec["id"], pose, attributes))
            if suite.lidar is not None:
                pose = carla_sensors.lidar_pose(suite.lidar, T_actor_ego)
                attributes = carla_sensors.lidar_attributes(suite.lidar)
                lidar = mount(carla_sensors.LIDAR, "lidar", pose, attributes)
        collisions = mount("sensor.other.collision", "collisions", CarlaPose(0.0, 0.0, 0.0), {})
        return _Ego(vehicle, T_actor_ego, cameras, lidar, collisions)

    def _advance(
        self, session: CarlaSession, pedals: Pedals
    ) -> tuple[int, Float64[np.ndarray, "4 4"], BicycleState]:
        """Run one step with some pedals. Return the frame number and the vehicle's new pose and state."""
        vehicle = self._ego.vehicle
        vehicle.apply_control(self._make_control(**pedals._asdict()))
        frame = session.tick()
        T = matrix_of(vehicle.get_transform()) @ self._ego.T_actor_ego
        speed = max(float(xyz_of(vehicle.get_velocity()) @ T[:3, 0]), 0.0)
        gained = (speed - self.state.ego.speed_mps) / STEP_S
        heading = math.atan2(T[1, 0], T[0, 0])
        steering = steering_rad_of(pedals.steer)
        return frame, T, BicycleState(float(T[0, 3]), float(T[1, 3]), heading, speed, steering, gained)

    def _drive(self, session: CarlaSession, control: Control) -> Step:
        state = self.state
        pedals, commanded = actuate(control, state.ego.speed_mps, state.commanded)
        frame, T, ego = self._advance(session, pedals)
        index = state.step_index + 1
        t_s = index * STEP_S
        events, contact = self._collisions(state, T, t_s)
        more, rules = self._road.check(state.ego, ego, float(T[2, 3]), state.rules, t_s)
        progress = self._route.advance(state.progress, T[:2, 3], ego.speed_mps, t_s)
        ended = self._route.end_of(progress, t_s, self._scenario.limit_s)
        events += more
        if ended is not None:
            events += [*rules.final_events(t_s), self._route.end_event(ended, progress, ego, t_s)]
        state = CarlaState(index, ego, T, state.frames, commanded, contact, rules, progress, ended)
        if index % FRAME_STEPS == 0:
            state = dataclasses.replace(state, frames=self._with_frame(session, state, frame))
            self._clip = self._make_clip(state)
        self.state = state
        return Step(self._clip, events, ended is not None)

    def _collisions(
        self, before: CarlaState, T: Float64[np.ndarray, "4 4"], t_s: float
    ) -> tuple[list[Event], LastCollision]:
        middle = T[:2, 3] + EGO.axle_to_centre_m * T[:2, 0]
        velocity = before.ego.speed_mps * np.array([np.cos(before.ego.yaw_rad), np.sin(before.ego.yaw_rad)])
        events, contact = list[Event](), before.contact
        for event in self._ego.collisions.all():
            infraction, contact = collision(event, middle, velocity, t_s, contact)
            if infraction is not None:
                events.append(infraction)
        return events, contact

    def _with_frame(self, session: CarlaSession, state: CarlaState, frame: int) -> tuple[KeyFrame, ...]:
        """Append the current key frame and return the latest frames, as many as an observation has."""
        suite, images, sweep = self._scenario.sensors, no_images(), None
        if suite is not None:
            images = self._images(frame)
        if suite is not None and suite.lidar is not None and self._ego.lidar is not None:
            sweep = _sweep(self._ego.lidar.at(frame, self._timeout_s), suite.lidar)
        boxes = self._boxes(session, state.T_world_ego)
        now = KeyFrame(state.t_s, state.T_world_ego, state.ego.speed_mps, images, sweep, boxes)
        return (*state.frames, now)[-1 - self._scenario.past_frames :]

    def _images(self, frame: int) -> UInt8[Tensor, "C 3 H W"]:
        sent = [camera.at(frame, self._timeout_s) for camera in self._ego.cameras]
        return torch.stack([carla_sensors.image_of(carla_sensors.bgra_of(image)) for image in sent])

    def _boxes(self, session: CarlaSession, T_world_ego: Float64[np.ndarray, "4 4"]) -> Boxes:
        states = [actor_state(a) for a in session.world.get_actors() if a.id != self._ego.vehicle.id]
        near = in_box_range([actor for actor in states if actor is not None], T_world_ego)
        return boxes_in_ego_frame(near, T_world_ego)

    def _make_clip(self, state: CarlaState) -> Clip:
        suite = self._scenario.sensors
        clip = self._route.observe(state.frames, state.progress, None if suite is None else suite.rig)
        return dataclasses.replace(clip, misses_known=torch.zeros_like(clip.misses_known))


def _sweep(measurement: Any, lidar: SpinningLidar) -> LidarSweep:
    points = np.frombuffer(measurement.raw_data, dtype=np.float32).reshape(-1, 4)
    counts = np.array([measurement.get_point_count(k) for k in range(measurement.channels)])
    return carla_sensors.sweep_of(points, counts, lidar)


def _start(route_xyz: Float64[np.ndarray, "M 3"]) -> CarlaPose:
    """Return the pose of CARLA's actor that puts the rear axle on the route's start, along the route."""
    forward = first_step(route_xyz)
    forward /= np.linalg.norm(forward)
    left = np.array([-forward[1], forward[0], 0.0]) / np.hypot(*forward[:2])
    T = np.eye(4)
    T[:3, :3] = np.stack([forward, left, np.cross(forward, left)], axis=1)
    T[:3, 3] = route_xyz[0] + EGO.axle_to_centre_m * forward
    pose = pose_of(T)
    return pose._replace(z=pose.z + ABOVE_M)
