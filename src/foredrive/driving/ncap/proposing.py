"""Scenarios that are feasible in a reconstructed log: where and when each kind of test makes sense.

Neuro-ncap's scenarios were placed by hand. Here they are found. A place is where the ego vehicle would be
some time after it begins to drive itself, at constant speed on the logged path. A scenario is feasible if

- the log moves at the start, and the place lies on its path, so that it was seen from near;
- the actor's way is free of the log's actors until 1 s after the impact, and the ego vehicle's up to there;
- the actor is on a lane around the time of the impact, if the log has a map;
- no actor hides the target from the ego vehicle 2 s before the impact;
- the ego vehicle could stop in front of the place with comfortable braking, so that the test can be passed;
- the copied car is an actor of its own, and was seen from near.

What is proposed still has to pass the self-test.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
import torch
from jaxtyping import Float64

from foredrive.driving.dynamics import EGO
from foredrive.driving.ncap.placing import way_points
from foredrive.driving.ncap.running import Place
from foredrive.driving.ncap.scenario import Jitter, Polyline, Rectilinear, SafetyScenario, ScenarioActor
from foredrive.driving.observation import FRAME_DT_S
from foredrive.driving.replay.logged_drive import LoggedDrive
from foredrive.driving.replay.replayed import users_at
from foredrive.driving.replay.threats import Threat
from foredrive.errors import InputError
from foredrive.geometry.polylines import arc_lengths, points_at
from foredrive.methods.reconstruction.tracks import states_at
from foredrive.scene import Category

PRIMING_FRAMES, EVERY_FRAMES = 2, 2
"""Priming of each test, and distance between two starts that are tried, key frames."""
AFTERWARDS_S, LENGTH_S = 1.0, 8.0
"""Shortest time left in the log after the impact, and longest length of a test, s."""
HIDDEN_BEFORE_S, ON_LANE_S = 2.0, 1.5
"""Time before the impact from which the actor must be in sight, and time around it on a lane, s."""
MIN_MPS, BRAKING_MPS2, REACTION_S = 3.0, 4.0, 1.0
"""Slowest start, m/s, braking that passes a test, m/s², and time before it begins, s."""
SEEN_WITHIN_M, BODY_M = 20.0, 2.7
"""A copied car was seen from within this distance, m. Nothing is nearer to its middle than `BODY_M` on a free
way, half a car's length and some margin."""
PATH_S, PATH_DT_S = 16.0, 0.2
"""Length and step of the part of the logged path that is looked at, s."""
MODELS = 3
"""Number of cars to choose from."""


@dataclass(frozen=True)
class Approach:
    """Time and speed at which the actor of a proposed test comes to the place of the impact."""

    impact_s: float = 4.0
    """Time from the end of the priming to the impact without action."""
    actor_mps: float = 5.0
    """Speed of an actor that comes head-on or crosses."""


APPROACHES = (Approach(), Approach(3.0, 3.0), Approach(2.0, 3.0))
"""Approaches in the order in which they are tried."""


def propose_kinds(place: Place, scene: str) -> list[SafetyScenario]:
    """Return the feasible scenarios of a reconstructed log, each kind by the first approach that has any.

    Arguments and errors are those of `propose`.
    """
    of_kind: dict[Threat, list[SafetyScenario]] = {}
    for approach in APPROACHES:
        missing = [kind for kind in Threat if kind not in of_kind]
        proposals = propose(place, scene, approach) if missing else []
        for kind in missing:
            if feasible := [proposal for proposal in proposals if proposal.kind is kind]:
                of_kind[kind] = feasible
    proposals = [proposal for kind in of_kind.values() for proposal in kind]
    return sorted(proposals, key=lambda proposal: proposal.start_frame)


def propose(place: Place, scene: str, approach: Approach = Approach()) -> list[SafetyScenario]:
    """Return the feasible scenarios of a reconstructed log, in the order of their starts.

    Args:
        place: the log.
        scene: name of the reconstruction in the scenarios.
        approach: time and speed of the actor.

    Raises:
        InputError: no car that is an actor of its own was seen from near.
    """
    drive = LoggedDrive(place.vehicle, torch.eye(4))
    models, proposals = _models(place, drive), list[SafetyScenario]()
    others_at = functools.cache(functools.partial(_others, place))
    # Starts on the grid of key frames, as long as the log covers the test
    first = math.ceil(drive.first_s / FRAME_DT_S) + 1
    for frame in range(first, int(drive.end_s / FRAME_DT_S), EVERY_FRAMES):
        begin_s = FRAME_DT_S * (frame + PRIMING_FRAMES)
        length_s = min(LENGTH_S, FRAME_DT_S * math.floor((drive.end_s - FRAME_DT_S * frame) / FRAME_DT_S))
        if begin_s + approach.impact_s + AFTERWARDS_S > FRAME_DT_S * frame + length_s:
            break
        speed_mps, path = drive.state_at(begin_s).speed_mps, _path_from(drive, begin_s)
        for kind in Threat:
            actor = _actor(kind, path, speed_mps, begin_s, approach, models)
            impact_s = begin_s + approach.impact_s
            if actor is not None and _feasible(place, drive, others_at, actor, begin_s, impact_s):
                name = f"{scene}_{FRAME_DT_S * frame:g}s"
                proposals.append(SafetyScenario(name, kind, scene, frame, length_s, (actor,), PRIMING_FRAMES))
    return proposals


def _models(place: Place, drive: LoggedDrive) -> tuple[str, ...]:
    """Return the names of the actors that are cars and were seen best, from near."""
    tracks, token = place.graph.tracks, {number: name for name, number in place.track_ids.items()}
    rows = []
    # Cars seen from near at any time, then those that the reconstruction observed best
    for t_s in np.arange(drive.first_s, drive.end_s, FRAME_DT_S).tolist():
        users = users_at(tracks, place.vehicle.T_world_scene, t_s)
        away_m = np.hypot(*(users.foot_m[:, :2] - drive.pose_at(t_s)[:2, 3]).T)
        near = (users.track_id >= 0) & (users.category == int(Category.CAR)) & (away_m < SEEN_WITHIN_M)
        rows += np.flatnonzero(near).tolist()
    if not rows:
        raise InputError(f"no car that is an actor of its own was seen from within {SEEN_WITHIN_M:g} m")
    best = sorted(set(rows), key=lambda row: -place.graph.content.evidence(row))[:MODELS]
    return tuple(token[int(tracks.track_id[row])] for row in best)


def _path_from(drive: LoggedDrive, begin_s: float) -> Float64[np.ndarray, "N 3"]:
    """Return the logged path from a time on, m, world frame."""
    times = np.arange(begin_s, min(begin_s + PATH_S, drive.end_s), PATH_DT_S)
    return np.stack([drive.pose_at(t_s)[:3, 3] for t_s in times.tolist()])


def _actor(
    kind: Threat,
    path: Float64[np.ndarray, "N 3"],
    speed_mps: float,
    begin_s: float,
    approach: Approach,
    models: Sequence[str],
) -> ScenarioActor | None:
    """Return the actor of a test. None if the log is too slow, or its path too short for it."""
    arc_m = arc_lengths(path[:, :2])
    bumper_m = EGO.axle_to_centre_m + 0.5 * EGO.length_m
    # Where the front bumper would be at constant speed at the time of the impact
    at_m = speed_mps * approach.impact_s + bumper_m
    if speed_mps < MIN_MPS or at_m + 4.0 > arc_m[-1]:
        return None
    # The spot of the impact and the heading of the path there
    before, spot, after = points_at(path, arc_m, np.array([at_m - 0.5, at_m, at_m + 0.5]))
    yaw = float(math.atan2(after[1] - before[1], after[0] - before[0]))
    x, y, z = spot.tolist()
    impact_s, names = begin_s + approach.impact_s, tuple(models)
    shift = Jitter(yaw, longitudinal_m=2.0, lateral_m=0.5)
    # A standing car with its rear at the spot, about half its length further on
    if kind is Threat.STATIONARY:
        centre = (x + 2.2 * math.cos(yaw), y + 2.2 * math.sin(yaw), z)
        standing = Jitter(yaw, longitudinal_m=2.0, lateral_m=0.5, yaw_rad=0.3)
        return ScenarioActor(names, Rectilinear(centre, impact_s, yaw), yaw, jitter=standing)
    # From the right, so that it is at the spot at the time of the impact
    if kind is Threat.SIDE:
        way = Rectilinear((x, y, z), impact_s, yaw + 0.5 * math.pi, approach.actor_mps)
        return ScenarioActor(names, way, jitter=Jitter(yaw, longitudinal_m=0.5, lateral_m=0.5))
    return _oncoming(path, arc_m, at_m, impact_s, approach.actor_mps, names, shift)


def _oncoming(
    path: Float64[np.ndarray, "N 3"],
    arc_m: Float64[np.ndarray, "N"],
    at_m: float,
    impact_s: float,
    actor_mps: float,
    names: tuple[str, ...],
    shift: Jitter,
) -> ScenarioActor:
    """Return the actor that comes along the logged path, as far as the log knows it, and straight before."""
    # Backwards from the spot along the logged path, at constant speed
    ahead_m = np.arange(0.0, min(float(arc_m[-1]) - at_m, 30.0), 2.0)
    points = points_at(path, arc_m, at_m + ahead_m[::-1])
    times = impact_s - ahead_m[::-1] / actor_mps
    way = Polyline(tuple(times.tolist()), tuple((x, y, z) for x, y, z in points.tolist()))
    return ScenarioActor(names, way, jitter=shift)


def _feasible(
    place: Place,
    drive: LoggedDrive,
    others_at: Callable[[float], shapely.Geometry],
    actor: ScenarioActor,
    begin_s: float,
    impact_s: float,
) -> bool:
    """Return whether the ways of actor and ego vehicle are free, and the actor is seen in time.

    Args:
        others_at: returns the boxes of the log's actors at a time.
        begin_s, impact_s: times of the log at which the priming ends and the impact is, s.
    """
    way = actor.way if isinstance(actor.way, Polyline) else actor.way.polyline()
    speed_mps = drive.state_at(begin_s).speed_mps
    # Reaction and comfortable braking must fit into the way to the impact
    if speed_mps * REACTION_S + speed_mps**2 / (2 * BRAKING_MPS2) > speed_mps * (impact_s - begin_s):
        return False
    end_s = impact_s + AFTERWARDS_S
    for t_s in np.arange(begin_s, end_s + 1e-6, FRAME_DT_S).tolist():
        others = others_at(t_s)
        # The actor's body must be free at all times
        foot = way_points(way, np.array([t_s]))[0, :2]
        if shapely.Point(foot).buffer(BODY_M).intersects(others):
            return False
        # Around the impact the actor must be on a lane
        near = abs(t_s - impact_s) <= ON_LANE_S
        if near and place.lanes is not None and place.lanes.outside(foot):
            return False
        # Until the impact: the ego vehicle's way is free, and shortly before it the actor is in sight
        if t_s <= impact_s:
            ego = shapely.Point(drive.pose_at(t_s)[:2, 3]).buffer(0.5 * EGO.width_m)
            sight = shapely.LineString([drive.pose_at(t_s)[:2, 3], foot])
            late = t_s >= impact_s - HIDDEN_BEFORE_S
            if ego.intersects(others) or (late and sight.intersects(others)):
                return False
    return True


def _others(place: Place, t_s: float) -> shapely.Geometry:
    """Return the boxes of the log's actors at a time, in the plane of the world."""
    tracks = place.graph.all_tracks
    states = states_at(tracks, t_s)
    users = users_at(tracks, place.vehicle.T_world_scene, t_s)
    boxes = []
    for row in states.present.nonzero()[:, 0].tolist():
        half_l, half_w = users.half_lw[row]
        corners = np.array([[half_l, half_w], [half_l, -half_w], [-half_l, -half_w], [-half_l, half_w]])
        cos, sin = math.cos(users.yaw[row]), math.sin(users.yaw[row])
        boxes.append(shapely.Polygon(corners @ [[cos, sin], [-sin, cos]] + users.foot_m[row, :2]))
    return shapely.union_all(boxes)
