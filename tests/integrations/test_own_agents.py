"""Agents of users' own classes and of NAVSIM's interface: what they are shown, and what counts as a plan."""

import dataclasses
import json
import math
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from small_drives import PAST, one_example

from foredrive.cli.main import main
from foredrive.errors import InputError
from foredrive.integrations.navsim import records
from foredrive.integrations.navsim.agent import IMAGE_HW, input_of, plan_by_navsim
from foredrive.integrations.own_agents import Needs, absolute, files_of, needs_of, own_agent
from foredrive.runs.drive.agent_inputs import inputs_of, rig_of
from foredrive.runs.drive.agents import absolute_name
from foredrive.scene import Clip, LidarSweep, Trajectory

pytestmark = pytest.mark.usefixtures("navsim")

SHORT = """
class Planner:
    needs = {"cameras": ["right"], "lidar": True, "past_frames": 2}

    def __init__(self, speed=1.0, name="x"):
        self.speed = speed

    def act(self, clip):
        self.clip = clip
        return [(0.5 * self.speed * k, 0.0) for k in range(1, 7)]
"""


def observed(seed: int = 3) -> Clip:
    """A batch of one clip of three key frames of a turning vehicle, with boxes that no agent may see."""
    return one_example(seed).clip.observed()


@pytest.fixture
def planner(tmp_path: Path) -> str:
    file = tmp_path / "short_planner.py"
    file.write_text(SHORT)
    return f"python:{file}:Planner"


def test_a_class_sees_what_it_declares_and_no_truth(planner: str) -> None:
    agent = own_agent(f"{planner}?speed=4")
    plan = agent.act(observed())
    torch.testing.assert_close(plan.xy[0, 0], torch.tensor([[2.0 * k, 0.0] for k in range(1, 7)]))
    seen: Clip = agent.plan.__self__.clip  # type: ignore[attr-defined]
    assert seen.t_s.tolist() == [-1.0, -0.5, 0.0]
    assert seen.rig.names == ("right",)
    torch.testing.assert_close(seen.images, observed()[0].images[:, [1]])
    assert not seen.boxes_valid.any()
    assert not seen.boxes.centre.any()
    assert not seen.future.valid.any()
    assert inputs_of(planner).camera_names == ("right",)
    assert inputs_of(planner).past_frames == 2
    assert needs_of(planner) == Needs(("right",), None, True, 2)


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        ([(1.0, 0.0)] * 5, r"at least 6 points x, y .*; got an array \[5, 2\]"),
        ([(1.0, 0.0, 0.0, 0.0)] * 6, r"got an array \[6, 4\]"),
        ([(1.0, math.nan)] * 6, "points that are not finite"),
        ("straight on", "could not convert"),
    ],
)
def test_what_is_no_plan_is_refused(answer: Any, reason: str, planner: str) -> None:
    agent = dataclasses.replace(own_agent(planner), plan=lambda clip: answer)
    with pytest.raises((InputError, ValueError), match=reason):
        agent.act(observed())


def test_plans_are_arrays_tensors_or_trajectories(planner: str) -> None:
    xy = torch.arange(16.0).reshape(8, 2)
    best = torch.stack([-xy, xy])[None]
    flat = best[..., 0]
    two = Trajectory(best, flat, torch.ones_like(flat, dtype=torch.bool), torch.tensor([[-1.0, 0.0]]), 0.5)
    for answer in (xy, xy.numpy(), xy.tolist(), two):
        agent = dataclasses.replace(own_agent(planner), plan=lambda clip, answer=answer: answer)
        torch.testing.assert_close(agent.act(observed()).xy[0, 0], xy[:6])
    other = dataclasses.replace(two, dt_s=0.1)
    with pytest.raises(InputError, match=r"plans are 0.5 s apart, not 0.1"):
        dataclasses.replace(own_agent(planner), plan=lambda clip: other).act(observed())


def test_a_camera_that_is_not_there_is_named(planner: str, tmp_path: Path) -> None:
    (tmp_path / "short_planner.py").write_text(SHORT.replace('"right"', '"PCAM_F0", "PCAM_L2"'))
    sys.modules.pop("own_agent_short_planner", None)
    with pytest.raises(InputError, match=r"needs the camera PCAM_F0; there are left, right"):
        own_agent(f"{planner}?").act(observed())


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("python:missing.py:Planner", "missing.py: no such file"),
        ("python:{file}:Other", "no class Other in .*short_planner.py; there are Planner"),
        ("python:{file}", "this agent is named python:FILE.py:CLASS"),
        (
            "python:{file}:Planner?sped=3",
            "unexpected keyword argument 'sped'; arguments are written behind it",
        ),
        (
            "navsim:no_such_module:Agent",
            "cannot be imported: ModuleNotFoundError.*is its folder on PYTHONPATH",
        ),
        ("navsim:Agent", "this agent is named navsim:MODULE:CLASS"),
    ],
)
def test_wrong_names_are_one_line(name: str, reason: str, tmp_path: Path) -> None:
    file = tmp_path / "short_planner.py"
    file.write_text(SHORT)
    with pytest.raises(InputError, match=reason):
        own_agent(name.format(file=file))


@pytest.mark.parametrize(
    ("needs", "reason"),
    [
        ('{"camera": ["PCAM_F0"]}', "needs.camera: "),
        ('{"cameras": "PCAM_F0"}', "needs.cameras: "),
        ('{"past_frames": -1}', "past_frames and image_hw must not be negative"),
    ],
)
def test_a_declaration_that_is_not_understood_is_refused(needs: str, reason: str, tmp_path: Path) -> None:
    file = tmp_path / "declares.py"
    file.write_text(f"class Planner:\n    needs = {needs}\n    def act(self, clip): ...\n")
    with pytest.raises(InputError, match=reason):
        needs_of(f"python:{file}:Planner")


def test_arguments_behind_the_class(tmp_path: Path) -> None:
    file = tmp_path / "takes.py"
    file.write_text(
        "class Planner:\n    def __init__(self, **given): self.given = given\n    def act(self, clip): ...\n"
    )
    query = "width=64&lr=1e-4&deep=true&checkpoint=runs/a.b:c&sizes=[1,2]&name=01"
    given = own_agent(f"python:{file}:Planner?{query}").plan.__self__.given  # type: ignore[attr-defined]
    plain = {"width": 64, "lr": 1e-4, "deep": True, "sizes": [1, 2]}
    assert given == plain | {"checkpoint": "runs/a.b:c", "name": "01"}


def test_one_instance_with_reset_serves_all_drives(tmp_path: Path) -> None:
    file = tmp_path / "slow_to_load.py"
    file.write_text(
        "class Planner:\n    made, resets = 0, 0\n"
        "    def __init__(self): Planner.made += 1\n    def reset(self): Planner.resets += 1\n"
        "    def act(self, clip): return [(1.0, 0.0)] * 6\n"
    )
    for _ in range(3):
        own_agent(f"python:{file}:Planner")
    kind = sys.modules["own_agent_slow_to_load"].Planner
    assert (kind.made, kind.resets) == (1, 3)


def test_names_for_processes_in_other_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert absolute_name("python:my.py:Planner?a=b/c:d") == f"python:{tmp_path}/my.py:Planner?a=b/c:d"
    assert absolute("navsim:a.b:Agent") == "navsim:a.b:Agent"


def test_towns_have_the_cameras_that_are_declared(tmp_path: Path) -> None:
    file = tmp_path / "tele.py"
    source = 'class Planner:\n    needs = {"cameras": ["pcam_r2", "FTCAM_TELE_F0"], "image_hw": [60, 100]}\n'
    file.write_text(source)
    rig = rig_of(f"python:{file}:Planner")
    assert (list(rig.cameras), rig.image_hw) == (["PCAM_R2", "FTCAM_TELE_F0"], (60, 100))
    assert rig.cameras["PCAM_R2"].yaw_deg == -140
    other = tmp_path / "none.py"
    other.write_text(source.replace("pcam_r2", "rear"))
    with pytest.raises(InputError, match="needs the camera rear; towns have PCAM_F0, "):
        rig_of(f"python:{other}:Planner")


# NAVSIM


class Stitching(records.AbstractAgent):
    """An agent with the inputs of NAVSIM's TransFuser: three images of now, stitched, and lidar."""

    def __init__(self) -> None:
        super().__init__(records.TrajectorySampling(time_horizon=4, interval_length=0.1))

    def initialize(self) -> None:
        self.ready = True

    def get_sensor_config(self) -> records.SensorConfig:
        config = records.SensorConfig.build_no_sensors()
        config.cam_f0 = config.cam_l0 = config.cam_r0 = config.lidar_pc = [3]
        return config

    def get_feature_builders(self) -> list[Any]:
        return [self]

    def compute_features(self, agent_input: records.AgentInput) -> dict[str, torch.Tensor]:
        self.given = agent_input
        seen = agent_input.cameras[-1]
        sides = [seen.cam_l0.image, seen.cam_r0.image]  # type: ignore[list-item]
        left, right = (side[28:-28, 416:-416] for side in sides)  # type: ignore[index]
        stitched = np.concatenate([left, seen.cam_f0.image[28:-28], right], axis=1)  # type: ignore[index]
        status = agent_input.ego_statuses[-1]
        motion = np.concatenate([status.driving_command, status.ego_velocity, status.ego_acceleration])
        return {"camera": torch.tensor(stitched), "status": torch.tensor(motion)}

    def forward(self, features: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        assert features["camera"].shape == (1, 1024, 4096, 3)  # 4 : 1, as TransFuser resizes it
        assert features["status"].shape == (1, 8)
        t_s = 0.1 * torch.arange(1, 41)
        return {"trajectory": torch.stack([t_s**2, -t_s, torch.zeros_like(t_s)], dim=-1)[None]}


def navsim_clip() -> Clip:
    """Four key frames, unbatched, with the three cameras of TransFuser and five lidar points."""
    clip = one_example(3).clip[0].frames(slice(PAST - 2, PAST + 2))  # three of the past and the next
    clip = dataclasses.replace(clip, t_s=clip.t_s - clip.t_s[-1])
    frames, names = 4, ("PCAM_F0", "PCAM_L0", "PCAM_R0")
    points = torch.tensor([[4.0, 3, 0], [1, 0, 0], [0, 2, 0], [0, 0, 2], [3, 0, 4]])
    range_m = points.norm(dim=1)
    sweep = LidarSweep(
        origin_ego=torch.zeros(5, 3),
        dir_ego=points / range_m[:, None],
        range_m=range_m,
        returned=torch.tensor([True, True, True, False, True]),
        intensity=torch.full((5,), 0.2),
        dt_s=torch.zeros(5),
        beam=torch.tensor([0, 1, 2, 3, -1]),
        valid=torch.ones(5, dtype=torch.bool),
    )
    rig = clip.rig[:, [0, 0, 1]]
    return dataclasses.replace(
        clip,
        images=torch.arange(3)[None, :, None, None, None].expand(frames, 3, 3, *IMAGE_HW).to(torch.uint8),
        image_valid=torch.ones(frames, 3, dtype=torch.bool),
        rig=dataclasses.replace(rig, names=names),
        sweeps=sweep.map_tensors(lambda values: values.expand(frames, *values.shape)),
        sweep_valid=torch.ones(frames, dtype=torch.bool),
    )


def test_a_clip_becomes_navsims_input() -> None:
    agent, clip = Stitching(), navsim_clip()
    given = input_of(agent, clip)
    poses = np.stack([status.ego_pose for status in given.ego_statuses])
    np.testing.assert_allclose(poses[-1], 0, atol=1e-6)
    T_now = np.linalg.inv(clip.T_world_ego[-1].numpy()) @ clip.T_world_ego.numpy()
    np.testing.assert_allclose(poses[:, :2], T_now[:, :2, 3], atol=1e-5)
    turn = np.arctan2(T_now[:, 1, 0], T_now[:, 0, 0])
    np.testing.assert_allclose(poses[:, 2], turn, atol=1e-5)
    speed = float(clip.ego_speed_mps[0])
    status = given.ego_statuses[-1]
    np.testing.assert_allclose(status.ego_velocity, [speed, 0], rtol=1e-6)
    # At constant speed on a circle all acceleration is towards its centre: v times the turn rate
    np.testing.assert_allclose(status.ego_acceleration, [0, speed * -turn[-2] / 0.5], rtol=1e-4, atol=1e-5)
    assert status.driving_command.tolist() == [1, 0, 0, 0] if turn[-2] < 0 else [0, 0, 1, 0]
    # Only what the agent asks for, at the key frames that it asks for
    assert given.cameras[2].cam_f0.image is None
    assert given.cameras[3].cam_b0.image is None
    assert [int(getattr(given.cameras[3], f"cam_{name}").image.max()) for name in ("f0", "l0", "r0")] == [
        0,
        1,
        2,
    ]
    assert given.lidars[2].lidar_pc is None
    points = given.lidars[3].lidar_pc
    np.testing.assert_allclose(points[:4, 0], [4, 3, 0, 51], rtol=1e-5)
    assert points.shape == (6, 4)
    assert points[4].tolist() == [0, 1, 2, 0]


def test_navsims_poses_become_points_of_half_seconds() -> None:
    t_s = 0.5 * np.arange(1, 7)
    points = plan_by_navsim(Stitching(), navsim_clip())
    np.testing.assert_allclose(points, np.stack([t_s**2, -t_s], axis=1), atol=1e-5)
    brief = Stitching()
    brief._trajectory_sampling = records.TrajectorySampling(num_poses=40, interval_length=0.05)
    with pytest.raises(InputError, match=r"a plan of 2 s; plans are of 3 s or more"):
        plan_by_navsim(brief, navsim_clip())


def test_a_navsim_agent_declares_its_sensors(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("their_agent")
    module.Stitching = Stitching  # type: ignore[attr-defined]

    class Human(Stitching):
        requires_scene = True

    module.make = Human  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "their_agent", module)
    agent = "navsim:their_agent:Stitching"
    assert needs_of(agent) == Needs(("PCAM_F0", "PCAM_L0", "PCAM_R0"), IMAGE_HW, True, 3)
    assert rig_of(agent).image_hw == IMAGE_HW
    plan = own_agent(agent).act(navsim_clip()[None])
    assert plan.xy[0, 0, -1].tolist() == pytest.approx([9.0, -3.0], abs=1e-4)


# Trials before the first drive


@pytest.fixture(scope="module")
def route(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short route of Town02 along a lane; CARLA's y points to the right."""
    from foredrive.towns.map.town_map import load_town_map
    from foredrive.towns.traffic.lane_graph import build_lane_graph

    graph = build_lane_graph(load_town_map("Town02"))
    lane = int(np.argmax(np.where(graph.contested, 0.0, graph.length_m)))
    ends = graph.position(np.full(2, lane), np.array([20.0, 34.0]))
    points = "".join(f'<waypoint x="{x}" y="{-y}" z="{z}"/>' for x, y, z in ends)
    path = tmp_path_factory.mktemp("route") / "one.xml"
    path.write_text(f'<routes><route id="a" town="Town02">{points}</route></routes>')
    return path


def drive(agent: str, route: Path, out: Path) -> int:
    still = ["--vehicles", "0", "--people", "0", "--no-scenarios", "--no-sensors", "--workers", "1"]
    return main(["drive", "--agent", agent, "--routes", str(route), "--out", str(out), *still])


def test_an_own_planner_is_tried_and_drives(
    route: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example = Path(__file__).parents[2] / "examples" / "own_planner.py"
    assert drive(f"python:{example}:Planner", route, tmp_path / "out") == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "was tried for 2 s: it sees 2 key frames of PCAM_F0 at 96 x 160 px and " in told
    assert "lidar points, and plans 6 points in " in told
    (record,) = (tmp_path / "out" / "drives").glob("*.json")
    drive_record = json.loads(record.read_text())
    assert not drive_record["error"]
    assert drive_record["driving_score_1_0"] == 100.0


FAILS_LATER = """
from steps import STEP_M

class Planner:
    calls = 0
    def act(self, clip):
        from steps import AFTER
        self.calls += 1
        if self.calls > AFTER:
            raise ValueError("queue is empty")
        return [(STEP_M * (k + 1), 0.0) for k in range(6)]
"""


def test_a_planner_that_was_mended_or_changed_is_not_the_same(
    route: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A drive that failed is driven again; good ones are kept, and not taken for those of another version."""
    file, beside, out = tmp_path / "planner.py", tmp_path / "steps.py", tmp_path / "out"
    file.write_text(FAILS_LATER)
    beside.write_text("STEP_M, AFTER = 0.8, 12\n")
    agent = f"python:{file}:Planner"

    def again() -> tuple[int, str, dict[str, Any]]:
        """A new process for each call: modules are imported once."""
        still = ["--vehicles", "0", "--people", "0", "--no-scenarios", "--no-sensors", "--workers", "1"]
        command = [sys.executable, "-m", "foredrive", "drive", "--agent", agent, "--routes", str(route)]
        done = subprocess.run([*command, "--out", str(out), *still], capture_output=True, text=True)
        (record,) = (out / "drives").glob("*.json")
        return done.returncode, done.stderr + done.stdout, json.loads(record.read_text())

    code, _, record = again()
    assert code == 0
    assert record["error"] == "ValueError: queue is empty"
    beside.write_text("STEP_M, AFTER = 0.8, 12000\n")  # a module that it imports in a function
    code, said, record = again()
    assert code == 0, said
    assert not record["error"]
    assert record["driving_score_1_0"] == 100.0
    beside.write_text("STEP_M, AFTER = 0.0, 12000\n")
    code, said, kept = again()
    assert code == 2
    assert f"holds the drives of another version of {agent}; choose another folder" in said
    assert kept == record
    beside.write_text("STEP_M, AFTER = 0.8, 12000\n")
    code, said, kept = again()
    assert code == 0
    assert kept == record


def test_files_that_decide_what_a_planner_does(tmp_path: Path) -> None:
    """Those that it imports beside it, in packages too, and those of its arguments; nothing installed."""
    (tmp_path / "parts").mkdir()
    texts = {
        "planner.py": "import numpy, parts.net\nfrom parts import sizes\ndef Planner(w, n): ...",
        "parts/__init__.py": "",
        "parts/net.py": "from .sizes import WIDTH\n",
        "parts/sizes.py": "WIDTH = 3\n",
        "unused.py": "",
        "weights.pt": "1",
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    found = files_of(f"python:{tmp_path / 'planner.py'}:Planner?w={tmp_path / 'weights.pt'}&n=3")
    named = [str(file.relative_to(tmp_path)) for file in found]
    assert named == ["parts/__init__.py", "parts/net.py", "parts/sizes.py", "planner.py", "weights.pt"]


@pytest.mark.parametrize("kind", ["constructor", "initialize"])
def test_a_planner_that_cannot_be_made_is_one_line(
    kind: str,
    route: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A checkpoint that is missing is the most common first error."""
    loads = "open('absent.pt')"
    (tmp_path / f"{kind}_fails.py").write_text(
        f"class Planner:\n    def __init__(self):\n        {loads if kind == 'constructor' else 'pass'}\n"
        f"    def initialize(self):\n        {loads}\n    def act(self, clip):\n        return []\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    name = f"python:{tmp_path}/{kind}_fails.py" if kind == "constructor" else f"navsim:{kind}_fails"
    assert drive(f"{name}:Planner", route, tmp_path / "out") == 2
    told = capsys.readouterr().err.strip()
    assert "\n" not in told
    assert "cannot be made: FileNotFoundError: [Errno 2] No such file or directory: 'absent.pt' (" in told
    assert not (tmp_path / "out").exists()


def test_an_agent_of_navsim_1_drives(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Its base class needs no sampling, and a trajectory has 4 s."""
    (tmp_path / "of_v1.py").write_text(
        "from navsim.agents.abstract_agent import AbstractAgent\n"
        "from navsim.common.dataclasses import SensorConfig, Trajectory\n"
        "import numpy as np\n"
        "class Agent(AbstractAgent):\n"
        "    def __init__(self): super().__init__()\n"
        "    def initialize(self): pass\n"
        "    def get_sensor_config(self): return SensorConfig.build_no_sensors()\n"
        "    def compute_trajectory(self, given):\n"
        "        return Trajectory(np.outer(np.arange(1, 9), [2.5, 0.5, 0.0]))\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    plan = own_agent("navsim:of_v1:Agent").act(navsim_clip()[None])
    assert plan.xy[0, 0, [0, -1]].flatten().tolist() == pytest.approx([2.5, 0.5, 15.0, 3.0])


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        (
            "return self.weights(clip)",
            "in the trial at 0 s: AttributeError: 'Planner' object has no attribute",
        ),
        (
            "self.n = getattr(self, 'n', 0) + 1; return [(self.n / (self.n - 3.0), 0.0)] * 6",
            "ZeroDivisionError",
        ),
        ("return [(float('nan'), 0.0)] * 6", "points that are not finite"),
    ],
)
def test_a_planner_that_fails_in_its_trial_drives_nothing(
    body: str, reason: str, route: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / f"fails_{abs(hash(body))}.py"
    file.write_text(f"class Planner:\n    def act(self, clip):\n        {body}\n")
    assert drive(f"python:{file}:Planner", route, tmp_path / "out") == 2
    told = capsys.readouterr().err.strip()
    assert "\n" not in told
    assert reason in told
    assert not (tmp_path / "out").exists()
