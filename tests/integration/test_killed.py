"""SIGKILL at random moments: the same command goes on, and ends with what an undisturbed one has.

`foredrive bench faults` kills more verbs more often.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.common.killing import Command, contents, kill_and_compare
from benchmarks.common.process_tree import in_session
from benchmarks.common.program_server import ProgramServer
from foredrive.data import LogPath
from foredrive.runs import Run

TESTS = Path(__file__).parents[1]
PRELUDE = """
import foredrive.runs.convert, foredrive.runs.train.run, foredrive.training.fabric
from miniature import miniature
from foredrive.recipes import RECIPES
RECIPES["miniature"] = miniature()
"""
FANNED_OUT = """
import sys, time
from foredrive.runs.fan_out import fan_out
def work(seconds):
    time.sleep(seconds)
if __name__ == "__main__":
    for job, _ in fan_out([0.0, 600.0], work, 2):
        print(job, flush=True)
"""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ProgramServer]:
    scratch = tmp_path_factory.mktemp("programs")
    (scratch / "tmp").mkdir()
    server = ProgramServer(scratch, PRELUDE, [TESTS, TESTS / "data"], temporary=scratch / "tmp")
    yield server
    server.close()


def test_train(server: ProgramServer, log: LogPath, tmp_path: Path) -> None:
    arguments = ("train", "miniature", "--logs", str(log.folder), "--out", str(tmp_path / "run"))
    command = Command("train", arguments, tmp_path / "run")
    found = kill_and_compare(command, server, tmp_path / "none", kills=4, kills_a_run=2, seed=0)
    assert found.kills == 4
    assert found.files > 20
    assert (found.lost, found.half_written, found.scratch_left, found.orphans) == (0, 0, 0, 0)


def test_a_difference_is_found(trained: Run, tmp_path: Path) -> None:
    """Nothing but times is left out of the comparison."""
    run = Path(shutil.copytree(trained.folder, tmp_path / "run"))
    found, metrics = contents(run), run / "pretrain/metrics.jsonl"
    for field, same in (("cpu_s", True), ("loss", False)):
        lines = [json.loads(line) for line in metrics.read_text().splitlines()]
        lines[1][field] += 1.0
        metrics.write_text("".join(json.dumps(line) + "\n" for line in lines))
        assert (contents(run) == found) is same


def test_workers_end_with_a_killed_parent(tmp_path: Path) -> None:
    """Those that wait for work too: nobody else ends them."""
    program = tmp_path / "fanned_out.py"
    program.write_text(FANNED_OUT)
    parent = subprocess.Popen([sys.executable, program], stdout=subprocess.PIPE, start_new_session=True)
    assert parent.stdout is not None
    assert parent.stdout.readline() == b"0.0\n"
    assert len(in_session(parent.pid)) > 3
    os.kill(parent.pid, signal.SIGKILL)
    parent.communicate()
    until_s = time.monotonic() + 60.0
    while in_session(parent.pid) and time.monotonic() < until_s:
        time.sleep(0.1)
    assert not in_session(parent.pid)
