"""The examples do what they say, as far as that is possible without the other programs."""

import math
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
import yaml

from foredrive.integrations.navsim.records import (
    AgentInput,
    Camera,
    Cameras,
    EgoStatus,
    SensorConfig,
    TrajectorySampling,
)
from foredrive.runs import Run, load_agent
from foredrive.scene import Command, Trajectory

EXAMPLES = Path(__file__).parents[2] / "examples"
Loader = Callable[[str], ModuleType]
LOOKS_DEG = {"f0": 0, "l0": 55, "r0": -55, "l1": 110, "r1": -110, "b0": 180, "l2": 140, "r2": -140}
STEP_M, TURN_RAD = 2.0, 0.1


def test_the_leaderboards_find_their_agent(example: Loader) -> None:
    agent = example("carla_agent")
    assert issubclass(getattr(agent, agent.get_entry_point()), object)
    assert {"setup", "sensors", "run_step", "destroy"} <= set(dir(agent.ForedriveAgent))


def camera(looks_deg: float) -> Camera:
    """A camera of 70 degrees that looks to the left by an angle."""
    a = math.radians(looks_deg)
    rotation = np.array([[math.sin(a), 0, math.cos(a)], [-math.cos(a), 0, math.sin(a)], [0, -1, 0]])
    image = np.full((96, 160, 3), 90, np.uint8)
    K = np.array([[114.0, 0, 80], [0, 114.0, 48], [0, 0, 1]])
    return Camera(image, rotation, np.array([1.5, 0.0, 1.6]), K, np.zeros(5))


def given(command: int) -> AgentInput:
    """Four key frames of a left curve, in the frame of the last."""
    statuses = [
        EgoStatus(
            ego_pose=np.array([-STEP_M * k, 0.1 * k, -TURN_RAD * k]),
            ego_velocity=np.array([4.0, 3.0]),
            ego_acceleration=np.zeros(2),
            driving_command=np.eye(4, dtype=int)[command],
        )
        for k in (3, 2, 1, 0)
    ]
    seen = Cameras(**{f"cam_{name}": camera(degrees) for name, degrees in LOOKS_DEG.items()})
    return AgentInput(statuses, [seen] * 4, [])


@pytest.mark.usefixtures("navsim")
def test_navsims_input_becomes_a_clip(example: Loader) -> None:
    clip = example("navsim_agent").clip_of(given(0), past_frames=1)
    assert clip.t_s.tolist() == [-0.5, 0.0]
    assert torch.allclose(clip.T_world_ego[1], torch.eye(4).double())
    assert torch.allclose(clip.T_world_ego[0, :2, 3], torch.tensor([-STEP_M, 0.1]).double())
    assert math.atan2(clip.T_world_ego[0, 1, 0], clip.T_world_ego[0, 0, 0]) == pytest.approx(-TURN_RAD)
    assert clip.ego_speed_mps.tolist() == [5.0, 5.0]
    assert (int(clip.command), bool(clip.command_valid)) == (Command.LEFT, True)
    axes = clip.rig.T_ego_cam[0, :, :2, 2]
    found_deg = torch.atan2(axes[:, 1], axes[:, 0]).rad2deg().tolist()
    assert found_deg == pytest.approx([0, 55, -55, 110, -110, 180], abs=1e-3)
    assert not clip.boxes_valid.any()
    assert not clip.sweep_valid.any()


@pytest.mark.usefixtures("navsim")
@pytest.mark.parametrize(
    ("told", "command"), [(0, Command.LEFT), (1, Command.STRAIGHT), (2, Command.RIGHT), (3, None)]
)
def test_navsims_commands_keep_their_sides(told: int, command: Command | None, example: Loader) -> None:
    clip = example("navsim_agent").clip_of(given(told), past_frames=0)
    assert bool(clip.command_valid) == (command is not None)
    assert command is None or int(clip.command) == command


@pytest.mark.usefixtures("navsim")
def test_a_plan_of_three_seconds_goes_on_straight(example: Loader) -> None:
    t = torch.arange(1, 7).float()
    xy = torch.stack([torch.stack([t, 0 * t], -1), torch.stack([2 * t, t], -1)])
    yaw = torch.stack([0 * t, 0.1 * t])
    plan = Trajectory(xy[None], yaw[None], torch.ones(1, 2, 6).bool(), torch.tensor([[-3.0, -1.0]]), dt_s=0.5)
    poses = example("navsim_agent").poses_of(plan, 8)
    assert poses[:, :2].tolist() == pytest.approx(np.stack([2 * np.arange(1, 9), np.arange(1, 9)], -1))
    assert poses[:, 2] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.6, 0.6])


@pytest.mark.usefixtures("navsim")
def test_navsims_evaluation_gets_a_trajectory(example: Loader, trained: Run) -> None:
    module = example("navsim_agent")
    agent = module.ForedriveAgent(str(trained.folder), TrajectorySampling(8, 0.5))
    past = trained.recipe.clips.past_frames
    asked = agent.get_sensor_config()
    assert isinstance(asked, SensorConfig)
    assert asked.cam_b0 == list(range(3 - past, 4))
    assert asked.lidar_pc is asked.cam_l2 is False
    agent.initialize()
    poses = agent.compute_trajectory(given(1)).poses
    assert np.isfinite(poses).all()
    assert poses.dtype == np.float32


def test_navsims_configuration_names_the_agent(example: Loader) -> None:
    config = yaml.safe_load((EXAMPLES / "foredrive_agent.yaml").read_text())
    module, _, name = config["_target_"].rpartition(".")
    assert (EXAMPLES / f"{module}.py").is_file()
    assert f"class {name}(" in (EXAMPLES / f"{module}.py").read_text()
    assert config["trajectory_sampling"]["interval_length"] == 0.5


def test_a_model_folder_is_loaded_by_its_place_and_by_its_name(
    example: Loader, trained: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = example("hugging_face")
    commit = "0" * 40
    cached = tmp_path / "hub" / "models--you--nemo"
    folder = module.save(trained, cached / "snapshots" / commit, "# A run\n")
    (cached / "refs").mkdir()
    (cached / "refs" / "main").write_text(commit)
    assert (folder / "README.md").read_text().startswith("---\nlibrary_name: foredrive\n")
    assert not [file for file in folder.rglob("*") if file.suffix in (".pt", ".pkl", ".jsonl")]
    expected = load_agent(trained).state_dict()
    by_name = {"cache_dir": tmp_path / "hub", "local_files_only": True}
    for name, options in ((str(folder), {}), ("you/nemo", by_name)):
        run, agent = module.load(name, **options)
        assert run.recipe == trained.recipe
        assert all(torch.equal(value, expected[key]) for key, value in agent.state_dict().items())
