"""A queue of studies, with real processes."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.study_queue import (
    Measurement,
    QueuedStudy,
    load_queue,
    missing_measurements,
)
from foredrive.cli.main import main
from foredrive.engine.folder import held
from foredrive.errors import InputError

STUDY = """
import os, time
from pathlib import Path
from benchmarks.common.benchmark import Benchmark

FOLDER = Path(__file__).parent

def measure(arm, seed):
    with (FOLDER / "ran.txt").open("a") as file:
        file.write(f"NAME.{arm}.{seed} {len(os.sched_getaffinity(0))} {os.environ['OMP_NUM_THREADS']}\\n")
    if (FOLDER / f"broken_{arm}").exists():
        raise ValueError("no such thing")
    while (FOLDER / f"slow_{arm}").exists():
        time.sleep(0.01)
    return {"iou": 0.5 + seed}

BENCHMARK = Benchmark(
    "?",
    {arm: lambda seed, arm=arm: measure(arm, seed) for arm in ("with", "without")},
    (0, 1),
    decided_by=("foredrive.errors",),
)
"""
QUEUE = """
- claim: a costly one
  bench: costly
  arms: [with, without]
  cpu_minutes: 30
- claim: a cheap one
  bench: cheap
  arms: [with]
  cpu_minutes: 10
  seeds: [1]
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # Processes find `benchmarks.common`
    for name in ("costly", "cheap"):
        (tmp_path / f"{name}.py").write_text(STUDY.replace("NAME", name))
    (tmp_path / "queue.yaml").write_text(QUEUE)
    return tmp_path


def study(seconds: float = 0.0) -> Benchmark:
    return Benchmark(
        "?", {"a": lambda seed: {}, "b": lambda seed: {}}, (0, 1), decided_by=("foredrive.errors",)
    )


def names(measurements: list[Measurement]) -> list[str]:
    return [one.name for one in measurements]


def test_most_value_for_the_computing_that_is_left_comes_first(tmp_path: Path) -> None:
    benchmarks = {"x": study(), "y": study(), "z": study()}
    studies = [
        QueuedStudy("four of 10 minutes", "x", ("a", "b"), 10.0),
        QueuedStudy("one of 30 minutes", "y", ("a",), 30.0, seeds=(0,)),
        QueuedStudy("the same arm, and worth five of them", "x", ("b",), 10.0, seeds=(0,), value=5.0),
        QueuedStudy("two of 15 minutes", "z", ("b",), 15.0),
    ]
    # Values a minute: 1/40, 1/30, 5/10, 1/30
    order = ["x.b.0", "y.a.0", "z.b.0", "z.b.1", "x.a.0", "x.a.1", "x.b.1"]
    assert names(missing_measurements(studies, benchmarks, tmp_path)) == order


def test_the_queue_measures_all_that_is_missing_one_process_a_core(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", "--queue", "--dry-run", "--folder", "."]) == 0
    assert "5 measurements are missing, about 2.2 hours of computing" in capsys.readouterr().out
    assert not (folder / "ran.txt").exists()
    assert main(["bench", "costly", "--arms", "without", "--seeds", "1", "--folder", "."]) == 0
    (folder / "ran.txt").unlink()
    assert main(["bench", "--queue", "--folder", "."]) == 0
    ran = [line.split() for line in (folder / "ran.txt").read_text().splitlines()]
    assert sorted(name for name, _, _ in ran) == [
        *("cheap.with.1", "costly.with.0", "costly.with.1", "costly.without.0"),
    ]
    assert {(cores, threads) for _, cores, threads in ran} == {("1", "1")}
    results = json.loads((folder / "results/costly.json").read_text())
    assert results["figures"]["with"]["iou"]["n"] == 2
    assert results["figures"]["without"]["iou"]["mean"] == 1.0
    assert sorted(path.name for path in (folder / "results").iterdir()) == ["cheap.json", "costly.json"]
    capsys.readouterr()
    assert main(["bench", "--queue", "--folder", "."]) == 0
    assert capsys.readouterr().out.startswith("0 measurements are missing")


def test_a_failure_does_not_stop_the_others(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "broken_with").touch()
    assert main(["bench", "--queue", "--folder", ".", "--workers", "1"]) == 2
    error = capsys.readouterr().err
    assert "3 measurements failed: cheap.with.1, costly.with.0, costly.with.1" in error
    results = json.loads((folder / "results/costly.json").read_text())
    assert results["figures"]["without"]["iou"]["n"] == 2
    # Tried twice each
    ran = (folder / "ran.txt").read_text()
    assert ran.count("cheap.with.1") == 2
    assert "no such thing" in (folder / "runs/queue/cheap.with.1/log.txt").read_text()


def test_an_interruption_ends_the_processes_and_the_queue_goes_on(folder: Path) -> None:
    (folder / "slow_with").touch()
    command = [sys.executable, "-m", "foredrive", "bench", "--queue", "--folder", "."]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
        _until(lambda: "cheap.with" in _ran(folder))
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=60)
    assert process.returncode == 130, output
    assert "costly" not in "".join(path.name for path in (folder / "results").glob("*.json"))
    (folder / "slow_with").unlink()
    assert main(["bench", "--queue", "--folder", "."]) == 0
    assert len(json.loads((folder / "results/costly.json").read_text())["runs"]) == 4


def test_two_queues_share_the_work(folder: Path) -> None:
    (folder / "slow_with").touch()
    command = [sys.executable, "-m", "foredrive", "bench", "--queue", "--workers", "1", "--folder", "."]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    queues = [subprocess.Popen(command, cwd=folder, **quiet) for _ in range(2)]
    _until(lambda: len(_ran(folder).splitlines()) == 2)
    (folder / "slow_with").unlink()
    assert [queue.wait(timeout=120) for queue in queues] == [0, 0]
    ran = [line.split()[0] for line in _ran(folder).splitlines()]
    assert len(ran) == len(set(ran)) == 5


def test_what_another_queue_measures_is_said(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with held(folder / "runs" / "queue" / "cheap.with.1"):
        assert main(["bench", "--queue", "--folder", "."]) == 0
    assert "another queue measures cheap.with.1" in capsys.readouterr().out
    assert "cheap" not in _ran(folder)
    assert (folder / "results/costly.json").exists()


def _ran(folder: Path) -> str:
    file = folder / "ran.txt"
    return file.read_text() if file.exists() else ""


def _until(condition: object, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.02)


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ("{claim: c, bench: slow, arms: [with], cpu_minutes: 1}", "no benchmark 'slow'"),
        ("{claim: c, bench: cheap, arms: [wth], cpu_minutes: 1}", "cheap has no wth"),
        ("{claim: c, bench: cheap, arms: [with], cpu_minutes: 1, seeds: [7]}", "cheap has no seed 7"),
        (
            "{claim: c, bench: cheap, arms: [with], cpu_minutes: 0}",
            "cpu_minutes: Input should be greater",
        ),
        ("{claim: c, bench: cheap, arms: [with], minutes: 1}", "minutes"),
    ],
)
def test_wrong_entries_are_named(
    folder: Path, entry: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "queue.yaml").write_text(f"- {entry}\n")
    assert main(["bench", "--queue", "--folder", "."]) == 2
    assert said in capsys.readouterr().err


def test_speeds_are_not_queued(tmp_path: Path) -> None:
    (tmp_path / "queue.yaml").write_text("- {claim: c, bench: fast, arms: [a], cpu_minutes: 1}\n")
    with pytest.raises(InputError, match="measures speeds"):
        load_queue(tmp_path / "queue.yaml", {"fast": Benchmark("?", {"a": lambda seed: {}})})
