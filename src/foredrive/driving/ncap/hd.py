"""HUGSIM's HD-Score of a drive in a reconstructed log, from its plans and the replayed vehicles.

It is the mean over all plans of NC · DAC · (5 TTC + 2 C) / 7, times route completion. Source: public
repository hyzhou404/HUGSIM, `sim/utils/score_calculator.py`; Zhou et al., "HUGSIM", 2024. There collisions
with the static scene are counted on its points, and DAC by ground points under four quarters of the vehicle.
Here the drivable area is that of a map, by the middles of these quarters. There objects count that are named
"car", and its `closed_loop.py` names all objects so. Here all vehicles and cycles count.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float64
from torch import Tensor

from foredrive.driving.drive import Drive
from foredrive.driving.dynamics import EGO, STEP_S
from foredrive.driving.observation import FRAME_DT_S
from foredrive.driving.replay.replayed import users_at
from foredrive.errors import InputError
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.scene.boxes import VEHICLES

AHEAD_S = (0.5, 1.0)
"""Times by which a plan is moved on at its own velocities, s."""
TTC_WEIGHT, COMFORT_WEIGHT = 5.0, 2.0
MIN_ALONG_MPS2, MAX_ALONG_MPS2 = -4.05, 2.40
MAX_ALONG_JERK_MPS3, MAX_YAW_RATE_RADPS, MAX_YAW_ACCELERATION_RADPS2 = 8.37, 0.95, 1.93
LEAST_SHARE = 0.3
"""Smallest share of the quarters of a vehicle on the road."""
SHORT_M = 1.0
"""In a plan shorter than this, m, all headings are that at now."""


@dataclass(frozen=True, eq=False)
class PlanInTraffic:
    """One plan of a drive: poses of the middle of the vehicle at now and at T steps, world frame."""

    xy_m: Float64[np.ndarray, "T 2"]
    yaw_rad: Float64[np.ndarray, "T"]
    dt_s: float
    others: tuple[tuple[shapely.Polygon, ...], ...]
    """Outlines of the other vehicles at these times. Behind the end of the drive, the last ones stay."""


@dataclass(frozen=True)
class HdScore:
    """Means over the plans of a drive, and the score."""

    nc: float
    dac: float
    ttc: float
    comfort: float
    completion: float
    hd_score: float


def hd_score(
    plans: Sequence[PlanInTraffic],
    drivable: shapely.Geometry,
    size_lw: tuple[float, float],
    completion: float,
) -> HdScore:
    """Return the score of a drive.

    Args:
        drivable: area in which vehicles may drive, world frame.
        size_lw: length and width of the vehicle, m.
        completion: share of the route, 0 to 1.

    Raises:
        InputError: there are no plans.
    """
    if not plans:
        raise InputError("an HD-Score needs at least one plan")
    rows = []
    for plan in plans:
        # A plan that hardly moves has no reliable headings of its own
        yaw = plan.yaw_rad if _length_m(plan) >= SHORT_M else np.full_like(plan.yaw_rad, plan.yaw_rad[0])
        nc = _no_collision(plan.xy_m, yaw, plan, size_lw)
        dac = _drivable(plan.xy_m, yaw, drivable, size_lw)
        # Velocities between the points, the first one repeated
        velocity = np.diff(plan.xy_m, axis=0) / plan.dt_s
        velocity = np.vstack([velocity[:1], velocity])
        ttc = min(_no_collision(plan.xy_m + ahead_s * velocity, yaw, plan, size_lw) for ahead_s in AHEAD_S)
        comfort = _comfort(plan.xy_m, yaw, plan.dt_s)
        weighted = (TTC_WEIGHT * ttc + COMFORT_WEIGHT * comfort) / (TTC_WEIGHT + COMFORT_WEIGHT)
        rows.append((nc, dac, ttc, comfort, nc * dac * weighted))
    nc, dac, ttc, comfort, mean = np.mean(rows, axis=0).tolist()
    return HdScore(nc, dac, ttc, comfort, completion, mean * min(completion, 1.0))


def _length_m(plan: PlanInTraffic) -> float:
    return float(np.hypot(*(plan.xy_m[-1] - plan.xy_m[0])))


def _no_collision(
    xy_m: Float64[np.ndarray, "T 2"],
    yaw_rad: Float64[np.ndarray, "T"],
    plan: PlanInTraffic,
    size_lw: tuple[float, float],
) -> float:
    for step, (xy, yaw) in enumerate(zip(xy_m, yaw_rad.tolist(), strict=True)):
        # Behind the known times the last outlines stay
        others = plan.others[min(step, len(plan.others) - 1)] if plan.others else ()
        ego = shapely.Polygon(_points(xy, yaw, size_lw, 0.5))
        if any(ego.intersects(other) for other in others):
            return 0.0
    return 1.0


def _drivable(
    xy_m: Float64[np.ndarray, "T 2"],
    yaw_rad: Float64[np.ndarray, "T"],
    drivable: shapely.Geometry,
    size_lw: tuple[float, float],
) -> float:
    """Return 0 if at some step fewer than two quarters of the vehicle are on the road, else 1.

    The public code has a value of 0.5 too, which no number of quarters can reach.
    """
    # Share of the four quarters' middles that are on the road, at each step
    shares = [
        float(shapely.contains_xy(drivable, *_points(xy, yaw, size_lw, 0.25).T).mean())
        for xy, yaw in zip(xy_m, yaw_rad.tolist(), strict=True)
    ]
    return float(min(shares) >= LEAST_SHARE)


def _points(
    xy: Float64[np.ndarray, "2"], yaw_rad: float, size_lw: tuple[float, float], share: float
) -> Float64[np.ndarray, "4 2"]:
    """Return the points at a share of length and width from the middle, one in each quarter."""
    local = share * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * np.array(size_lw)
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.asarray(local @ np.array([[cos, sin], [-sin, cos]]) + xy)


def _comfort(xy_m: Float64[np.ndarray, "T 2"], yaw_rad: Float64[np.ndarray, "T"], dt_s: float) -> float:
    """Return 1 if acceleration, jerk and turning of a plan are within bounds. Short plans are comfortable."""
    if len(xy_m) < 4:
        return 1.0
    # Finite differences of the plan's points
    speed = np.hypot(*np.diff(xy_m, axis=0).T) / dt_s
    along = np.diff(speed) / dt_s
    turning = np.diff(np.unwrap(yaw_rad)) / dt_s
    return float(
        (along <= MAX_ALONG_MPS2).all()
        and (along >= MIN_ALONG_MPS2).all()
        and (np.abs(np.diff(along) / dt_s) <= MAX_ALONG_JERK_MPS3).all()
        and (np.abs(turning) <= MAX_YAW_RATE_RADPS).all()
        and (np.abs(np.diff(turning) / dt_s) <= MAX_YAW_ACCELERATION_RADPS2).all()
    )


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
    plans = [_in_traffic(drive, made.step, made.xy, tracks, T_world_scene, start_s) for made in drive.plans]
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
    # Steps too short for a direction keep the last heading
    moves = np.append(True, np.hypot(*steps.T) > STANDS_M)
    turns = np.append(0.0, np.arctan2(steps[:, 1], steps[:, 0]))
    last_moved = np.maximum.accumulate(np.where(moves, np.arange(len(path)), 0))
    yaw = state.yaw_rad + turns[last_moved]
    cos, sin = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
    # Points from the ego frame to the world; the outline is about the middle of the vehicle
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
    users, outlines = users_at(tracks, T_world_scene, t_s), []
    for row in np.flatnonzero((users.track_id >= 0) & np.isin(users.category, [int(c) for c in VEHICLES])):
        corners = users.half_lw[row] * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
        cos, sin = math.cos(users.yaw[row]), math.sin(users.yaw[row])
        outlines.append(
            shapely.Polygon(corners @ np.array([[cos, sin], [-sin, cos]]) + users.foot_m[row, :2])
        )
    return tuple(outlines)
