"""Benchmarks: arm by arm, seed by seed, stored as they come in."""

import dataclasses
import json
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from benchmarks.common.benchmark import Benchmark, run_benchmark, study_identity
from foredrive.errors import InputError


class Recorder:
    """Arms that remember what was measured, and can be interrupted."""

    def __init__(self) -> None:
        self.measured: list[tuple[str, int]] = []
        self.interrupt_at: tuple[str, int] | None = None
        self.said: list[str] = []

    def benchmark(self) -> Benchmark:
        return Benchmark(
            question="which is faster?",
            arms={
                "ours": lambda seed: self.measure("ours", seed),
                "peer": lambda seed: self.measure("peer", seed),
            },
            seeds=(0, 1, 2),
            config={"size": 3},
        )

    def measure(self, arm: str, seed: int) -> Mapping[str, float]:
        if (arm, seed) == self.interrupt_at:
            raise KeyboardInterrupt
        self.measured.append((arm, seed))
        return {"time_ms": (1.0 if arm == "ours" else 10.0) + seed}


def test_all_pairs_are_measured_and_summed_up(tmp_path: Path) -> None:
    recorder = Recorder()
    path = run_benchmark("speed", recorder.benchmark(), tmp_path, say=recorder.said.append)
    assert path == tmp_path / "speed.json"
    report = json.loads(path.read_text())
    assert recorder.measured == [(arm, seed) for seed in range(3) for arm in ("ours", "peer")]
    assert report["figures"]["ours"]["time_ms"] == {"mean": 2.0, "std": 1.0, "min": 1.0, "max": 3.0, "n": 3}
    assert report["figures"]["peer"]["time_ms"]["mean"] == 11.0
    assert len(report["runs"]) == 6
    assert {"question", "commit", "command", "machine.cpu", "config"} <= set(report)


def test_an_interrupted_benchmark_goes_on_where_it_stopped(tmp_path: Path) -> None:
    recorder = Recorder()
    recorder.interrupt_at = ("peer", 1)
    with pytest.raises(KeyboardInterrupt):
        run_benchmark("speed", recorder.benchmark(), tmp_path, say=recorder.said.append)
    assert len(json.loads((tmp_path / "speed.json").read_text())["runs"]) == 3
    assert [p.name for p in tmp_path.iterdir()] == ["speed.json"]
    recorder.interrupt_at, recorder.measured = None, []
    run_benchmark("speed", recorder.benchmark(), tmp_path, say=recorder.said.append)
    assert recorder.measured == [("peer", 1), ("ours", 2), ("peer", 2)]
    assert sum("measured before" in line for line in recorder.said) == 3


def test_what_another_process_measures_meanwhile_is_kept_and_not_measured_again(tmp_path: Path) -> None:
    recorder, other = Recorder(), Recorder()

    def meanwhile(seed: int) -> Mapping[str, float]:
        run_benchmark("speed", other.benchmark(), tmp_path, arms=["peer"], say=other.said.append)
        return recorder.measure("ours", seed)

    slow = recorder.benchmark()
    slow = dataclasses.replace(slow, arms={**slow.arms, "ours": meanwhile})
    path = run_benchmark("speed", slow, tmp_path, say=recorder.said.append)
    assert recorder.measured == [("ours", seed) for seed in range(3)]
    assert other.measured == [("peer", seed) for seed in range(3)]
    assert len(json.loads(path.read_text())["runs"]) == 6


def test_other_values_start_anew(tmp_path: Path) -> None:
    recorder = Recorder()
    run_benchmark("speed", recorder.benchmark(), tmp_path, say=recorder.said.append)
    recorder.measured = []
    run_benchmark("speed", recorder.benchmark(), tmp_path, say=recorder.said.append)
    assert recorder.measured == []
    changed = dataclasses.replace(recorder.benchmark(), config={"size": 4})
    run_benchmark("speed", changed, tmp_path, arms=["peer"], say=recorder.said.append)
    assert recorder.measured == [("peer", seed) for seed in range(3)]
    assert any("starting anew" in line for line in recorder.said)
    assert list(json.loads((tmp_path / "speed.json").read_text())["figures"]) == ["peer"]


def test_wrong_names_and_files_are_named(tmp_path: Path) -> None:
    recorder = Recorder()
    with pytest.raises(InputError, match="no arm theirs; it has ours, peer"):
        run_benchmark("speed", recorder.benchmark(), tmp_path, arms=["theirs"], say=recorder.said.append)
    (tmp_path / "speed.json").write_text("{}")
    with pytest.raises(InputError, match="not a benchmark's results"):
        run_benchmark("speed", recorder.benchmark(), tmp_path, say=recorder.said.append)
    assert recorder.measured == []


def _study(decided_by: tuple[str, ...], size: int = 3) -> Benchmark:
    return Benchmark(
        "which is better?", {"ours": lambda seed: {"iou": 0.1 * seed}}, (0, 1), {"size": size}, decided_by
    )


def _module(folder: Path, code: str) -> tuple[str, ...]:
    package = folder / "decisive"
    package.mkdir(exist_ok=True)
    (package / "__init__.py").write_text("")
    (package / "model.py").write_text(code)
    return ("decisive",)


def test_a_study_outlives_commits_machines_and_comments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    decided_by = _module(tmp_path, "def half(x):\n    return x / 2\n")
    first = {"commit": "aaa", "machine.cpu": "old", "machine.cores": 2}
    monkeypatch.setattr("benchmarks.common.benchmark.collect_provenance", lambda: first)
    study = dataclasses.replace(_study(decided_by), seeds=(0,))
    run_benchmark("study", study, tmp_path, say=lambda line: None)

    decided_by = _module(tmp_path, 'def half(x):\n    """Return half."""\n    return x / 2  # exact\n')
    second = {"commit": "bbb", "machine.cpu": "new", "machine.cores": 4}
    monkeypatch.setattr("benchmarks.common.benchmark.collect_provenance", lambda: second)
    path = run_benchmark("study", _study(decided_by), tmp_path, say=lambda line: None)
    runs = json.loads(path.read_text())["runs"]
    assert [(run["seed"], run["commit"], run["machine.cpu"]) for run in runs] == [
        (0, "aaa", "old"),
        (1, "bbb", "new"),
    ]


@pytest.mark.parametrize("change", ["code", "config"])
def test_a_study_starts_anew_where_what_decides_it_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    decided_by = _module(tmp_path, "def half(x):\n    return x / 2\n")
    said: list[str] = []
    run_benchmark("study", _study(decided_by), tmp_path, say=said.append)
    if change == "code":
        _module(tmp_path, "def half(x):\n    return x // 2\n")
    run_benchmark("study", _study(decided_by, size=4 if change == "config" else 3), tmp_path, say=said.append)
    assert any("starting anew" in line for line in said)


@pytest.mark.parametrize(
    ("config", "same"),
    [
        ({"rate": 0.1, "sizes": [1, 2], "inner": {"on": True}, "added": None}, True),
        ({"rate": 0.1, "sizes": [1, 2], "inner": {"on": True, "added": False, "more": {"x": []}}}, True),
        ({"rate": 0.1, "sizes": [1, 2], "inner": {"on": False}}, False),
        ({"rate": 0.1, "sizes": [1, 2], "inner": {"on": True}, "added": 0.0}, False),
        ({"rate": 0.1, "sizes": [1, 2, None], "inner": {"on": True}}, False),
        ({"sizes": [1, 2], "inner": {"on": True}}, False),
    ],
)
def test_options_that_are_off_decide_nothing(config: dict[str, object], same: bool) -> None:
    before = {"rate": 0.1, "sizes": [1, 2], "inner": {"on": True}}
    assert (study_identity(config, ()) == study_identity(before, ())) == same


SLICED = """import math
from os.path import join

SCALE = 2.0

def half(x):
    return _scaled(x) / 2

def _scaled(x):
    return SCALE * x

def other(x):
    return math.sqrt(x)
"""


@pytest.mark.parametrize(
    ("before", "after", "anew"),
    [
        ("math.sqrt(x)", "math.exp(x)", False),
        ("def other", "def another", False),
        ("from os.path import join", "from os.path import split", False),
        ("/ 2", "/ 3", True),
        ("SCALE * x", "SCALE + x", True),
        ("SCALE = 2.0", "SCALE = 3.0", True),
    ],
)
def test_a_definition_decides_with_what_it_uses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: str, after: str, anew: bool
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    # Looking a module up imports its package
    monkeypatch.delitem(sys.modules, "decisive", raising=False)
    _module(tmp_path, SLICED)
    first = study_identity({}, ("decisive.model:half",))
    assert before in SLICED
    _module(tmp_path, SLICED.replace(before, after))
    assert (study_identity({}, ("decisive.model:half",)) != first) == anew
    with pytest.raises(ImportError, match=r"no definition 'decisive\.model:quarter'"):
        study_identity({}, ("decisive.model:quarter",))


def test_the_parts_of_an_arm_stand_together(tmp_path: Path) -> None:
    arms = {
        "ours@short": lambda seed: {"iou_short": 0.1 + seed},
        "ours@long": lambda seed: {"iou_long": 0.2 + seed},
        "peer@short": lambda seed: {"iou_short": 0.3 + seed},
    }
    path = run_benchmark("parts", Benchmark("?", arms, seeds=(0, 2)), tmp_path, say=lambda line: None)
    report = json.loads(path.read_text())
    assert {arm: set(found) for arm, found in report["figures"].items()} == {
        "ours": {"iou_short", "iou_long"},
        "peer": {"iou_short"},
    }
    assert report["figures"]["ours"]["iou_long"]["mean"] == pytest.approx(1.2)
    assert {run["arm"] for run in report["runs"]} == set(arms)
