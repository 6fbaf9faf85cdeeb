"""One safety test twice: seen by the town's own sensors, and by those of the town's reconstruction."""

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float64
from scipy import stats

from benchmarks.common.reconstructed_towns import TownDrive, TownTruth
from foredrive.driving.drive import Drive, drive_route
from foredrive.driving.dynamics import EGO, STEP_S
from foredrive.driving.ncap.drawing import DrawnRun, draw_run
from foredrive.driving.ncap.outcome import judge
from foredrive.driving.ncap.rules import OURS
from foredrive.driving.ncap.running import Place, set_up_run
from foredrive.driving.ncap.scenario import SafetyScenario
from foredrive.driving.ncap.self_test import run_reference
from foredrive.driving.replay.replayed import users_at
from foredrive.engine.summary import write_json
from foredrive.methods.reconstruction.scene_graph import SceneGraph
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.runs.drive.agent_inputs import inputs_of
from foredrive.runs.drive.in_ncap import place_in
from foredrive.runs.drive.in_reconstruction import agent_in
from foredrive.scene import Renderer
from foredrive.towns.driving.town_replay import TownReplayRenderer


@dataclass(frozen=True)
class Driven:
    """One drive of a pair."""

    outcome: str
    score: float | None
    progress: float
    min_distance_m: float
    """Smallest distance between the boxes of the ego vehicle and of the scenario's actors."""


@dataclass(frozen=True)
class Pair:
    """One test in the town and in its reconstruction."""

    kind: str
    town: Driven
    reconstructed: Driven


class PairedTests:
    """Tests in one town. Agents, actors, and traffic are the same in both drives of a pair.

    Args:
        drive: the recorded drive.
        reconstructed: folder of its reconstruction.
    """

    def __init__(self, drive: TownDrive, reconstructed: Path) -> None:
        self._truth, self._place = TownTruth(drive), place_in(str(reconstructed))

    def pair(self, agent: str, scenario: SafetyScenario, number: int, file: Path) -> Pair:
        """Return a pair; drive it unless its file is there."""
        if file.is_file():
            return read_pair(json.loads(file.read_text()))
        reference_mps = run_reference(self._place, scenario, number, OURS)
        drawn = draw_run(scenario, number)
        in_town = dataclasses.replace(self._place, renderer=lambda graph: self._seen_by_town(graph, drawn))
        pair = Pair(
            scenario.kind.value,
            self._driven(in_town, agent, scenario, number, reference_mps),
            self._driven(self._place, agent, scenario, number, reference_mps),
        )
        file.parent.mkdir(parents=True, exist_ok=True)
        write_json(file, dataclasses.asdict(pair))
        return pair

    def _seen_by_town(self, graph: SceneGraph, drawn: DrawnRun) -> Renderer:
        """Return the town's sensors in the recorded drive with the actors of a run."""
        logged = set(self._place.graph.tracks.track_id.tolist())
        added = [number for number in graph.tracks.track_id.tolist() if number not in logged]
        models = [self._place.track_ids[actor.name] for actor in drawn.actors]
        truth = self._truth
        return TownReplayRenderer(
            truth.world,
            truth.drive.sensors,
            truth.snapshots,
            graph.tracks,
            self._place.vehicle.T_world_scene,
            dict(zip(added, models, strict=True)),
        )

    def _driven(
        self, place: Place, agent: str, scenario: SafetyScenario, number: int, reference_mps: float
    ) -> Driven:
        past = inputs_of(agent).past_frames
        run = set_up_run(place, scenario, number, OURS, sensors=True, past_frames=past)
        planner = agent_in(agent, run.simulator)
        drive = drive_route(run.simulator, run.scenario, planner, route=scenario.label, pilot=run.pilot)
        result = judge(scenario.kind, drive, reference_mps, OURS.left_way_score)
        graph = run.simulator.tracks
        count = len(graph) - len(self._place.graph.tracks)
        near_m = min_distance_m(drive, graph, count, place, run.scenario.start_s)
        return Driven(result.outcome.value, result.score, result.progress, near_m)


def min_distance_m(drive: Drive, tracks: ActorTracks, count: int, place: Place, start_s: float) -> float:
    """Return the smallest distance of the ego vehicle from the last `count` actors in a drive, m."""
    nearest = math.inf
    for index, state in enumerate(drive.states):
        users = users_at(tracks, place.vehicle.T_world_scene, start_s + index * STEP_S)
        forward = np.array([math.cos(state.yaw_rad), math.sin(state.yaw_rad)])
        centre = np.array([state.x_m, state.y_m]) + EGO.axle_to_centre_m * forward
        ego = outline(centre, state.yaw_rad, 0.5 * np.array([EGO.length_m, EGO.width_m]))
        for row in range(len(users.track_id) - count, len(users.track_id)):
            if users.track_id[row] >= 0:
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


def read_pair(written: Mapping[str, Any]) -> Pair:
    """Return a pair as `PairedTests.pair` wrote it."""
    town, reconstructed = (Driven(**written[name]) for name in ("town", "reconstructed"))
    return Pair(written["kind"], town, reconstructed)


def agreement(pairs: Sequence[Pair]) -> dict[str, float]:
    """Return how well tests in a reconstruction predict those in the town.

    Pairs with a failed drive are counted and left out. Correlations are Pearson's; one without spread on one
    side is left out, since it has no value.
    """
    whole = [pair for pair in pairs if pair.town.score is not None and pair.reconstructed.score is not None]
    figures = {"pairs": float(len(whole)), "failed": float(len(pairs) - len(whole))}
    if not whole:
        return figures
    collided = [[drive.outcome == "collided" for drive in (pair.town, pair.reconstructed)] for pair in whole]
    scores = np.array([[pair.town.score, pair.reconstructed.score] for pair in whole], dtype=float)
    away_m = np.array([[pair.town.min_distance_m, pair.reconstructed.min_distance_m] for pair in whole])
    figures |= {
        "collision_agreement": float(np.mean([town == reconstructed for town, reconstructed in collided])),
        "outcome_agreement": float(np.mean([p.town.outcome == p.reconstructed.outcome for p in whole])),
        "collisions_in_town": float(np.mean([town for town, _ in collided])),
        "collisions_in_rebuild": float(np.mean([reconstructed for _, reconstructed in collided])),
        "score_in_town": float(scores[:, 0].mean()),
        "score_in_rebuild": float(scores[:, 1].mean()),
        "score_difference": float(np.abs(scores[:, 0] - scores[:, 1]).mean()),
        "min_distance_difference_m": float(np.median(np.abs(away_m[:, 0] - away_m[:, 1]))),
    }
    for name, values in (("score", scores), ("min_distance", away_m)):
        if (np.ptp(values, axis=0) > 0).all() and np.isfinite(values).all():
            figures[f"{name}_correlation"] = float(stats.pearsonr(*values.T).statistic)
    return figures
