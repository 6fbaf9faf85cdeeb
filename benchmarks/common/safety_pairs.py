"""One safety test twice: seen by the town's own sensors, and by those of the town's reconstruction."""

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from statistics import fmean

import numpy as np
import shapely
import torch
from jaxtyping import Float64

from benchmarks.common.reconstructed_towns import TownDrive, TownTruth
from benchmarks.common.town_replay import TownReplayRenderer
from foredrive.driving.drive import Drive, drive_route
from foredrive.driving.dynamics import EGO, STEP_S
from foredrive.driving.ncap.drawing import DrawnRun, draw_run
from foredrive.driving.ncap.outcome import judge
from foredrive.driving.ncap.rules import OURS
from foredrive.driving.ncap.running import Place, SafetyRun, set_up_run
from foredrive.driving.ncap.scenario import SafetyScenario
from foredrive.driving.ncap.self_test import run_reference
from foredrive.driving.replay.replayed import users_at
from foredrive.engine.summary import write_json
from foredrive.methods.reconstruction.reconstructed import RenderedImage
from foredrive.methods.reconstruction.renderer import ReconstructedRenderer
from foredrive.methods.reconstruction.scene_graph import SceneGraph
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.methods.reconstruction.trust import Trust
from foredrive.methods.reconstruction.views import CameraView
from foredrive.runs.drive.agent_inputs import inputs_of
from foredrive.runs.drive.in_ncap import place_in
from foredrive.runs.drive.in_reconstruction import agent_in
from foredrive.runs.reconstruction.reconstruction_run import OpenedReconstruction, open_reconstruction
from foredrive.runs.reconstruction.trust import trust_of
from foredrive.scene import Agent, Clip, Renderer, Trajectory
from foredrive.sensors.rigs import RigPlan, camera_rig
from foredrive.towns.sensing.capture import SensorSuite


@dataclass(frozen=True)
class SensorNoise:
    """Noise of an agent's sensors, the same in both worlds."""

    gain: float = 1.0
    """Factor of all pixels: below 1, images are too dark."""
    pixel_std: float = 0.0
    """Standard deviation of the noise of each pixel, of 255."""
    lost_beams: float = 0.0
    """Share of the beams of each sweep that are lost."""


@dataclass(frozen=True)
class PairedAgent:
    """An agent, and the sensors that it is shown."""

    agent: str
    rig: RigPlan
    """Its own cameras. An agent without cameras has some all the same: trust is about images."""
    lidar: bool = False
    noise: SensorNoise = field(default_factory=SensorNoise)


@dataclass(frozen=True)
class Driven:
    """One drive of a pair."""

    outcome: str
    score: float | None
    progress: float
    min_distance_m: float
    """Smallest distance between the boxes of the ego vehicle and of the scenario's actors."""
    trusted_share: float | None = None
    """Share of the key frames whose images are trusted; None in the town."""
    lost_db: float | None = None
    """Mean over the key frames of the PSNR that is expected to be lost against the logged way."""
    last_expected_db: float | None = None
    last_true_db: float | None = None
    """Expected and true PSNR of the last key frame."""


@dataclass(frozen=True)
class Pair:
    """One test of an agent in the town and in its reconstruction."""

    kind: str
    agent: str
    test: str
    """Name of the test, the same for all agents."""
    town: Driven
    reconstructed: Driven


@dataclass(frozen=True, eq=False)
class NotedTrust(Trust):
    """A reconstruction's expectations of its images, kept image by image."""

    noted_db: list[float] = field(default_factory=list)

    @classmethod
    def of(cls, trust: Trust) -> "NotedTrust":
        """Return the expectations of a reconstruction, with nothing noted yet."""
        return cls(trust.scene, trust.views, trust.offset, trust.reference_db, trust.weights)

    def psnr_db(self, graph: SceneGraph, images: Sequence[tuple[CameraView, RenderedImage]]) -> float:
        """Return the expected PSNR of the images of all cameras at one time together, dB; keep it."""
        self.noted_db.append(super().psnr_db(graph, images))
        return self.noted_db[-1]


@dataclass(eq=False)
class NoisyAgent:
    """An agent whose newest key frame has noise. The key frames before it keep theirs.

    Args:
        agent: gets the noisy observations.
        noise: the noise.
        seed: seed of all draws.
    """

    agent: Agent
    noise: SensorNoise
    seed: int
    _plans: int = field(default=0, init=False)

    def act(self, observation: Clip) -> Trajectory:
        """Return the agent's plan for the observation with noise."""
        images, valid = observation.images.clone(), observation.sweeps.valid.clone()
        newest = self._plans
        self._plans += 1
        for past in range(observation.now + 1):
            # A key frame is drawn anew for each observation, from the same numbers
            rng = torch.Generator().manual_seed(1_000 * self.seed + newest - past + 100)
            frame = observation.now - past
            if images.numel():
                drawn = torch.randn(images[:, frame].shape, generator=rng) * self.noise.pixel_std
                noisy = self.noise.gain * images[:, frame] + drawn
                images[:, frame] = noisy.round().clamp(0, 255).to(images.dtype)
            if self.noise.lost_beams and valid.numel():
                kept = torch.rand(valid[:, frame].shape, generator=rng) >= self.noise.lost_beams
                valid[:, frame] &= kept
        sweeps = dataclasses.replace(observation.sweeps, valid=valid)
        return self.agent.act(dataclasses.replace(observation, images=images, sweeps=sweeps))


class PairedTests:
    """Tests in one town and its reconstruction. Agents, actors, and traffic are the same in both.

    Args:
        drive: the recorded drive.
        reconstructed: folder of its reconstruction.
    """

    def __init__(self, drive: TownDrive, reconstructed: Path) -> None:
        self._drive, self._reconstructed = drive, reconstructed

    @cached_property
    def _truth(self) -> TownTruth:
        return TownTruth(self._drive)

    @cached_property
    def _place(self) -> Place:
        return place_in(str(self._reconstructed))

    @cached_property
    def _opened(self) -> OpenedReconstruction:
        return open_reconstruction(self._reconstructed)

    @cached_property
    def _trust(self) -> Trust:
        return trust_of(self._opened)

    def in_town(self, agent: PairedAgent, scenario: SafetyScenario, file: Path) -> Driven:
        """Return the drive with the town's own sensors; drive it unless its file is there."""
        if file.is_file():
            return Driven(**json.loads(file.read_text()))
        drawn = draw_run(scenario, 0)
        place = dataclasses.replace(
            self._place, renderer=lambda graph: self._seen_by_town(graph, drawn, agent)
        )
        return _kept(self._driven(place, agent, scenario)[1], file)

    def reconstructed(self, agent: PairedAgent, scenario: SafetyScenario, file: Path) -> Driven:
        """Return the drive with rendered sensors; drive it unless its file is there."""
        if file.is_file():
            return Driven(**json.loads(file.read_text()))
        lidar = self._place.vehicle.lidar if agent.lidar else None
        vehicle = self._place.vehicle.with_rig(camera_rig(None, 0.0, agent.rig))
        vehicle = dataclasses.replace(vehicle, lidar=lidar)
        trust = NotedTrust.of(self._trust)
        shown: list[SceneGraph] = []

        def render(graph: SceneGraph) -> Renderer:
            shown.append(graph)
            return ReconstructedRenderer(self._opened.scene, graph, vehicle, trust)

        run, driven = self._driven(dataclasses.replace(self._place, renderer=render), agent, scenario)
        # The town as it looks from where the drive ended
        simulator = run.simulator
        frame = simulator.state.frames[-1]
        town = self._seen_by_town(shown[-1], draw_run(scenario, 0), agent)
        seen = town.render(
            torch.from_numpy(frame.T_world_ego), torch.zeros(6), run.scenario.start_s + frame.t_s
        )
        error = (seen.images.double() - frame.images.double()).square().mean() / 255**2
        past = run.scenario.past_frames
        noted_db = trust.noted_db[past:]
        driven = dataclasses.replace(
            driven,
            trusted_share=simulator.trusted_share,
            lost_db=trust.reference_db - fmean(noted_db),
            last_expected_db=noted_db[-1],
            last_true_db=float(-10 * error.log10()),
        )
        return _kept(driven, file)

    def _seen_by_town(self, graph: SceneGraph, drawn: DrawnRun, agent: PairedAgent) -> Renderer:
        """Return the town's sensors in the recorded drive with the actors of a run."""
        logged = set(self._place.graph.tracks.track_id.tolist())
        added = [number for number in graph.tracks.track_id.tolist() if number not in logged]
        models = [self._place.track_ids[actor.name] for actor in drawn.actors]
        truth = self._truth
        return TownReplayRenderer(
            truth.world,
            SensorSuite(camera_rig(None, 0.0, agent.rig), truth.drive.sensors.lidar if agent.lidar else None),
            truth.snapshots,
            graph.tracks,
            self._place.vehicle.T_world_scene,
            dict(zip(added, models, strict=True)),
        )

    def _driven(self, place: Place, agent: PairedAgent, scenario: SafetyScenario) -> tuple[SafetyRun, Driven]:
        """Drive a test in one of both worlds."""
        reference_mps = run_reference(self._place, scenario, 0, OURS)
        past = inputs_of(agent.agent).past_frames
        run = set_up_run(place, scenario, 0, OURS, sensors=True, past_frames=past)
        planner = NoisyAgent(agent_in(agent.agent, run.simulator), agent.noise, scenario.start_frame)
        drive = drive_route(run.simulator, run.scenario, planner, route=scenario.label, pilot=run.pilot)
        result = judge(scenario.kind, drive, reference_mps, OURS.left_way_score)
        logged = self._place.graph.all_tracks.track_id.cpu()
        added = run.simulator.tracks.only(~torch.isin(run.simulator.tracks.track_id, logged))
        near_m = min_distance_m(drive, added, place, run.scenario.start_s)
        return run, Driven(result.outcome.value, result.score, result.progress, near_m)


def _kept(driven: Driven, file: Path) -> Driven:
    """Write a drive to its file; return it."""
    file.parent.mkdir(parents=True, exist_ok=True)
    write_json(file, dataclasses.asdict(driven))
    return driven


def min_distance_m(drive: Drive, tracks: ActorTracks, place: Place, start_s: float) -> float:
    """Return the smallest distance of the ego vehicle from some actors in a drive, m."""
    nearest = math.inf
    for index, state in enumerate(drive.states):
        users = users_at(tracks, place.vehicle.T_world_scene, start_s + index * STEP_S)
        forward = np.array([math.cos(state.yaw_rad), math.sin(state.yaw_rad)])
        centre = np.array([state.x_m, state.y_m]) + EGO.axle_to_centre_m * forward
        ego = outline(centre, state.yaw_rad, 0.5 * np.array([EGO.length_m, EGO.width_m]))
        for row in np.flatnonzero(users.track_id >= 0):
            other = outline(users.foot_m[row, :2], float(users.yaw[row]), users.half_lw[row])
            nearest = min(nearest, float(ego.distance(other)))
    return nearest


def outline(
    centre: Float64[np.ndarray, "2"], yaw_rad: float, half_lw: Float64[np.ndarray, "2"]
) -> shapely.Polygon:
    """Return a rectangle in the plane."""
    corners = half_lw * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return shapely.Polygon(corners @ np.array([[cos, sin], [-sin, cos]]) + centre)
