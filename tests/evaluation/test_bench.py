"""Benchmarks: arm by arm, seed by seed, stored as they come in."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path

import pytest

from foredrive.errors import InputError
from foredrive.evaluation.bench import Benchmark, run_benchmark


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
