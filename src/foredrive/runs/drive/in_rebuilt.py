"""Drives in a rebuilt log."""

import contextlib
import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from foredrive.data.logs import Log
from foredrive.data.maps import read_lane_outlines
from foredrive.errors import InputError
from foredrive.rendering.edits import Edit, load_edits
from foredrive.rendering.renderer import RebuiltRenderer
from foredrive.runs.drive.agents import make_driver, needs_of
from foredrive.runs.drive.suite import DriveJob, DriveSuite, Stage
from foredrive.runs.rebuild.rebuilt_run import (
    OpenRun,
    edited_scene,
    open_rebuilt,
    open_run_log,
    rebuilt_cameras,
)
from foredrive.scene import Agent, Clip, Trajectory
from foredrive.simulation.drive import Drive
from foredrive.simulation.drive_log import rebuilt_drive_log, rebuilt_key_frame
from foredrive.simulation.drive_record import ThreatMet
from foredrive.simulation.logged_drive import LoggedDrive
from foredrive.simulation.logged_lanes import LoggedLanes
from foredrive.simulation.observation import FRAME_DT_S
from foredrive.simulation.rebuilt import RebuiltScenario, RebuiltSimulator
from foredrive.simulation.route_progress import RouteLine
from foredrive.simulation.simple_agents import Replay
from foredrive.simulation.threats import Threat, reference_mps, send_threat, threat_score

REPLAY = "log"
"""The driver that goes on as the log was driven."""


@dataclass(frozen=True)
class RebuiltRoutes:
    """A `Source`: a rebuilt log, from where on it is driven in, and against what."""

    run: str
    """Folder of the reconstruction."""
    starts_s: tuple[float, ...] = ()
    """Times of the log at which drives begin; none: as early as there are frames before."""
    threats: tuple[Threat, ...] = ()
    """A drive for each from every start; none: as the log was."""
    edits: str | None = None
    """File of edits to the scene."""

    in_turn = True
    grows = ("starts_s", "threats")

    def noted(self) -> Mapping[str, object]:
        """The fields; the log's way is the route."""
        return {**dataclasses.asdict(self), "routes": self.run}

    def jobs(self, driver: str) -> Sequence[DriveJob]:
        """A drive for each start and threat."""
        past_frames = _past_frames(driver)
        _edits_of(self.edits)
        return [job for job, _, _ in self._plan(past_frames)]

    def _plan(self, past_frames: int) -> list[tuple[DriveJob, float, Threat | None]]:
        first_s = float(_opened(self.run).vehicle.t_s[0]) + past_frames * FRAME_DT_S
        plan = []
        for start_s in self.starts_s or (first_s,):
            for threat in self.threats or (None,):
                name = f"from{start_s:g}s" + ("" if threat is None else f"_{threat}")
                plan.append((DriveJob(name, name), start_s, threat))
        return plan

    @contextlib.contextmanager
    def stage(self, job: DriveJob, suite: DriveSuite, out: Path) -> Iterator[Stage]:
        """Set a drive up in the scene."""
        opened, edits, past_frames = _opened(self.run), _edits_of(self.edits), _past_frames(suite.driver)
        _, start_s, threat = next(each for each in self._plan(past_frames) if each[0] == job)
        edited = edited_scene(opened.scene, edits)
        drive = LoggedDrive(opened.vehicle, edited.T_ego_shifted.cpu())
        graph = edited.graph
        if threat is not None:
            sent = send_threat(threat, graph, drive, start_s)
            graph = edited_scene(opened.scene, [*edits, sent]).graph
        renderer = RebuiltRenderer(opened.scene, graph, opened.vehicle)
        lanes = _lanes(opened.folder)
        simulator = RebuiltSimulator(renderer, graph.tracks, drive, lanes)
        sensors = suite.sensors or (suite.driver != REPLAY and needs_of(suite.driver).lidar)
        agent = _driver(suite.driver, simulator)
        route_xyz = drive.route_from(start_s)
        with rebuilt_drive_log(renderer.rig if sensors else None, route_xyz, out, job.name) as log:
            yield Stage(
                simulator,
                RebuiltScenario(start_s, sensors, past_frames),
                agent,
                route_xyz,
                RouteLine(route_xyz).length_m,
                log,
                lambda: rebuilt_key_frame(simulator),
                lanes_known=lanes is not None,
                judge=lambda driven: (
                    None
                    if threat is None
                    else _under_threat(driven, threat, reference_mps(threat, drive, start_s))
                ),
            )


@functools.lru_cache(maxsize=1)  # drives in a row are in one scene
def _opened(run: str) -> OpenRun:
    return open_rebuilt(Path(run))


def _edits_of(file: str | None) -> list[Edit]:
    return [] if file is None else load_edits(Path(file))


def _past_frames(driver: str) -> int:
    return 1 if driver == REPLAY else needs_of(driver).past_frames


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


def _under_threat(driven: Drive, threat: Threat, reference: float) -> ThreatMet:
    """What a drive through a threat is worth, by its first collision."""
    hits = [event.severity for event in driven.events if event.kind.startswith("collision")]
    impact_mps = hits[0] if hits else None
    return ThreatMet(threat, impact_mps, reference, threat_score(impact_mps, reference))
