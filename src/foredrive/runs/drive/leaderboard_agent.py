"""The agent file for CARLA's leaderboards and Bench2Drive: `--agent THIS_FILE --agent-config RUN`.

The leaderboard is no package that can be installed; where its code is not on the path, the agent can be made
and asked all the same, but by nobody who scores it.
"""

import importlib
import json
import os
from pathlib import Path
from typing import Any

from foredrive.files import atomic_path
from foredrive.runs.drive.agents import make_driver, needs_of
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.simulation.carla.client import import_carla
from foredrive.simulation.carla.leaderboard import LeaderboardDriver
from foredrive.towns.sensing.rig import camera_rig, roof_lidar

SEPARATOR = "+"
"""Bench2Drive appends this and the name of the route to the configuration, once more with each route."""
METRICS = "metric_info.json"


def get_entry_point() -> str:
    """The class that the leaderboard is to make an agent of."""
    return ForedriveAgent.__name__


def _base_class() -> Any:
    try:
        return importlib.import_module("leaderboard.autoagents.autonomous_agent").AutonomousAgent
    except ImportError:
        return object


_AutonomousAgent: Any = _base_class()


class ForedriveAgent(_AutonomousAgent):
    """`AutonomousAgent` of a driver by the names of `foredrive drive --agent`, a run folder above all.

    It sees what it would see in a town: the same cameras, images of the same size, as many key frames.
    Leaderboard 1.0 calls `setup` while it makes the agent and gives the route afterwards, 2.x and Bench2Drive
    the other way round: the route is taken up at the first step.
    """

    def setup(self, path_to_conf_file: str) -> None:
        """Load the driver; the track stays SENSORS, as the base class has it.

        Raises:
            InputError: there is no such driver, or it drives in towns alone.
        """
        driver, self._route_name = driver_of(path_to_conf_file)
        needs, self._t_s = needs_of(driver), 0.0
        agent = make_driver(driver, lambda: self._t_s)
        rig = camera_rig(TownRoutes.image_hw) if needs.cameras else None
        self._driver = LeaderboardDriver(agent, rig, roof_lidar() if needs.lidar else None, needs.past_frames)
        self._make_control = import_carla().VehicleControl
        self._has_route = False
        self._metrics: dict[str, Any] = {}

    def sensors(self) -> list[dict[str, Any]]:
        """The cameras and the lidar, if it needs them; satellites, IMU and speedometer."""
        return self._driver.sensors()

    def run_step(self, input_data: dict[str, tuple[int, Any]], timestamp: float) -> Any:
        """A `carla.VehicleControl` for the step that begins now."""
        if not self._has_route:
            self._driver.set_route(self._global_plan, self._global_plan_world_coord)
            self._has_route = True
        self._t_s = timestamp
        pedals = self._driver.step(input_data, timestamp)
        if hasattr(self, "get_metric_info"):  # Bench2Drive's base class
            self._metrics[str(len(self._metrics))] = self.get_metric_info()
        return self._make_control(**pedals._asdict())

    def destroy(self, results: object = None) -> None:
        """Leave what Bench2Drive computes efficiency and smoothness from, where SAVE_PATH asks for it."""
        metrics, self._metrics = getattr(self, "_metrics", {}), {}
        place = os.environ.get("SAVE_PATH")
        if place and metrics and self._route_name:
            path = Path(place) / self._route_name / METRICS
            with atomic_path(path) as temporary:
                temporary.write_text(json.dumps(metrics))


def driver_of(path_to_conf_file: str) -> tuple[str, str]:
    """The driver that is meant, and the name of the route that Bench2Drive has appended to it, or ""."""
    if SEPARATOR not in path_to_conf_file or Path(path_to_conf_file).is_dir():
        return path_to_conf_file, ""
    driver, *names = path_to_conf_file.split(SEPARATOR)
    return driver, names[-1]
