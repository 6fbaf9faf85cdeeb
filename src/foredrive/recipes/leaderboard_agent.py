"""The agent file for CARLA's leaderboards and Bench2Drive: `--agent THIS_FILE --agent-config RUN`.

The leaderboard is no package that can be installed; where its code is not on the path, the agent can be made
and asked all the same, but by nobody who scores it.
"""

import importlib
import json
import os
from pathlib import Path
from typing import Any

from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.recipes.config import Recipe
from foredrive.recipes.train import load_agent, open_run
from foredrive.scene import CameraRig
from foredrive.simulation.carla.client import import_carla
from foredrive.simulation.carla.leaderboard import LeaderboardDriver
from foredrive.towns.sensing.rig import camera_rig

SEPARATOR = "+"
"""Bench2Drive appends this and the name of the route to the configuration's path, once for each route."""
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
    """`AutonomousAgent` of a run folder.

    Leaderboard 1.0 calls `setup` while it makes the agent and gives the route afterwards, 2.x and
    Bench2Drive the other way round: the route is taken up at the first step.
    """

    def setup(self, path_to_conf_file: str) -> None:
        """Load the run; the track stays SENSORS, as the base class has it.

        Raises:
            InputError: there is no run, or it has not finished a stage.
        """
        folder, self._route_name = run_folder(path_to_conf_file)
        run = open_run(folder)
        rig = rig_of(run.recipe)
        self._driver = LeaderboardDriver(load_agent(run), rig, run.recipe.clips.past_frames)
        self._make_control = import_carla().VehicleControl
        self._has_route = False
        self._metrics: dict[str, Any] = {}

    def sensors(self) -> list[dict[str, Any]]:
        """The cameras of the recipe; satellites, IMU and speedometer."""
        return self._driver.sensors()

    def run_step(self, input_data: dict[str, tuple[int, Any]], timestamp: float) -> Any:
        """A `carla.VehicleControl` for the step that begins now."""
        if not self._has_route:
            self._driver.set_route(self._global_plan, self._global_plan_world_coord)
            self._has_route = True
        pedals = self._driver.step(input_data, timestamp)
        if hasattr(self, "get_metric_info"):  # Bench2Drive's base class
            self._metrics[str(len(self._metrics))] = self.get_metric_info()
        return self._make_control(**pedals._asdict())

    def destroy(self, results: object = None) -> None:
        """Leave what Bench2Drive computes efficiency and smoothness from, where it is asked for."""
        place = os.environ.get("SAVE_PATH")
        if place and self._route_name and self._metrics:
            path = Path(place) / self._route_name / METRICS
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(path) as temporary:
                temporary.write_text(json.dumps(self._metrics))
        del self._driver  # the next route makes another one
        self._metrics = {}


def run_folder(path_to_conf_file: str) -> tuple[Path, str]:
    """The run folder, and the name of the route that Bench2Drive has appended to it, or ""."""
    whole = Path(path_to_conf_file)
    if whole.is_dir() or SEPARATOR not in path_to_conf_file:
        return whole, ""
    folder, *names = path_to_conf_file.split(SEPARATOR)
    return Path(folder), names[-1]


def rig_of(recipe: Recipe) -> CameraRig:
    """The cameras of the towns at the recipe's resolution, those that it asks for in its order.

    Raises:
        InputError: it asks for a camera that the towns' rig has not.
    """
    rig, wanted = camera_rig(recipe.clips.image_hw), recipe.clips.cameras
    if wanted is None:
        return rig
    index = {name.lower(): i for i, name in enumerate(rig.names)}
    if unknown := [name for name in wanted if name.lower() not in index]:
        raise InputError(f"{recipe.name}: no camera {unknown[0]} in CARLA; there are {', '.join(rig.names)}")
    chosen = [index[name.lower()] for name in wanted]
    return CameraRig(
        K=rig.K[chosen],
        T_ego_cam=rig.T_ego_cam[chosen],
        dist=rig.dist[chosen],
        readout_s=rig.readout_s[chosen],
        names=tuple(rig.names[i] for i in chosen),
        size_hw=rig.size_hw,
    )
