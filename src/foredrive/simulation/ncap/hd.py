"""HUGSIM's HD-Score of a drive in a rebuilt log, from its plans and the replayed vehicles."""

import math

import numpy as np
import shapely
from jaxtyping import Float64
from torch import Tensor

from foredrive.metrics.hd_score import HdScore, PlanInTraffic, hd_score
from foredrive.rendering.tracks import ActorTracks
from foredrive.scene.boxes import VEHICLES
from foredrive.simulation.drive import Drive
from foredrive.simulation.dynamics import EGO, STEP_S
from foredrive.simulation.observation import FRAME_DT_S
from foredrive.simulation.replayed import users_at

STANDS_M = 0.05
"""Largest distance between two points of a plan that stands, m."""


def hd_score_of(
    drive: Drive,
    tracks: ActorTracks,
    T_world_scene: Float64[Tensor, "4 4"],
    start_s: float,
    drivable: shapely.Geometry,
) -> HdScore | None:
    """Return the score of a drive. None without a plan.

    Args:
        tracks: tracks of all actors, in the scene frame.
        start_s: time of the log at which the drive began, s.
        drivable: area in which vehicles may drive, world frame.
    """
    plans = [
        _in_traffic(drive, index, points, tracks, T_world_scene, start_s) for index, points in drive.plans
    ]
    if not plans:
        return None
    return hd_score(plans, drivable, (EGO.length_m, EGO.width_m), drive.score.completion)


def _in_traffic(
    drive: Drive,
    index: int,
    points: Float64[np.ndarray, "T 2"],
    tracks: ActorTracks,
    T_world_scene: Float64[Tensor, "4 4"],
    start_s: float,
) -> PlanInTraffic:
    """Return one plan with the vehicles at its times.

    Headings follow the points. Where the plan stands, the vehicle keeps its heading.
    """
    state = drive.states[index]
    path = np.vstack([np.zeros(2), points])
    steps = np.diff(path, axis=0)
    moves = np.append(True, np.hypot(*steps.T) > STANDS_M)
    turns = np.append(0.0, np.arctan2(steps[:, 1], steps[:, 0]))
    last_moved = np.maximum.accumulate(np.where(moves, np.arange(len(path)), 0))
    yaw = state.yaw_rad + turns[last_moved]
    cos, sin = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
    axle = path @ np.array([[cos, sin], [-sin, cos]]) + [state.x_m, state.y_m]
    middle = axle + EGO.axle_to_centre_m * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    others = tuple(
        _outlines(tracks, T_world_scene, start_s + index * STEP_S + step * FRAME_DT_S)
        for step in range(len(path))
    )
    return PlanInTraffic(middle, yaw, FRAME_DT_S, others)


def _outlines(
    tracks: ActorTracks, T_world_scene: Float64[Tensor, "4 4"], t_s: float
) -> tuple[shapely.Polygon, ...]:
    users, found = users_at(tracks, T_world_scene, t_s), []
    for row in np.flatnonzero((users.track_id >= 0) & np.isin(users.category, [int(c) for c in VEHICLES])):
        corners = users.half_lw[row] * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
        cos, sin = math.cos(users.yaw[row]), math.sin(users.yaw[row])
        found.append(shapely.Polygon(corners @ np.array([[cos, sin], [-sin, cos]]) + users.foot_m[row, :2]))
    return tuple(found)
