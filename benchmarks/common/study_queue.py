"""A queue of studies: what decides most for its computing time is measured first, one process a core.

The file of the queue names claims, the arms of the benchmarks that decide them, and what an arm costs. The
studies keep their own results (`common.benchmark`), so that a queue goes on after an interruption, at another
commit, and beside other queues in the same folder.
"""

import contextlib
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import Field

from benchmarks.common.benchmark import Benchmark, measured_before
from foredrive.engine.config import validated
from foredrive.engine.folder import held
from foredrive.errors import InputError
from foredrive.plain_yaml import read_yaml

CLAIMS = Path("runs/queue")
"""Folder of the locks and logs of measurements, below the working directory."""
_POLL_S = 0.2
_TRIES = 2


@dataclass(frozen=True)
class QueuedStudy:
    """Arms of a benchmark that decide a claim together."""

    claim: str
    """The claim in one line, for people."""
    bench: str
    """Name of the benchmark."""
    arms: tuple[str, ...]
    cpu_minutes: Annotated[float, Field(gt=0)]
    """Computing time of one arm with one seed, on one core."""
    seeds: tuple[int, ...] | None = None
    """Seeds that are wanted; None: those of the benchmark."""
    value: Annotated[float, Field(gt=0)] = 1.0
    """Worth of the claim beside the others."""


class Measurement(NamedTuple):
    """One arm of a benchmark with one seed."""

    bench: str
    arm: str
    seed: int
    cpu_minutes: float
    claim: str

    @property
    def name(self) -> str:
        """Return a name for people and files."""
        return f"{self.bench}.{self.arm}.{self.seed}"


def load_queue(path: Path, benchmarks: Mapping[str, Benchmark]) -> list[QueuedStudy]:
    """Read a queue.

    Args:
        path: a YAML list of the entries of `QueuedStudy`.
        benchmarks: all benchmarks by name.

    Raises:
        InputError: the file cannot be read, an entry is wrong, or there is no such benchmark, arm or seed.
    """
    written = read_yaml(path, "a queue of studies")
    studies: list[QueuedStudy] = validated(list[QueuedStudy], written, str(path), "queue of studies")
    for study in studies:
        benchmark = benchmarks.get(study.bench)
        if benchmark is None:
            raise InputError(f"{path}: no benchmark {study.bench!r}")
        unknown = [arm for arm in study.arms if arm not in benchmark.arms]
        unknown += [f"seed {seed}" for seed in study.seeds or () if seed not in benchmark.seeds]
        if unknown:
            raise InputError(f"{path}: {study.bench} has no {', '.join(unknown)}")
        if benchmark.decided_by is None:
            raise InputError(f"{path}: {study.bench} measures speeds, which busy cores would spoil")
    return studies


def missing_measurements(
    studies: Sequence[QueuedStudy], benchmarks: Mapping[str, Benchmark], results: Path
) -> list[Measurement]:
    """Return what is not measured yet, most value for the computing time that is left first.

    The measurements of one claim stay together, seed by seed, because a claim is decided by all of them.
    """
    left: list[tuple[float, list[Measurement]]] = []
    for study in studies:
        benchmark = benchmarks[study.bench]
        measured = measured_before(study.bench, benchmark, results)
        missing = [
            Measurement(study.bench, arm, seed, study.cpu_minutes, study.claim)
            for seed in study.seeds or benchmark.seeds
            for arm in study.arms
            if (arm, seed) not in measured
        ]
        if missing:
            left.append((study.value / (study.cpu_minutes * len(missing)), missing))
    left.sort(key=lambda of_study: -of_study[0])
    # An arm that decides two claims is measured once
    return list({one.name: one for _, missing in left for one in missing}.values())


@dataclass
class _Running:
    """A measurement in a process of its own."""

    of: Measurement
    process: subprocess.Popen[bytes]
    core: int
    locks: ExitStack
    log: Path
    started: float = field(default_factory=time.monotonic)


def run_queue(
    missing: Callable[[], list[Measurement]],
    command: Callable[[Measurement], list[str]],
    cores: Sequence[int],
    *,
    say: Callable[[str], None] = print,
) -> list[str]:
    """Measure until nothing is missing, one process on each core; return the names of what failed.

    What failed is tried once more at the end.

    Args:
        missing: returns what is missing, in the order of `missing_measurements`.
        command: returns the arguments of a Python process that makes a measurement.
        cores: cores by number.
        say: called with one line about each measurement.
    """
    running: list[_Running] = []
    failures: Counter[str] = Counter()
    try:
        left = missing()
        while True:
            ended = [one for one in running if one.process.poll() is not None]
            for one in ended:
                running.remove(one)
                one.locks.close()
                minutes = (time.monotonic() - one.started) / 60
                if one.process.returncode == 0:
                    say(f"{one.of.name}: done in {minutes:.1f} minutes")
                else:
                    failures[one.of.name] += 1
                    say(f"{one.of.name}: failed, {_last_line(one.log)}")
            left = missing() if ended else left
            todo = [one for one in left if failures[one.name] == 0]
            if not todo and not running:
                # They may have met others at a shared part, such as a recording: once more, alone
                todo = [one for one in left if failures[one.name] < _TRIES][:1]
            for core in [core for core in cores if core not in [one.core for one in running]]:
                started = _start_first(todo, [one.of.name for one in running], core, command)
                if started is not None:
                    running.append(started)
                    say(f"{started.of.name}: about {started.of.cpu_minutes:.0f} minutes; {started.of.claim}")
            if not running:
                if elsewhere := [one.name for one in left if not failures[one.name]]:
                    say(f"another queue measures {', '.join(elsewhere)}")
                return sorted(one.name for one in left if failures[one.name])
            time.sleep(_POLL_S)
    finally:
        for one in running:
            one.process.terminate()
        for one in running:
            one.process.wait()
            one.locks.close()


def _start_first(
    todo: Sequence[Measurement], busy: Sequence[str], core: int, command: Callable[[Measurement], list[str]]
) -> _Running | None:
    """Start the first measurement that nobody makes, on a core; return None if there is none."""
    for one in todo:
        if one.name in busy:
            continue
        locks, folder = ExitStack(), CLAIMS / one.name
        with contextlib.suppress(InputError):
            # Another queue of this folder may make it
            locks.enter_context(held(folder))
            log = folder / "log.txt"
            with log.open("wb") as output, _pinned(core):
                process = subprocess.Popen(
                    [sys.executable, *command(one)],
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
                )
            return _Running(one, process, core, locks, log)
    return None


@contextlib.contextmanager
def _pinned(core: int) -> Iterator[None]:
    """Bind processes that start in the block to a core."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def _last_line(log: Path) -> str:
    """Return the last line of a log, with its path."""
    lines = log.read_text(errors="replace").splitlines() or ["without a word"]
    return f"{lines[-1]} ({log})"
