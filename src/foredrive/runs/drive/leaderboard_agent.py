"""The agent file for CARLA's leaderboards and Bench2Drive: `--agent THIS_FILE --agent-config RUN`.

The leaderboard cannot be installed as a package. Where its code is not on the path, the agent still works,
but nothing scores it.
"""

import importlib
import json
import os
from pathlib import Path
from typing import Any

from foredrive.files import atomic_path
from foredrive.integrations.carla.client import import_carla
from foredrive.integrations.carla.leaderboard import LeaderboardDriver
from foredrive.runs.drive.agent_inputs import inputs_of, rig_of
from foredrive.runs.drive.agents import make_agent
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import roof_lidar

SEPARATOR = "+"
"""The separator that Bench2Drive puts between the configuration and the route name. It adds both again with
each route.
"""
METRICS = "metric_info.json"


def get_entry_point() -> str:
    """Return the name of the agent class, which the leaderboard asks for."""
    return ForedriveAgent.__name__


def _base_class() -> Any:
    try:
        return importlib.import_module("leaderboard.autoagents.autonomous_agent").AutonomousAgent
    except ImportError:
        return object


_AutonomousAgent: Any = _base_class()


class ForedriveAgent(_AutonomousAgent):
    """An `AutonomousAgent` for each agent of `foredrive drive --agent`, mainly for run folders.

    It receives the same inputs as in a town: the same cameras, image size and number of key frames.
    Leaderboard 1.0 calls `setup` in the constructor and gives the route later; 2.x and Bench2Drive use the
    other order. Therefore the agent reads the route at the first step.
    """

    def setup(self, path_to_conf_file: str) -> None:
        """Load the agent; the track stays SENSORS, as in the base class.

        Raises:
            InputError: there is no such agent, or it drives only in towns.
        """
        name, self._route_name = agent_of(path_to_conf_file)
        inputs, self._t_s = inputs_of(name), 0.0
        agent = make_agent(name, lambda: self._t_s)
        rig = camera_rig(plan=rig_of(name)) if inputs.cameras else None
        self._driver = LeaderboardDriver(
            agent, rig, roof_lidar() if inputs.lidar else None, inputs.past_frames
        )
        self._make_control = import_carla().VehicleControl
        self._has_route = False
        self._metrics: dict[str, Any] = {}

    def sensors(self) -> list[dict[str, Any]]:
        """Return the sensors: the cameras and lidar that the agent requires, GNSS, IMU and speedometer."""
        return self._driver.sensors()

    def run_step(self, input_data: dict[str, tuple[int, Any]], timestamp: float) -> Any:
        """Return a `carla.VehicleControl` for the step that begins now."""
        if not self._has_route:
            self._driver.set_route(self._global_plan, self._global_plan_world_coord)
            self._has_route = True
        self._t_s = timestamp
        pedals = self._driver.step(input_data, timestamp)
        if hasattr(self, "get_metric_info"):  # Bench2Drive's base class
            self._metrics[str(len(self._metrics))] = self.get_metric_info()
        return self._make_control(**pedals._asdict())

    def destroy(self, results: object = None) -> None:
        """Write the file from which Bench2Drive computes efficiency and smoothness, if SAVE_PATH is set."""
        metrics, self._metrics = getattr(self, "_metrics", {}), {}
        place = os.environ.get("SAVE_PATH")
        if place and metrics and self._route_name:
            path = Path(place) / self._route_name / METRICS
            with atomic_path(path) as temporary:
                temporary.write_text(json.dumps(metrics))


def agent_of(path_to_conf_file: str) -> tuple[str, str]:
    """Return the name of the agent, and the route name that Bench2Drive appended to it, or ""."""
    if SEPARATOR not in path_to_conf_file or Path(path_to_conf_file).is_dir():
        return path_to_conf_file, ""
    agent, *names = path_to_conf_file.split(SEPARATOR)
    return agent, names[-1]
