"""Drives in a reconstructed log."""

import contextlib
import dataclasses
import functools
import logging
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from foredrive.data.logs import Log
from foredrive.data.maps import read_lane_outlines
from foredrive.driving.corridor_agent import CorridorAgent
from foredrive.driving.ncap.outcome import judge
from foredrive.driving.observation import FRAME_DT_S
from foredrive.driving.replay.logged_drive import LoggedDrive
from foredrive.driving.replay.logged_lanes import LoggedLanes
from foredrive.driving.replay.reconstructed import ReconstructedScenario, ReconstructedSimulator
from foredrive.driving.replay.replay_expert import ReplayedWorld, ReplayExpert
from foredrive.driving.replay.threats import AS_PLANNED, Threat, Variation, reference_mps, send_threat
from foredrive.driving.route_progress import RouteLine
from foredrive.driving.simple_agents import ReplayAgent
from foredrive.errors import InputError
from foredrive.files import digest_of
from foredrive.methods.reconstruction.edits import DriveStraight, Edit, load_edits
from foredrive.methods.reconstruction.renderer import ReconstructedRenderer
from foredrive.methods.reconstruction.trust import Trust
from foredrive.methods.reconstruction.vehicle import LoggedVehicle
from foredrive.runs.drive.agent_inputs import chosen_cameras, inputs_of, own_rig
from foredrive.runs.drive.agents import CORRIDOR, EXPERT, REPLAY, Sees, is_remote, make_agent
from foredrive.runs.drive.drive_setup import DriveSetup
from foredrive.runs.drive.suite import ROUTES_SHA256, DriveJob, DriveSuite
from foredrive.runs.reconstruction.reconstruction_run import (
    OpenedReconstruction,
    edited_scene,
    open_reconstruction,
    open_run_log,
)
from foredrive.runs.reconstruction.trust import trust_of
from foredrive.runs.shipped import run_files
from foredrive.scene import Agent, Clip, Trajectory
from foredrive.sensors.rigs import camera_rig
from foredrive.towns.driving.drive_log import drive_log, log_frame

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ReconstructedRoutes:
    """A `DriveSource` of drives in a reconstructed log: one for each start time and threat."""

    run: str
    """Folder of the reconstruction run."""
    starts_s: tuple[float, ...] = ()
    """Times of the log at which drives begin, s; empty: the first time with enough past frames."""
    threats: tuple[Threat, ...] = ()
    """Threats, each in its own drive from every start; empty: one drive without a threat."""
    edits: str | None = None
    """File of edits to the scene; None: no edits."""
    stay_trusted: bool = False
    """If True, a drive ends where the images are no longer trusted."""
    variations: int = 0
    """Number of drawn variations of each threat, in place of the threat itself; 0: none."""
    seed: int = 0
    """Seed of the variations."""
    only: tuple[str, ...] = ()
    """Names of the drives to vary; empty: all."""

    in_turn = True
    grows = ("starts_s", "threats")

    def noted(self) -> Mapping[str, object]:
        """Return the fields, and the run as the routes. Those that few drives set are left out if not set."""
        fields = dataclasses.asdict(self)
        for name in ("stay_trusted", "variations", "seed", "only"):
            if not fields[name]:
                del fields[name]
        edits = [] if self.edits is None else [Path(self.edits)]
        _edits_of(self.edits)  # a file that cannot be read is one line
        return {**fields, "routes": self.run, ROUTES_SHA256: digest_of([*run_files(Path(self.run)), *edits])}

    def jobs(self, agent: str) -> Sequence[DriveJob]:
        """Return one drive for each start and threat, or for each variation of these.

        All of them can begin. Variations that cannot are left out.
        """
        past_frames, opened = past_frames_of(agent), opened_reconstruction(self.run)
        edited = edited_scene(opened.scene, _edits_of(self.edits))
        drive, plan = LoggedDrive(opened.vehicle, edited.T_ego_shifted.cpu()), self._plan(past_frames)
        jobs = []
        for job, start_s, threat, variation in plan:
            drive.check_start(start_s, past_frames * FRAME_DT_S)
            drive.route_from(start_s)
            try:
                if threat is not None:
                    send_threat(threat, edited.graph, drive, start_s, variation)
            except InputError:
                if not self.variations:
                    raise
            else:
                jobs.append(job)
        if not jobs:
            raise InputError(f"{self.run}: none of the {len(plan)} variations can begin")
        return jobs

    def anew(self, routes: Sequence[str], count: int, seed: int) -> "ReconstructedRoutes":
        """Return `count` drawn variations of each of some drives, which end where images are not trusted."""
        return dataclasses.replace(
            self, stay_trusted=True, variations=count, seed=self.seed + seed, only=tuple(routes)
        )

    def _plan(self, past_frames: int) -> list[tuple[DriveJob, float, Threat | None, Variation]]:
        first_s = float(opened_reconstruction(self.run).vehicle.t_s[0]) + past_frames * FRAME_DT_S
        plan = []
        for start_s in self.starts_s or (first_s,):
            for threat in self.threats or (None,):
                name = f"from{start_s:g}s" + ("" if threat is None else f"_{threat}")
                if self.only and name not in self.only:
                    continue
                if not self.variations:
                    plan.append((DriveJob(name, name), start_s, threat, AS_PLANNED))
                rng = np.random.default_rng((self.seed, zlib.crc32(name.encode())))
                for number in range(self.variations):
                    varied = f"{name}_{number}"
                    plan.append((DriveJob(varied, varied), start_s, threat, Variation.drawn(rng)))
        return plan

    @contextlib.contextmanager
    def set_up(self, job: DriveJob, suite: DriveSuite, out: Path) -> Iterator[DriveSetup]:
        """Set up a drive in the reconstructed scene."""
        opened, edits = opened_reconstruction(self.run), _edits_of(self.edits)
        vehicle = shown_vehicle(self.run, suite.agent)
        suite.faults.check_cameras(vehicle.rig.names)
        past_frames = past_frames_of(suite.agent)
        _, start_s, threat, variation = next(
            planned for planned in self._plan(past_frames) if planned[0] == job
        )
        edited = edited_scene(opened.scene, edits)
        drive = LoggedDrive(opened.vehicle, edited.T_ego_shifted.cpu())
        graph = edited.graph
        sent: DriveStraight | None = None
        if threat is not None:
            sent = send_threat(threat, graph, drive, start_s, variation)
            graph = edited_scene(opened.scene, [*edits, sent]).graph
        sensors = renders_for(suite) or self.stay_trusted
        trust = opened_trust(self.run, self.stay_trusted) if sensors else None
        renderer = ReconstructedRenderer(opened.scene, graph, vehicle, trust)
        lanes = lanes_of(opened.folder)
        simulator = ReconstructedSimulator(renderer, graph.all_tracks, drive, lanes)
        agent = agent_in(suite.agent, simulator)
        route_xyz = drive.route_from(start_s)
        rig = renderer.rig if sensors else None
        with drive_log(out, job.name, route_xyz, rig) as log:
            yield DriveSetup(
                simulator,
                ReconstructedScenario(
                    start_s,
                    sensors,
                    past_frames,
                    ends_on_collision=threat is not None,
                    stays_trusted=self.stay_trusted,
                ),
                agent,
                route_xyz,
                RouteLine(route_xyz).length_m,
                log,
                lambda: log_frame(simulator.state.frames[-1], simulator.state.ego, rig),
                lanes_known=lanes is not None,
                trusted_share=lambda: simulator.trusted_share,
                judge=lambda driven: (
                    None
                    if threat is None or sent is None
                    else judge(
                        threat, driven, reference_mps(threat, drive, start_s, variation), track=sent.copy
                    )
                ),
            )


@functools.lru_cache(maxsize=1)  # consecutive drives share one scene
def opened_reconstruction(run: str) -> OpenedReconstruction:
    """Open a reconstruction. Drives one after another in one log share it."""
    return open_reconstruction(Path(run))


@functools.lru_cache(maxsize=1)
def opened_trust(run: str, required: bool = False) -> Trust | None:
    """Return what a reconstruction expects of its images. Drives one after another in one log share it.

    Args:
        required: raise an error in place of returning None where there are no cameras.

    Raises:
        InputError: the reconstruction is not finished, or has no cameras if that is required.
    """
    opened = opened_reconstruction(run)
    return trust_of(opened) if opened.vehicle.rig.names or required else None


@functools.lru_cache(maxsize=1)
def shown_vehicle(run: str, agent: str) -> LoggedVehicle:
    """Return the vehicle of a log with the cameras that an agent is shown.

    They are those of the log, or the agent's own where it requires others: a reconstruction shows any camera.
    """
    vehicle = opened_reconstruction(run).vehicle
    own = own_rig(agent, vehicle) if vehicle.rig.names else None
    if own is None:
        return vehicle
    _log.warning("%s: its cameras are not those of %s: the agent's own are rendered", run, agent)
    return vehicle.with_rig(camera_rig(None, 0.0, own))


def renders_for(suite: DriveSuite) -> bool:
    """Return whether cameras and lidar are rendered: if they are asked for, or the agent is a learned one."""
    inputs = inputs_of(suite.agent)
    return suite.sensors or inputs.cameras or inputs.lidar


def _edits_of(file: str | None) -> list[Edit]:
    return [] if file is None else load_edits(Path(file))


def past_frames_of(agent: str) -> int:
    """Return the number of key frames before now that an agent observes."""
    return inputs_of(agent).past_frames


def lane_outlines_of(folder: Path) -> list[Float64[np.ndarray, "_ 2"]] | None:
    """Read the lanes from the map of a run's log; return None if the log or its map is missing."""
    try:
        return read_lane_outlines(Log(open_run_log(folder)[1]))
    except InputError:
        return None


def lanes_of(folder: Path) -> LoggedLanes | None:
    """Return the lanes of a run's log; None if the log or its map is missing."""
    outlines = lane_outlines_of(folder)
    return None if outlines is None else LoggedLanes(outlines)


def check_lidar_of(agent: str, sees: Sees | None, vehicle: LoggedVehicle, folder: str) -> None:
    """Check that a reconstruction has the lidar that an agent cannot drive without.

    Raises:
        InputError: it has not.
    """
    if vehicle.lidar is None and (agent == CORRIDOR or sees in ("lidar", "both")):
        raise InputError(f"{folder}: the reconstruction has no lidar, which {agent} is to see")


@dataclass(frozen=True, eq=False)
class _BlindedAgent:
    """An agent that is shown its cameras alone, or its lidar alone."""

    agent: Agent
    cameras: bool

    def act(self, observation: Clip) -> Trajectory:
        """Hide the other sensors and return the agent's plan."""
        if self.cameras:
            hidden = dataclasses.replace(
                observation,
                sweep_valid=torch.zeros_like(observation.sweep_valid),
                sweeps=observation.sweeps.map_tensors(torch.zeros_like),
            )
        else:
            hidden = dataclasses.replace(
                observation,
                image_valid=torch.zeros_like(observation.image_valid),
                images=torch.zeros_like(observation.images),
            )
        return self.agent.act(hidden)


@dataclass(frozen=True, eq=False)
class _SelectedCameras:
    """An agent that receives only some of the cameras."""

    agent: Agent
    cameras: list[int]

    def act(self, observation: Clip) -> Trajectory:
        """Select the cameras and return the agent's plan."""
        return self.agent.act(observation.through(self.cameras))


def agent_in(name: str, simulator: ReconstructedSimulator, sees: Sees | None = None) -> Agent:
    """Return the agent of a name, which sees only the cameras that it was trained on.

    Args:
        sees: what it is shown; None: all that it takes.
    """
    agent = _agent_in(name, simulator, sees)
    return agent if sees in (None, "both") or is_remote(name) else _BlindedAgent(agent, sees == "camera")


def _agent_in(name: str, simulator: ReconstructedSimulator, sees: Sees | None) -> Agent:
    if name == REPLAY:
        return ReplayAgent(simulator.drive, lambda: simulator.scenario.start_s + simulator.state.t_s)
    if name == EXPERT:
        return ReplayExpert(simulator.drive, ReplayedWorld(simulator))
    if name == CORRIDOR:
        return CorridorAgent(simulator.drive)
    agent = make_agent(name, lambda: simulator.state.t_s, sees=sees)
    assert isinstance(simulator.renderer, ReconstructedRenderer)
    vehicle = simulator.renderer.vehicle
    cameras = chosen_cameras(name, vehicle)
    return agent if cameras == list(range(len(vehicle.rig.names))) else _SelectedCameras(agent, cameras)
