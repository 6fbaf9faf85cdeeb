"""Drives in towns through the interface of CARLA's leaderboards: a stand-in for the server.

The agent gets what the leaderboard hands over: images, satellites with noise, compass, speedometer, and a
sparse route. Its pedals move the town's vehicle by the model that `integrations.carla.control` assumes. This
measures localization, sparse routes and control by pedals, and not how well that model fits CARLA's vehicle.
"""

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from foredrive.driving.simple_agents import StraightAgent
from foredrive.integrations.carla.control import (
    COASTING_MPS2,
    COASTING_PER_M,
    FULL_BRAKE_MPS2,
    FULL_THROTTLE_MPS2,
    STANDING_MPS,
    Pedals,
    steering_rad_of,
)
from foredrive.integrations.carla.leaderboard import GPS, IMU, SPEED, LeaderboardDriver
from foredrive.runs.drive.agent_inputs import inputs_of
from foredrive.runs.drive.drive_setup import DriveSetup
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.suite import DriveJob, DriveSuite
from foredrive.scene import BicycleState, Control, Step, Trajectory
from foredrive.sensors.rigs import camera_rig
from foredrive.towns.driving.routes import DriveRoute, RouteOption
from foredrive.towns.driving.town import TownSimulator

SPARSE_M = 50.0
"""Greatest distance between points of the route in leaderboard 1.0, m."""
GNSS_NOISE_DEG = 5e-6
EARTH_M = 6_378_137.0
OPTION_NAMES = {
    RouteOption.LEFT: "LEFT",
    RouteOption.RIGHT: "RIGHT",
    RouteOption.STRAIGHT: "STRAIGHT",
    RouteOption.FOLLOW: "LANEFOLLOW",
    RouteOption.CHANGE_LEFT: "CHANGELANELEFT",
    RouteOption.CHANGE_RIGHT: "CHANGELANERIGHT",
}
CHANGES = (RouteOption.CHANGE_LEFT, RouteOption.CHANGE_RIGHT)


@dataclasses.dataclass(frozen=True)
class LeaderboardDoor(TownRoutes):
    """Routes in towns, driven through the leaderboard's interface."""

    def noted(self) -> Mapping[str, object]:
        return {**super().noted(), "door": "leaderboard"}

    @contextlib.contextmanager
    def set_up(self, job: DriveJob, suite: DriveSuite, out: Path) -> Iterator[DriveSetup]:
        with super().set_up(job, suite, out) as setup:
            inputs = inputs_of(suite.agent)
            rig = camera_rig(plan=self.rig) if inputs.cameras else None
            driver = LeaderboardDriver(setup.agent, rig, None, inputs.past_frames)
            driver.set_route(*sparse_plans(self.route_of(job)))
            assert isinstance(setup.simulator, TownSimulator)
            pilot = PedalPilot(setup.simulator, driver, seed=self.seed + job.repetition)
            # The suite's own plans are not followed: those of the driver are, which it makes from its sensors
            yield dataclasses.replace(setup, agent=StraightAgent(0.0), pilot=pilot)


class PedalPilot:
    """A `Pilot` that hands the leaderboard's sensors to a driver, and its pedals to the town's vehicle.

    Args:
        simulator: the town, which renders the cameras at key frames.
        driver: has its route.
        seed: of the satellites' noise.
    """

    def __init__(self, simulator: TownSimulator, driver: LeaderboardDriver, seed: int) -> None:
        self._simulator, self._driver = simulator, driver
        self._rng, self._steps = np.random.default_rng(seed), 0

    def expect(self, trajectory: Trajectory, ego: BicycleState, t_s: float) -> None:
        """Ignore the plan of the suite."""

    def step(self, ego: BicycleState, t_s: float) -> Step:
        """Move on by one step along the driver's own plan."""
        pedals = self._driver.step(self._sensed(ego), t_s)
        return self._simulator.step(control_of(pedals, ego.speed_mps))

    def _sensed(self, ego: BicycleState) -> dict[str, tuple[int, Any]]:
        lat_lon = lat_lon_of(ego.x_m, ego.y_m) + self._rng.normal(0.0, GNSS_NOISE_DEG, 2)
        data: dict[str, Any] = {
            GPS: np.array([*lat_lon, 0.0]),
            IMU: np.array([0.0, 0.0, 9.81, 0.0, 0.0, 0.0, 0.5 * math.pi - ego.yaw_rad]),
            SPEED: {"speed": ego.speed_mps},
        }
        cameras = [spec["id"] for spec in self._driver.sensors() if spec["type"] == "sensor.camera.rgb"]
        for name, image in zip(cameras, self._simulator.state.frames[-1].images, strict=True):
            rgb = image.permute(1, 2, 0).numpy()
            data[name] = np.concatenate([rgb[..., ::-1], np.zeros_like(rgb[..., :1])], axis=-1)  # BGRA
        self._steps += 1
        return {name: (self._steps, value) for name, value in data.items()}


def control_of(pedals: Pedals, speed_mps: float) -> Control:
    """Return what a vehicle does with these pedals."""
    force = FULL_THROTTLE_MPS2 * pedals.throttle - FULL_BRAKE_MPS2 * pedals.brake
    resists = speed_mps > STANDING_MPS
    coasting = COASTING_MPS2 + COASTING_PER_M * speed_mps**2 if resists else 0.0
    return Control(force - coasting, steering_rad_of(pedals.steer))


def sparse_plans(route: DriveRoute) -> tuple[list[tuple[dict[str, float], Any]], list[tuple[Any, Any]]]:
    """Return a route by satellite and in CARLA's world, with the points that leaderboard 1.0 keeps."""
    kept, since_m = [0], 0.0
    for k in range(1, len(route.xyz)):
        since_m += float(route.arc_m[k] - route.arc_m[k - 1])
        option, before = RouteOption(route.option[k]), RouteOption(route.option[k - 1])
        is_new = option in CHANGES or (option is not before and before not in CHANGES)
        if is_new or since_m > SPARSE_M or k == len(route.xyz) - 1:
            kept.append(k)
            since_m = 0.0
    by_satellite, in_world = [], []
    steps = np.diff(route.xyz[:, :2], axis=0, append=2 * route.xyz[-1:, :2] - route.xyz[-2:-1, :2])
    yaw_deg = np.degrees(np.arctan2(steps[:, 1], steps[:, 0]))
    for k in kept:
        x, y, z = (float(value) for value in route.xyz[k])
        road_option = SimpleNamespace(name=OPTION_NAMES[RouteOption(route.option[k])])
        lat, lon = lat_lon_of(x, y).tolist()
        by_satellite.append(({"lat": lat, "lon": lon, "z": z}, road_option))
        location, rotation = SimpleNamespace(x=x, y=-y, z=z), SimpleNamespace(yaw=-float(yaw_deg[k]))
        in_world.append((SimpleNamespace(location=location, rotation=rotation), road_option))
    return by_satellite, in_world


def lat_lon_of(x_m: float, y_m: float) -> np.ndarray:
    """Return latitude and longitude of a place near the equator, degrees, by Mercator's projection."""
    lat = 2.0 * math.atan(math.exp(y_m / EARTH_M)) - 0.5 * math.pi
    return np.degrees([lat, x_m / EARTH_M])
