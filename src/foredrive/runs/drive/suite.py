"""Drives of one agent over all jobs of a source; each drive is saved when it ends.

A suite is a folder: drives/NAME.json is the record of a drive, logs/ has its 123D log, summary.json has the
scores. A drive with a record is not driven again.
"""

import contextlib
import dataclasses
import functools
import json
import tempfile
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch

from foredrive.driving.drive import PlanningTiming, drive_route
from foredrive.driving.drive_record import DriveRecord, record_of
from foredrive.driving.faults import NO_FAULTS, Faults
from foredrive.driving.faulty_agent import FaultyAgent
from foredrive.engine.fan_out import fan_out, reason
from foredrive.engine.folder import DRIVES, SUITE, SUMMARY, RunFolder, by_contents
from foredrive.engine.interrupts import start_fork_server
from foredrive.engine.summary import write_summary
from foredrive.errors import InputError
from foredrive.files import atomic_path, digest_of, together
from foredrive.runs.drive.agent_inputs import inputs_of
from foredrive.runs.drive.agents import agent_folder, check_ready, find_agent, is_foreign
from foredrive.runs.drive.drive_setup import DriveSetup
from foredrive.runs.drive.preflight import try_agent
from foredrive.runs.drive.records import read_drive, read_suite, summarise, write_drive
from foredrive.runs.shipped import run_digest

AGENT_SHA256, ROUTES_SHA256 = "agent_sha256", "routes_sha256"
"""Digests in the file of a suite: of the agent's code and weights, and of the files of its routes."""


@dataclass(frozen=True)
class DriveJob:
    """One drive of a suite."""

    name: str
    """Stem of the names of the drive's files."""
    route: str
    repetition: int = 0


@runtime_checkable
class DriveSource(Protocol):
    """A kind of world to drive in: it lists drives and sets up each one."""

    @property
    def in_turn(self) -> bool:
        """Return whether drives run one after another in this process, because they share a large object."""
        ...

    @property
    def grows(self) -> tuple[str, ...]:
        """Return the names of the fields that a later call may change in the same folder."""
        ...

    def noted(self) -> Mapping[str, object]:
        """Return the fields for JSON; "routes" names the routes, `ROUTES_SHA256` digests their files."""
        ...

    def jobs(self, agent: str) -> Sequence[DriveJob]:
        """Return the drives. Raise InputError if there are none, or there is no such agent."""
        ...

    def set_up(self, job: DriveJob, suite: "DriveSuite", out: Path) -> AbstractContextManager[DriveSetup]:
        """Set up a drive; its log is complete when the context ends. Raise InputError if that fails."""
        ...


@dataclass(frozen=True)
class DriveSuite:
    """An agent, the source of its drives, and its planning period and latency."""

    agent: str
    """Name of the agent; see `agents.inputs_of`."""
    source: DriveSource
    sensors: bool = True
    """Whether cameras and lidar are logged even if the agent does not need them."""
    lidar: bool = True
    """Whether the lidar is among these sensors; in towns alone."""
    period_s: float = PlanningTiming.period_s
    latency_s: float = PlanningTiming.latency_s
    faults: Faults = NO_FAULTS
    """Faults of the agent's inputs."""

    def __post_init__(self) -> None:
        PlanningTiming(self.period_s, self.latency_s)

    def jobs(self) -> Sequence[DriveJob]:
        """Return the drives.

        Raises:
            InputError: there is no such agent, or there are no drives.
        """
        return self.source.jobs(self.agent)

    def noted(self) -> dict[str, object]:
        """Return the contents of the suite's file."""
        of_all = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        del of_all["source"]
        if self.lidar:  # as in folders from before it could be left out
            del of_all["lidar"]
        if self.faults == NO_FAULTS:  # as in folders from before there were faults
            del of_all["faults"]
        else:
            of_all["faults"] = dataclasses.asdict(self.faults)
        if (digest := agent_digest(self.agent)) is not None:
            of_all[AGENT_SHA256] = digest
        noted: dict[str, object] = json.loads(json.dumps({**of_all, **self.source.noted()}))
        return noted


@dataclass(frozen=True)
class SuiteResult:
    """The result of driving a suite."""

    drives: dict[DriveJob, DriveRecord]
    """The record of each drive."""
    skipped: int
    """Number of drives that had a record before."""
    broken: dict[DriveJob, str]
    """The reason for each drive that failed because of the simulator, not the agent. It has no score."""


def drive_suite(
    suite: DriveSuite,
    out: Path,
    workers: int = 1,
    *,
    on_ray: bool = False,
    tick: Callable[[DriveJob, DriveRecord | None], None] = lambda job, drive: None,
    report: Callable[[SuiteResult], object] = lambda driven: None,
    tried: Callable[[str], object] = lambda text: None,
) -> SuiteResult:
    """Drive all jobs that have no record in the folder yet, or failed; write the summary at the end.

    Args:
        workers: number of drives at a time, if the source allows more than one; on Ray as for
            `fan_out.fan_out`.
        tick: called after each drive with its record, or None if the drive broke.
        report: writes the report of a whole suite, which appears together with its summary.
        tried: called with the result of the trial, in words, if the agent is of another program.

    Raises:
        InputError: there is no such agent, it is in another process and not alive, it fails in its trial, or
            there are no drives;
            the folder holds another suite, or another process drives into it; a drive of a source with
            `in_turn` cannot be set up.
        OSError: the disk is full.
    """
    jobs, in_turn = suite.jobs(), suite.source.in_turn
    threads = None if in_turn else max(1, torch.get_num_threads() // workers)
    work = functools.partial(drive_one, suite=suite, out=out, threads=threads)
    drives, broken = dict[DriveJob, DriveRecord](), dict[DriveJob, str]()
    missing = [job for job in jobs if not _driven(out, job)]
    # Before the folder is there: an agent that fails leaves nothing
    if missing and is_foreign(suite.agent):
        check_ready(suite.agent)
        with (
            tempfile.TemporaryDirectory(prefix="foredrive_trial_") as trial,
            suite.source.set_up(missing[0], suite, Path(trial)) as setup,
        ):
            tried(try_agent(suite.agent, setup, suite.period_s, suite.latency_s).text(suite.period_s))
    with folder_of(suite, out).claimed():
        for job in jobs:
            if _driven(out, job):
                drives[job] = read_drive(_file(out, job))
                tick(job, drives[job])
        skipped = len(drives)
        todo = [job for job in jobs if job not in drives]
        if not in_turn:
            start_fork_server(preload=type(suite.source).__module__)  # workers share the imported modules
        inputs = inputs_of(suite.agent)
        sees = inputs.cameras or inputs.lidar
        results = (
            _in_turn(todo, work) if in_turn else fan_out(todo, work, workers, on_ray=on_ray, on_gpu=sees)
        )
        with contextlib.closing(results):
            for job, result in results:
                if isinstance(result, BaseException):
                    broken[job] = reason(job.name, result)
                    tick(job, None)
                else:
                    drives[job] = result
                    tick(job, result)
        driven = SuiteResult({job: drives[job] for job in jobs if job in drives}, skipped, broken)
        if not broken:  # a mean over only some of the drives would mislead
            with together(out):
                write_summary(out / SUMMARY, summarise(list(driven.drives.values())))
                report(driven)
    return driven


def _in_turn(
    jobs: Iterable[DriveJob], work: Callable[[DriveJob], DriveRecord]
) -> Generator[tuple[DriveJob, DriveRecord | BaseException], None, None]:
    for job in jobs:
        yield job, work(job)


def drive_one(job: DriveJob, suite: DriveSuite, out: Path, threads: int | None = None) -> DriveRecord:
    """Drive one route once, and write its files before returning."""
    if threads is not None:
        torch.set_num_threads(threads)
    began = time.perf_counter()
    with suite.source.set_up(job, suite, out) as setup:
        agent = setup.agent
        if suite.faults != NO_FAULTS:
            agent = FaultyAgent(agent, suite.faults, suite.period_s, job.name)
        drive = drive_route(
            setup.simulator,
            setup.scenario,
            agent,
            route=job.route,
            repetition=job.repetition,
            pace=PlanningTiming(suite.period_s, suite.latency_s),
            pilot=setup.pilot,
            on_frame=lambda: setup.log.write(setup.frame()),
        )
    record = record_of(
        drive,
        setup.route_xyz,
        setup.length_m,
        town=setup.town,
        log=str(setup.log.folder.relative_to(out)),
        wall_s=time.perf_counter() - began,
        threat=setup.judge(drive),
        lanes_known=setup.lanes_known,
        trusted_share=setup.trusted_share(),
    )
    write_drive(_file(out, job), record)
    return read_drive(_file(out, job))


def agent_digest(agent: str) -> str | None:
    """Return a digest of an agent's code and weights; None if the package or another process has them.

    Raises:
        InputError: there is no such agent.
    """
    kind, argument = find_agent(agent)
    if kind.sensors == "declared":
        from foredrive.integrations.own_agents import files_of

        return digest_of(files_of(agent))
    if kind.argument != "RUN":
        return None
    return run_digest(agent_folder(agent, argument))


def folder_of(suite: DriveSuite, out: Path) -> RunFolder:
    """Return the folder of a suite. It belongs to another suite while it holds drives of that suite."""
    path, wanted, grows = out / SUITE, suite.noted(), suite.source.grows
    contents = {
        AGENT_SHA256: f"the drives of another version of {suite.agent}",
        ROUTES_SHA256: f"the drives of another version of {wanted['routes']}",
    }

    def fixed(noted: Mapping[str, object]) -> dict[str, object]:
        kept = {key: value for key, value in noted.items() if key not in grows}
        return by_contents(kept, "the drives of another suite", contents)

    def noted_there() -> dict[str, object] | None:
        # Drives that failed are driven again, so they hold nothing
        if all(_failed(file) for file in (out / DRIVES).glob("*.json")):
            return None
        try:
            return read_suite(out)
        except InputError as error:
            raise InputError(f"{error}, but there are drives beside it; choose another folder") from error

    def read() -> dict[str, object] | None:
        note = noted_there()
        return None if note is None else fixed(note)

    def write() -> None:
        old, note = noted_there() or {}, dict(wanted)
        for key in grows:
            before, now = old.get(key), note[key]
            if isinstance(before, int) and isinstance(now, int):
                note[key] = max(before, now)
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(note, indent=1) + "\n")

    return RunFolder(out, fixed(wanted), read, write, grows=True)


def _driven(out: Path, job: DriveJob) -> bool:
    """Return whether there is the record of a drive that did not fail."""
    file = _file(out, job)
    return file.is_file() and not _failed(file)


def _failed(file: Path) -> bool:
    """Return whether a file is the record of a drive in which the agent failed."""
    try:
        return read_drive(file).score.failed
    except InputError:  # whoever uses the drive is told what is wrong
        return False


def _file(out: Path, job: DriveJob) -> Path:
    return out / DRIVES / f"{job.name}.json"
