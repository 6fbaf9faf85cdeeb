"""Drives in a rebuilt log; each is kept as it ends, in the same files as drives in towns."""

import dataclasses
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from foredrive.data.logs import Log
from foredrive.data.maps import read_lane_outlines
from foredrive.errors import InputError
from foredrive.evaluation.summary import write_json, write_summary
from foredrive.rendering.edits import Edit, load_edits
from foredrive.rendering.renderer import RebuiltRenderer
from foredrive.runs.drive.agents import make_driver, needs_of
from foredrive.runs.drive.records import DRIVES, SUITE, SUMMARY, kept_of, read_drive, summarise
from foredrive.runs.folder import held
from foredrive.runs.rebuild.rebuilt_run import (
    OpenRun,
    edited_scene,
    open_rebuilt,
    open_run_log,
    rebuilt_cameras,
)
from foredrive.scene import Agent, Clip, Trajectory
from foredrive.simulation.drive import Drive, Pace, drive_route
from foredrive.simulation.drive_log import rebuilt_drive_log, rebuilt_key_frame
from foredrive.simulation.logged_drive import LoggedDrive
from foredrive.simulation.logged_lanes import LoggedLanes
from foredrive.simulation.observation import FRAME_DT_S
from foredrive.simulation.rebuilt import RebuiltScenario, RebuiltSimulator
from foredrive.simulation.simple_agents import Replay
from foredrive.simulation.threats import Threat, reference_mps, send_threat, threat_score

REPLAY = "log"
"""The driver that goes on as the log was driven."""


@dataclass(frozen=True)
class RebuiltSuite:
    """Who drives in which rebuilt log, from where on, and against what."""

    driver: str
    """`REPLAY`, or as for `drivers.needs_of`; nobody here knows the others from inside."""
    run: str
    """Folder of the reconstruction."""
    starts_s: tuple[float, ...] = ()
    """Times of the log at which drives begin; none: as early as there are frames before."""
    threats: tuple[Threat, ...] = ()
    """A drive for each from every start; none: as the log was."""
    edits: str | None = None
    """File of edits to the scene."""
    sensors: bool = True
    """Drives of drivers that need none are rendered and logged all the same."""
    period_s: float = Pace.period_s
    latency_s: float = Pace.latency_s


@dataclass(frozen=True)
class RebuiltJob:
    """One drive of a suite."""

    start_s: float
    threat: Threat | None

    @property
    def route(self) -> str:
        """Its name."""
        return f"from{self.start_s:g}s" + ("" if self.threat is None else f"_{self.threat}")


def drive_rebuilt(
    suite: RebuiltSuite, out: Path, tick: Callable[[RebuiltJob], None] = lambda job: None
) -> list[dict[str, Any]]:
    """Drive all that does not lie in the folder yet, and write the summary.

    Returns:
        What is kept of each drive, as `kept_drives.read_drive` reads it; under threat with "threat": its
        kind, the speed at which it was hit and would be by who goes on as the log did (m/s), and the score.

    Raises:
        InputError: there is no such driver, run or start, or the folder holds drives of another suite.
    """
    past_frames = 1 if suite.driver == REPLAY else needs_of(suite.driver).past_frames
    opened = open_rebuilt(Path(suite.run))
    edits = [] if suite.edits is None else load_edits(Path(suite.edits))
    jobs = jobs_of(suite, opened, past_frames)
    with held(out):
        _claim(suite, out)
        drives = []
        for job in jobs:
            file = out / DRIVES / f"{job.route}.json"
            if not file.is_file():
                write_json(file, _drive_one(job, suite, opened, edits, past_frames, out))
            drives.append(read_drive(file))
            tick(job)
        write_summary(out / SUMMARY, summarise(drives) | _threat_figures(drives))
    return drives


def jobs_of(suite: RebuiltSuite, opened: OpenRun, past_frames: int) -> list[RebuiltJob]:
    """The drives of a suite."""
    first_s = float(opened.vehicle.t_s[0]) + past_frames * FRAME_DT_S
    return [
        RebuiltJob(start_s, threat)
        for start_s in suite.starts_s or (first_s,)
        for threat in suite.threats or (None,)
    ]


def _drive_one(
    job: RebuiltJob,
    suite: RebuiltSuite,
    opened: OpenRun,
    edits: Sequence[Edit],
    past_frames: int,
    out: Path,
) -> dict[str, Any]:
    began = time.perf_counter()
    edited = edited_scene(opened.scene, list(edits))
    drive = LoggedDrive(opened.vehicle, edited.T_ego_shifted.cpu())
    graph = edited.graph
    if job.threat is not None:
        sent = send_threat(job.threat, graph, drive, job.start_s)
        graph = edited_scene(opened.scene, [*edits, sent]).graph
    renderer = RebuiltRenderer(opened.scene, graph, opened.vehicle)
    lanes = _lanes(opened.folder)
    simulator = RebuiltSimulator(renderer, graph.tracks, drive, lanes)
    sensors = suite.sensors or (suite.driver != REPLAY and needs_of(suite.driver).lidar)
    scenario = RebuiltScenario(job.start_s, sensors, past_frames)
    agent = _driver(suite.driver, simulator)
    route_xyz = drive.route_from(job.start_s)
    with rebuilt_drive_log(renderer.rig if sensors else None, route_xyz, out, job.route) as log:
        driven = drive_route(
            simulator,
            scenario,
            agent,
            route=job.route,
            pace=Pace(suite.period_s, suite.latency_s),
            on_frame=lambda: log.write(rebuilt_key_frame(simulator)),
        )
    kept = kept_of(driven, route_xyz, simulator.length_m, None, time.perf_counter() - began)
    if job.threat is not None:
        kept["threat"] = _under_threat(driven, job.threat, reference_mps(job.threat, drive, job.start_s))
    return kept | {"log": str(log.folder.relative_to(out)), "lanes_known": lanes is not None}


def _lanes(folder: Path) -> LoggedLanes | None:
    """Those of the map of a run's log; None if either is gone, or never was."""
    try:
        outlines = read_lane_outlines(Log(open_run_log(folder)[1]))
    except InputError:
        return None
    return None if outlines is None else LoggedLanes(outlines)


@dataclass(frozen=True, eq=False)
class _Through:
    """An agent that looks through some of the cameras only."""

    agent: Agent
    cameras: list[int]

    def act(self, observation: Clip) -> Trajectory:
        """The plan of the agent."""
        return self.agent.act(observation.through(self.cameras))


def _driver(driver: str, simulator: RebuiltSimulator) -> Agent:
    if driver == REPLAY:
        return Replay(simulator.drive, lambda: simulator.scenario.start_s + simulator.state.t_s)
    agent = make_driver(driver, lambda: simulator.state.t_s)
    there = [name.lower() for name in simulator.renderer.rig.names]
    wanted = [name.lower() for name in needs_of(driver).camera_names or there]
    return _Through(agent, rebuilt_cameras(there, wanted)) if wanted != there else agent


def _under_threat(driven: Drive, threat: Threat, reference: float) -> dict[str, Any]:
    """What a drive through a threat is worth, by its first collision."""
    hits = [event.severity for event in driven.events if event.kind.startswith("collision")]
    impact_mps = hits[0] if hits else None
    score = threat_score(impact_mps, reference)
    return {"kind": threat, "impact_mps": impact_mps, "reference_mps": reference, "score": score}


def _threat_figures(drives: Sequence[dict[str, Any]]) -> dict[str, float | int | str | None]:
    """Mean score, and the share of drives with a collision, for each kind of threat."""
    out: dict[str, float | int | str | None] = {}
    for threat in Threat:
        met = [drive["threat"] for drive in drives if drive.get("threat", {}).get("kind") == threat]
        if met:
            hit = [each["impact_mps"] is not None for each in met]
            out[f"threats.{threat}.score"] = sum(each["score"] for each in met) / len(met)
            out[f"threats.{threat}.collision_share"] = sum(hit) / len(met)
    return out


def _claim(suite: RebuiltSuite, out: Path) -> None:
    """Note in a folder whose it is; more starts and threats may join.

    Raises:
        InputError: it holds the drives of another suite.
    """
    wanted = json.loads(json.dumps(dataclasses.asdict(suite))) | {"routes": suite.run}
    joined = {"starts_s": None, "threats": None}
    if any((out / DRIVES).glob("*.json")):
        try:
            there = json.loads((out / SUITE).read_text()) | joined
        except (OSError, ValueError, TypeError):
            there = None
        if there != wanted | joined:
            raise InputError(f"{out}: holds the drives of another suite; choose another folder")
    write_json(out / SUITE, wanted)
