"""SIGKILL at random moments: the same command goes on, and ends with what an undisturbed one has.

`foredrive bench faults` kills more verbs more often.
"""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
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
import foredrive.runs.convert, foredrive.runs.train.run, foredrive.engine.fabric
from miniature import miniature
from foredrive.runs.recipes.known import RECIPES
RECIPES["miniature"] = miniature()
"""
FANNED_OUT = """
import contextlib, os, sys, time
from pathlib import Path
from foredrive.cli import main as program
from foredrive.files import atomic_path
from foredrive.engine.fan_out import fan_out
def work(seconds):
    with atomic_path(Path("out", str(seconds))) as temporary:
        temporary.write_text("half")
        os.write(1, b"working\\n")  # at once: the lines of two workers share a pipe
        time.sleep(seconds)
def fan():
    with contextlib.closing(fan_out([600.0, 601.0], work, 2)) as results:
        for job, _ in results:
            pass
if __name__ == "__main__":
    program.VERBS = {"fan": fan, "other": fan}
    sys.exit(program.main(["fan"]))
"""
GONE_S = 5.0
"""Time in which workers end; they take a fifth of a second, but the machine may be busy."""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ProgramServer]:
    scratch = tmp_path_factory.mktemp("programs")
    (scratch / "tmp").mkdir()
    server = ProgramServer(scratch, PRELUDE, [TESTS, TESTS / "data"], temporary=scratch / "tmp")
    yield server
    server.close()


@pytest.mark.slow
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


@contextlib.contextmanager
def fanned_out(folder: Path) -> Iterator["subprocess.Popen[str]"]:
    """A program with two workers."""
    (folder / "program.py").write_text(FANNED_OUT)
    # The names of sockets in it have at most 108 characters, which pytest's folders may exceed by themselves.
    short = Path(tempfile.mkdtemp())
    (folder / "tmp").symlink_to(short)
    program = subprocess.Popen(
        [sys.executable, folder / "program.py"],
        cwd=folder,
        env=os.environ | {"TMPDIR": str(short)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        yield program
    finally:
        for pid in in_session(program.pid):
            os.kill(pid, signal.SIGKILL)
        program.communicate()
        shutil.rmtree(short, ignore_errors=True)


def wait_for_the_end(program: "subprocess.Popen[str]") -> str:
    """What it said, once it and all of its workers have ended."""
    _, said = program.communicate(timeout=60)
    until_s = time.monotonic() + GONE_S
    while in_session(program.pid) and time.monotonic() < until_s:
        time.sleep(0.05)
    assert not in_session(program.pid)
    return said


def left(folder: Path) -> list[str]:
    return [path.name for part in ("tmp", "out") for path in (folder / part).glob("*")]


@pytest.mark.parametrize("to_all", [False, True])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_workers_end_at_once_with_their_parent(number: signal.Signals, to_all: bool, tmp_path: Path) -> None:
    """With their unfinished files, and with the folder of the sockets; a worker that is killed cannot."""
    with fanned_out(tmp_path) as program:
        assert program.stdout is not None
        assert [program.stdout.readline() for _ in range(2)] == ["working\n"] * 2
        (os.killpg if to_all else os.kill)(program.pid, number)
        said = wait_for_the_end(program)
    if number == signal.SIGKILL:
        assert program.returncode == -signal.SIGKILL
        assert "Traceback" not in said
        assert to_all or left(tmp_path) == []
    else:
        assert (program.returncode, said) == (130, "foredrive: interrupted\n")
        assert left(tmp_path) == []


def test_an_interruption_while_workers_start_is_one_line(tmp_path: Path) -> None:
    for number, after_s in enumerate((0.0, 0.1, 0.3, 0.6)):
        folder = tmp_path / str(number)
        folder.mkdir()
        with fanned_out(folder) as program:
            until_s = time.monotonic() + 60
            while not list((folder / "tmp").glob("pymp-*")) and time.monotonic() < until_s:
                time.sleep(0.01)
            time.sleep(after_s)
            os.killpg(program.pid, signal.SIGINT)
            said = wait_for_the_end(program)
        assert (program.returncode, said) == (130, "foredrive: interrupted\n"), after_s
        assert left(folder) == []
