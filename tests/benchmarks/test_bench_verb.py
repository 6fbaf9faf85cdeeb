"""Benchmarks from the command line."""

import json
from pathlib import Path

import pytest

from foredrive.cli.main import main

SOURCE = """
from benchmarks.common.benchmark import Benchmark

def measure(seed):
    with open(__file__.replace("speed.py", "ran.txt"), "a") as file:
        file.write(f"{seed} ")
    if seed == STOP_AT:
        raise KeyboardInterrupt
    return {"sum_ms": 2.0 + seed}

STOP_AT = None
BENCHMARK = Benchmark("How fast is it?", {"plain": measure}, seeds=(0, 1))
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "speed.py").write_text(SOURCE)
    return tmp_path


def test_without_a_name_benchmarks_are_listed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "script.py").write_text("")
    assert main(["bench", "--folder", str(folder)]) == 0
    script = f"script: a separate script; run it with python {folder / 'script.py'}\n"
    assert capsys.readouterr().out == script + "speed: How fast is it?\n    arms: plain\n"
    assert not (folder / "ran.txt").exists()


def test_names_have_hyphens_where_files_have_underscores(folder: Path) -> None:
    (folder / "speed.py").rename(folder / "top_speed.py")
    for name in ("top-speed", "top_speed"):
        assert main(["bench", name, "--folder", str(folder)]) == 0
    assert [path.name for path in (folder / "results").iterdir()] == ["top-speed.json"]


def test_an_interrupted_benchmark_goes_on_where_it_stopped(folder: Path) -> None:
    source = folder / "speed.py"
    source.write_text(SOURCE.replace("STOP_AT = None", "STOP_AT = 1"))
    assert main(["bench", "speed", "--folder", str(folder)]) == 130
    source.write_text(SOURCE)
    assert main(["bench", "speed", "--folder", str(folder)]) == 0
    assert (folder / "ran.txt").read_text() == "0 1 1 "  # seed 0 was measured once
    results = json.loads((folder / "results" / "speed.json").read_text())
    assert results["figures"]["plain"]["sum_ms"]["mean"] == 2.5
    assert {"commit", "command", "machine.cpu"} <= set(results)


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["sped"], "no benchmark 'sped' in {folder}; there are: speed"),
        (["speed", "--arms", "fancy"], "speed has no arm fancy; it has plain"),
        (["--folder", "{folder}/none"], "{folder}/none: no benchmarks here"),
        (["empty"], "{folder}/empty.py: defines no BENCHMARK"),
    ],
)
def test_what_is_not_there_is_named(
    args: list[str], said: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if args == ["empty"]:
        (folder / "empty.py").write_text("")
    filled = [each.format(folder=folder) for each in args]
    where = [] if "--folder" in filled else ["--folder", str(folder)]
    assert main(["bench", *filled, *where]) == 2
    assert said.format(folder=folder) in capsys.readouterr().err
