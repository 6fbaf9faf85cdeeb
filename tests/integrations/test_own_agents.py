"""Agents of users' own classes and of NAVSIM's interface: what they are shown, and what counts as a plan."""

import dataclasses
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_drives import one_example

from foredrive.cli.main import main
from foredrive.errors import InputError
from foredrive.integrations.own_agents import Needs, absolute, files_of, needs_of, own_agent
from foredrive.runs.drive.agent_inputs import inputs_of, rig_of
from foredrive.runs.drive.agents import absolute_name
from foredrive.scene import Clip, Trajectory

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


# Trials before the first drive


@pytest.fixture(scope="module")
def route(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short route of Town02 along a lane; CARLA's y points to the right."""
    from foredrive.towns.map.loading import load_town_map
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
    agent = f"python:{tmp_path / 'planner.py'}:Planner"
    code = ["parts/__init__.py", "parts/net.py", "parts/sizes.py", "planner.py"]

    def named(arguments: str) -> list[str]:
        return [str(file.relative_to(tmp_path)) for file in files_of(f"{agent}?{arguments}")]

    assert named(f"w={tmp_path / 'weights.pt'}&n=3") == [*code, "weights.pt"]
    (tmp_path / "model" / "shards").mkdir(parents=True)
    (tmp_path / "model" / "shards" / "1.safetensors").write_text("1")
    assert named(f"w={tmp_path / 'model'}&n=3") == [*code, "model/shards/1.safetensors"]
    assert named(f"w={Path.cwd()}&n=.") == code


def test_packages_on_the_way_and_files_that_are_no_python_count(tmp_path: Path) -> None:
    """An import that fails may be one that the planner does without: a file for another version of Python."""
    (tmp_path / "pieces" / "inner").mkdir(parents=True)
    texts = {
        "planner.py": "import pieces.inner.net\ntry: import newer\nexcept: ...\ndef Planner(): ...",
        "pieces/__init__.py": "from . import names",
        "pieces/names.py": "",
        "pieces/inner/__init__.py": "",
        "pieces/inner/net.py": "",
        "newer.py": "match = = 3",
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    files = files_of(f"python:{tmp_path / 'planner.py'}:Planner")
    assert [str(file.relative_to(tmp_path)) for file in files] == sorted(texts)


@pytest.mark.parametrize(
    ("folder", "others"), [("site-packages", []), ("code", ["beside/__init__.py", "beside/tools.py"])]
)
def test_of_installed_packages_the_agents_own_counts(
    folder: str, others: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a folder of one's own, all that is imported from there counts."""
    root = tmp_path / folder
    package = f"of_{folder.replace('-', '_')}"
    texts = {
        f"{package}/__init__.py": "",
        f"{package}/agent.py": "import beside.tools\nfrom .net import WIDTH\nclass Agent: ...",
        f"{package}/net.py": "WIDTH = 3",
        "beside/__init__.py": "",
        "beside/tools.py": "",
    }
    for name, text in texts.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    monkeypatch.syspath_prepend(root)
    files = files_of(f"navsim:{package}.agent:Agent")
    for module in ("beside", "beside.tools"):
        monkeypatch.delitem(sys.modules, module)
    own = [f"{package}/__init__.py", f"{package}/agent.py", f"{package}/net.py"]
    assert [str(file.relative_to(root)) for file in files] == [*others, *own]


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
