"""The agent file as CARLA's leaderboards load it, with an untrained run."""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from miniature import miniature

import foredrive.runs.drive.leaderboard_agent as agent_file
from foredrive.engine.checkpoints import save_weights
from foredrive.engine.config import save_recipe
from foredrive.errors import InputError
from foredrive.runs.build import build_agent
from foredrive.runs.drive.leaderboard_agent import agent_of


class AutonomousAgent:
    """What Bench2Drive's base class does as the evaluator sees it."""

    def __init__(self, host: str, port: int, debug: bool = False) -> None:
        self.track = "SENSORS"
        self._global_plan: Any = None
        self._global_plan_world_coord: Any = None

    def set_global_plan(self, by_satellite: list[Any], in_world: list[Any]) -> None:
        self._global_plan, self._global_plan_world_coord = by_satellite, in_world

    def get_metric_info(self) -> dict[str, list[float]]:
        return {"location": [1.0, 2.0, 3.0]}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "untrained"
    (folder / "finetune").mkdir(parents=True)
    save_recipe(miniature(), folder / "config.yaml")
    (folder / "logs.json").write_text(json.dumps({"logs": [], "cache_dir": str(folder / "cache")}))
    save_weights(build_agent(miniature()), folder / "finetune" / "model.safetensors")
    return folder


OWN = """
class Planner:
    needs = {"cameras": ["PCAM_F0"], "image_hw": [48, 80], "lidar": True, "past_frames": 1}

    def act(self, clip):
        assert clip.images.shape[-2:] == (48, 80) and len(clip.rig.names) == 1
        # A wall 30 m ahead of the lidar: the plan ends well before it
        points = clip.sweeps[clip.now].points_ego[clip.sweeps.valid[clip.now]]
        assert 28 < float(points[:, 0].median()) < 32
        return [[2.0 * k, 0.0] for k in range(1, 7)]
"""


@pytest.fixture
def loaded(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The file, loaded by its path where the leaderboard's code is there."""
    home = ModuleType("leaderboard.autoagents.autonomous_agent")
    home.AutonomousAgent = AutonomousAgent  # type: ignore[attr-defined]
    for name in ("leaderboard", "leaderboard.autoagents"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setitem(sys.modules, home.__name__, home)
    spec = importlib.util.spec_from_file_location("leaderboard_agent", agent_file.__file__)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_bench2drive_gets_controls_and_what_it_measures_by(
    run: Path, loaded: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    carla = pytest.importorskip("carla")
    monkeypatch.setenv("SAVE_PATH", str(tmp_path))
    agent = getattr(loaded, loaded.get_entry_point())("localhost", 2000, False)
    assert isinstance(agent, AutonomousAgent)
    straight = SimpleNamespace(name="LANEFOLLOW")
    places = [carla.Transform(carla.Location(x, 0, 0)) for x in (0.0, 40.0)]
    by_satellite = [({"lat": 0.0, "lon": x / 111_319.49, "z": 0.0}, straight) for x in (0.0, 40.0)]
    agent.set_global_plan(by_satellite, [(place, straight) for place in places])
    agent.setup(f"{run}+Route1_rep0_Town02+Route2_rep0_Town02")
    data = {s["id"]: (1, np.zeros((144, 256, 4), dtype=np.uint8)) for s in agent.sensors() if "width" in s}
    data |= {
        "GPS": (1, np.zeros(3)),
        "IMU": (1, np.array([0, 0, 9.8, 0, 0, 0, 1.57])),
        "SPEED": (1, {"speed": 0.0}),
    }
    assert data.keys() == {sensor["id"] for sensor in agent.sensors()}
    controls = [agent.run_step(data, 0.05 * k) for k in range(12)]
    assert all(isinstance(control, carla.VehicleControl) for control in controls)
    assert controls[0].brake > 0  # before there is a past
    agent.destroy()
    written = json.loads((tmp_path / "Route2_rep0_Town02" / "metric_info.json").read_text())
    assert len(written) == 12
    assert written["0"] == {"location": [1.0, 2.0, 3.0]}


def test_a_planner_of_ones_own_drives_there(loaded: ModuleType, tmp_path: Path) -> None:
    carla = pytest.importorskip("carla")
    (tmp_path / "own.py").write_text(OWN)
    agent = loaded.ForedriveAgent("localhost", 2000, False)
    straight = SimpleNamespace(name="LANEFOLLOW")
    places = [carla.Transform(carla.Location(x, 0, 0)) for x in (0.0, 40.0)]
    by_satellite = [({"lat": 0.0, "lon": x / 111_319.49, "z": 0.0}, straight) for x in (0.0, 40.0)]
    agent.set_global_plan(by_satellite, [(place, straight) for place in places])
    agent.setup(f"python:{tmp_path / 'own.py'}:Planner")
    (camera,) = [sensor for sensor in agent.sensors() if "width" in sensor]
    assert (camera["height"], camera["width"]) == (48, 80)
    wall = np.array([[30.0, y, 1.0, 0.5] for y in (-1.0, 0.0, 1.0)], dtype=np.float32)
    data = {
        camera["id"]: (1, np.zeros((48, 80, 4), dtype=np.uint8)),
        "GPS": (1, np.zeros(3)),
        "IMU": (1, np.array([0, 0, 9.8, 0, 0, 0, 1.57])),
        "SPEED": (1, {"speed": 0.0}),
        "LIDAR": (1, wall),
    }
    controls = [agent.run_step(data, 0.05 * k) for k in range(30)]
    assert controls[-1].throttle > 0


def test_the_route_may_be_appended_to_the_run(tmp_path: Path) -> None:
    assert agent_of("runs/a+r1+r2") == ("runs/a", "r2")
    assert agent_of("runs/a") == ("runs/a", "")
    (tmp_path / "a+b").mkdir()
    assert agent_of(str(tmp_path / "a+b")) == (str(tmp_path / "a+b"), "")


def test_agents_that_see_nothing_carry_no_cameras() -> None:
    pytest.importorskip("carla")
    agent = agent_file.ForedriveAgent()
    agent.setup("constant-velocity")
    assert [sensor["id"] for sensor in agent.sensors()] == ["GPS", "IMU", "SPEED"]
    with pytest.raises(InputError, match="expert"):
        agent.setup("expert")
    with pytest.raises(InputError, match="unknown agent"):
        agent.setup("runs/there-is-none")


def test_where_no_leaderboard_is_the_file_can_be_read() -> None:
    assert agent_file.get_entry_point() == "ForedriveAgent"
    assert hasattr(agent_file.ForedriveAgent, "run_step")
