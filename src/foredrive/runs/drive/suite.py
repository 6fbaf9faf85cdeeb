"""Drives of one driver over a set of routes, over processes or over Ray; each is kept as it ends.

A suite is a folder: drives/NAME.json is all that came of a drive, logs/ has it as a 123D log, summary.json
has the scores. What lies there is not driven again.
"""

import contextlib
import dataclasses
import functools
import json
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from foredrive.errors import InputError
from foredrive.evaluation.summary import write_json, write_summary
from foredrive.files import atomic_path
from foredrive.runs.drive.agents import make_driver, needs_of
from foredrive.runs.drive.records import DRIVES, SUITE, SUMMARY, kept_of, read_drive, summarise
from foredrive.runs.fan_out import fan_out, reason
from foredrive.runs.folder import held
from foredrive.simulation.drive import Pace, drive_route
from foredrive.simulation.drive_log import drive_log, key_frame
from foredrive.simulation.lessons import Alternating, Disturbed
from foredrive.simulation.route_sets import load_route_set
from foredrive.simulation.routes import DriveRoute, snap_route
from foredrive.simulation.scenarios.places import scenarios_on
from foredrive.simulation.scores import timeout_s
from foredrive.simulation.town import TownScenario, TownSimulator, grow
from foredrive.towns.campaign import ANY_CONDITIONS
from foredrive.towns.conditions import CONDITIONS, find_conditions
from foredrive.towns.recorder import Crowd
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.sensing.rig import camera_rig, roof_lidar


@dataclass(frozen=True)
class DriveSuite:
    """Who drives what, and under which circumstances."""

    driver: str
    """See `drivers.needs_of`."""
    routes: str
    """A set that comes with the package, or a CARLA route file."""
    repetitions: int = 1
    seed: int = 0
    """Of the place and the traffic in the first repetition; the next has the next."""
    conditions: str | None = None
    """A name, or `ANY_CONDITIONS`: drawn for each drive; None draws bright daylight from the seed."""
    sensors: bool = True
    """Drives of drivers that need none are logged with cameras and lidar all the same."""
    image_hw: tuple[int, int] = (144, 256)
    vehicles: int = Crowd.vehicles
    people: int = Crowd.people
    scenarios: bool = True
    """Whether others brake, cut in, run lights and step out on the way, as the seed decides."""
    period_s: float = Pace.period_s
    latency_s: float = Pace.latency_s

    def __post_init__(self) -> None:
        Pace(self.period_s, self.latency_s)
        if self.repetitions < 1:
            raise InputError(f"routes are driven once or more, got {self.repetitions} repetitions")
        if self.conditions not in (None, ANY_CONDITIONS, *CONDITIONS):
            there_are = ", ".join((ANY_CONDITIONS, *CONDITIONS))
            raise InputError(f"no conditions are named {self.conditions}; there are {there_are}")


@dataclass(frozen=True)
class DriveJob:
    """One drive of a suite."""

    route: str
    """Its id in the set."""
    repetition: int

    @property
    def name(self) -> str:
        """Of the drive's files."""
        return f"route{self.route}_rep{self.repetition}"


@dataclass(frozen=True)
class Driven:
    """What came of a suite."""

    drives: dict[DriveJob, dict[str, Any]]
    """What was kept of each drive."""
    skipped: int
    """How many lay there before."""
    broken: dict[DriveJob, str]
    """Drives that the simulator, not the driver, failed at; they have no score."""


def drive_suite(
    suite: DriveSuite,
    out: Path,
    workers: int,
    *,
    on_ray: bool = False,
    tick: Callable[[DriveJob, dict[str, Any] | None], None] = lambda job, drive: None,
) -> Driven:
    """Drive all that does not lie in the folder yet, and write the summary once all are there.

    Args:
        workers: drives at a time; on Ray as for `fan_out.fan_out`.
        tick: told of each drive as it is done with, None if it broke.

    Raises:
        InputError: there is no such driver or set of routes, or the folder holds another suite, or another
            process drives into it.
        OSError: the disk is full.
    """
    needs_of(suite.driver)
    load_route_set(suite.routes)
    with held(out):
        return _drive_rest(suite, out, workers, on_ray, tick)


def _drive_rest(
    suite: DriveSuite,
    out: Path,
    workers: int,
    on_ray: bool,
    tick: Callable[[DriveJob, dict[str, Any] | None], None],
) -> Driven:
    claim(suite, out)
    routes = load_route_set(suite.routes)
    jobs = [DriveJob(route.id, n) for n in range(suite.repetitions) for route in routes]
    drives, broken = {}, {}
    for job in jobs:
        if _file(out, job).is_file():
            drives[job] = read_drive(_file(out, job))
            tick(job, drives[job])
    skipped = len(drives)
    threads = max(1, torch.get_num_threads() // workers)
    work = functools.partial(drive_one, suite=suite, out=out, threads=threads)
    todo = [job for job in jobs if job not in drives]
    with contextlib.closing(fan_out(todo, work, workers, on_ray=on_ray)) as results:
        for job, result in results:
            if isinstance(result, BaseException):
                broken[job] = reason(job.name, result)
                tick(job, None)
            else:
                drives[job] = result
                tick(job, result)
    driven = Driven({job: drives[job] for job in jobs if job in drives}, skipped, broken)
    if not broken:  # a mean over what happened to work would be none of the suite
        write_summary(out / SUMMARY, summarise(list(driven.drives.values())))
    return driven


def drive_one(job: DriveJob, suite: DriveSuite, out: Path, threads: int) -> dict[str, Any]:
    """Drive one route once; its files are there when this returns."""
    torch.set_num_threads(threads)
    began = time.perf_counter()
    route = snap_route(next(r for r in load_route_set(suite.routes) if r.id == job.route))
    simulator, scenario = TownSimulator(), scenario_of(suite, route, job.repetition)
    lot = _lot(scenario.seed, job.route)
    agent = make_driver(suite.driver, lambda: simulator.state.t_s, simulator, lot)
    with drive_log(scenario, out, job.name) as log:

        def write_frame() -> None:
            taught = agent.teacher.plan() if isinstance(agent, Disturbed | Alternating) else None
            log.write(key_frame(simulator, taught))

        drive = drive_route(
            simulator,
            scenario,
            agent,
            route=job.route,
            repetition=job.repetition,
            pace=Pace(suite.period_s, suite.latency_s),
            on_frame=write_frame,
        )
    wall_s = time.perf_counter() - began
    kept = kept_of(drive, route.xyz, route.length_m, route.town, wall_s) | {
        "log": str(log.folder.relative_to(out))
    }
    write_json(_file(out, job), kept)
    return read_drive(_file(out, job))


def scenario_of(suite: DriveSuite, route: DriveRoute, repetition: int) -> TownScenario:
    """The circumstances of one drive."""
    needs = needs_of(suite.driver)
    seen = needs.lidar or suite.sensors
    seed = suite.seed + repetition
    name = suite.conditions
    if name == ANY_CONDITIONS:
        name = list(CONDITIONS)[_lot(seed, route.id) % len(CONDITIONS)]
    happens = scenarios_on(route, grow(route.town, seed), seed) if suite.scenarios else ()
    return TownScenario(
        town=route.town,
        route_xyz=route.xyz,
        seed=seed,
        lanes=route.lanes,
        crowd=Crowd(suite.vehicles, suite.people),
        conditions=None if name is None else find_conditions(name),
        sensors=SensorSuite(camera_rig(suite.image_hw), roof_lidar()) if seen else None,
        past_frames=needs.past_frames,
        limit_s=timeout_s(route.length_m),
        scenarios=happens,
    )


def _lot(seed: int, route: str) -> int:
    """A number drawn for a drive, always the same."""
    return zlib.crc32(f"{seed} {route}".encode())


def claim(suite: DriveSuite, out: Path) -> None:
    """Note in a folder whose it is, once it is known that there is something to drive.

    Raises:
        InputError: it is another's, or there is no such driver or set of routes.
    """
    needs_of(suite.driver)
    load_route_set(suite.routes)
    wanted = json.loads(json.dumps(dataclasses.asdict(suite)))
    path = out / SUITE
    if any((out / DRIVES).glob("*.json")):
        there = _read_suite(path)
        if there is None:
            raise InputError(f"{out}: holds drives that nobody knows the suite of; choose another folder")
        if {**there, "repetitions": 0} != {**wanted, "repetitions": 0}:
            raise InputError(f"{out}: holds the drives of another suite; choose another folder")
        wanted["repetitions"] = max(there["repetitions"], suite.repetitions)
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(wanted, indent=1) + "\n")


def _read_suite(path: Path) -> dict[str, Any] | None:
    try:
        there = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return there if isinstance(there, dict) and isinstance(there.get("repetitions"), int) else None


def _file(out: Path, job: DriveJob) -> Path:
    return out / DRIVES / f"{job.name}.json"
