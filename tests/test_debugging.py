"""`--verbose` and `--profile`."""

import gzip
import json
import logging
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from full_disk import files_up_to

from foredrive import debugging
from foredrive.cli.main import main
from foredrive.debugging import ProfilePlan, take_debugging
from foredrive.errors import InputError


@pytest.fixture(autouse=True)
def own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in (debugging.VERBOSE, debugging.PROFILE):
        monkeypatch.setenv(variable, "")
        monkeypatch.delenv(variable)
    monkeypatch.setattr(debugging._Recording, "current", None)


def busy_for(seconds: float) -> float:
    """Work in PyTorch and in Python's own functions, in steps."""
    end, total = time.monotonic() + seconds, 0.0
    while time.monotonic() < end:
        total += float(torch.ones(8, 8).matmul(torch.ones(8, 8)).sum()) + sum_of_squares(20)
        debugging.profile_step()
        time.sleep(0.005)  # few operators: each one takes memory in the trace
    return total


def sum_of_squares(n: int) -> float:
    return float(np.square(np.arange(n)).sum())


def events(file: Path) -> set[str]:
    trace = json.loads(gzip.decompress(file.read_bytes()))
    return {event["name"] for event in trace["traceEvents"]}


def test_flags_go_with_every_verb_at_any_place() -> None:
    rest = take_debugging(["--verbose", "train", "nemo_tiny", "--profile", "b.json.gz:1:2", "--out", "c"])
    assert rest == ["train", "nemo_tiny", "--out", "c"]
    assert debugging.is_verbose()
    plan = ProfilePlan.parse(os.environ[debugging.PROFILE])
    assert plan == ProfilePlan(Path("b.json.gz").absolute(), 1.0, 2.0)
    assert take_debugging(["models"]) == ["models"]
    assert not debugging.is_verbose()
    assert debugging.PROFILE not in os.environ


@pytest.mark.parametrize(
    "text", ["", "a.json", "a.json.gz:x", "a.json.gz:0", "a.json.gz:1:2:3", "a.json.gz:1:nan"]
)
def test_profiles_that_are_not_understood_are_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"--profile takes FILE\.json\.gz"):
        take_debugging(["train", "--profile", text])


def test_trace_that_cannot_be_written_is_refused_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--profile: .*nowhere: no such folder"):
        take_debugging(["train", "--profile", str(tmp_path / "nowhere" / "trace.json.gz")])


def test_full_disk_costs_the_trace_and_not_the_work(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    take_debugging(["train", f"--profile={tmp_path / 'trace.json.gz'}:0.1:0.2"])
    with files_up_to(1000), debugging.debugging():
        assert busy_for(1.0) > 0
    assert "trace.json.gz was not written: " in caplog.text
    assert not list(tmp_path.iterdir())


def test_trace_has_operators_and_functions(tmp_path: Path) -> None:
    take_debugging(["train", f"--profile={tmp_path / 'trace.json.gz'}:0.1:0.3"])
    with debugging.debugging():
        busy_for(1.0)
    names = events(tmp_path / "trace.json.gz")
    assert "aten::matmul" in names
    assert any("sum_of_squares" in name for name in names)
    assert [file.name for file in tmp_path.iterdir()] == ["trace.json.gz"]


def test_each_command_of_a_process_has_its_trace(tmp_path: Path) -> None:
    for name in ("first", "second"):
        take_debugging(["train", f"--profile={tmp_path / name}.json.gz:0.05:0.1"])
        with debugging.debugging():
            busy_for(0.3)
        assert "aten::matmul" in events(tmp_path / f"{name}.json.gz")


def test_command_that_ends_within_the_recording_writes_it(tmp_path: Path) -> None:
    take_debugging(["train", f"--profile={tmp_path / 'trace.json.gz'}:0.1:60"])
    with debugging.debugging():
        busy_for(0.5)
    assert "aten::matmul" in events(tmp_path / "trace.json.gz")


def test_command_that_ends_before_its_recording_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    take_debugging(["train", f"--profile={tmp_path / 'trace.json.gz'}:60"])
    with debugging.debugging():
        pass
    assert "was not written: no step of this process began after 60 s" in caplog.text
    assert not list(tmp_path.iterdir())


def test_each_worker_writes_a_trace_of_its_own(tmp_path: Path) -> None:
    # In a process of its own: workers have the environment of the first fork server
    program = (
        "from test_debugging import busy_for\n"
        "from foredrive.debugging import take_debugging\n"
        "from foredrive.engine.fan_out import fan_out\n"
        f"take_debugging(['drive', '--profile={tmp_path / 'trace.json.gz'}:0.1:60'])\n"
        "print([result for _, result in fan_out([1.0, 1.0, 1.0, 1.0], busy_for, 2)])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=Path(__file__).parent, capture_output=True, text=True, check=True
    )
    assert all(result > 0 for result in json.loads(done.stdout))
    files = sorted(tmp_path.iterdir())
    assert 1 <= len(files) <= 2  # one worker may do everything
    assert all(file.name.startswith("trace.") and "aten::matmul" in events(file) for file in files)


def test_verbose_shows_where_an_error_comes_from(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "no_such_recipe", "--logs", "nowhere", "--out", "x"]) == 2
    assert "Traceback" not in capsys.readouterr().err
    assert main(["--verbose", "train", "no_such_recipe", "--logs", "nowhere", "--out", "x"]) == 2
    said = capsys.readouterr().err
    assert "Traceback" in said
    assert said.rstrip().splitlines()[-1].startswith("foredrive: ")
    assert logging.getLogger("foredrive").level == logging.NOTSET  # later commands of this process are quiet
