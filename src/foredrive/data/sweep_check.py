"""Sweeps against each other along the path: static things have to stay where they are.

Two sweeps a few metres apart are registered from where the poses put them (point to plane: Chen & Medioni,
"Object modelling by registration of multiple range images", 1992). What is left tells of a mount that is
turned, which moves things aside by its angle times the way, of a clock, or of the poses.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from foredrive.data.lidar import frames_with_lidar, read_sweep
from foredrive.data.logs import Log
from foredrive.errors import InputError

WAY_M, MIN_WAY_M, MAX_APART_S = 4.0, 1.0, 3.0
"""Way between the two sweeps of a pair: as near as can be to the first, and at least the second number."""
PAIRS, MIN_SHIFTED = 6, 2
"""Pairs that are looked at, and the number that have to be shifted for a report: a third of them at least."""
MAX_SHIFT_M, MAX_SHIFT_SHARE = 0.08, 0.03
"""Shifts are reported that are larger than the first number plus this share of the way."""
BURIED_M, STEEPEST = 1.0, 0.25
"""Points are below any road that are lower than this, and than a road that falls by this share."""
MAX_BURIED_SHARE = 0.03
_NEAR_M = (2.5, 30.0)
_CELL_M, _MAX_POINTS, _MIN_POINTS = 0.3, 4000, 300
_REACH_M = (1.5, 1.5, 1.0, 1.0, 0.7, 0.7, 0.5, 0.5, 0.5, 0.5)
"""Distance up to which points are matched, by step."""
_ROBUST_M = 0.1
_HOLD = 1e-3
"""Weight, beside that of all points, that keeps what they do not tell, as the way along a wall."""
_FLAT = 0.1
"""Largest share of the spread across a surface of that along it."""
_MAX_LEFT = 0.8
"""A shift counts if the mean distance of the points shrinks to at most this share."""


@dataclass(frozen=True)
class Shift:
    """How a sweep has to be moved onto an earlier one, beside what the poses say."""

    way_m: float
    moved_m: Float64[np.ndarray, "3"]
    """Ahead, left, up."""
    share: float
    """Mean distance of the points to the surfaces afterwards, as a share of that before."""

    @property
    def is_large(self) -> bool:
        """Return whether it is more than good logs have."""
        return float(np.linalg.norm(self.moved_m)) > MAX_SHIFT_M + MAX_SHIFT_SHARE * self.way_m


def shifted_sweeps(log: Log) -> Iterator[str]:
    """Yield what is wrong with a lidar's mount, clock or poses, if its sweeps do not lie on each other."""
    shifts = []
    for first, second in _pairs(log):
        try:
            clouds = [_cloud(log, frame) for frame in (first, second)]
        except InputError:
            continue  # the check of the sweeps reports it
        if min(len(cloud) for cloud in clouds) >= _MIN_POINTS:
            T = np.linalg.inv(log.T_world_ego[first]) @ log.T_world_ego[second]
            shifts.append(_shift(clouds[0], clouds[1], T))
    wrong = [shift for shift in shifts if shift.is_large and shift.share < _MAX_LEFT]
    if len(wrong) < max(MIN_SHIFTED, len(shifts) / 3):
        return
    way_m = float(np.median([shift.way_m for shift in wrong]))
    moved_m = np.median([shift.moved_m for shift in wrong], axis=0)
    text = (
        f"{len(wrong)} of {len(shifts)} pairs of sweeps about {way_m:.1f} m apart do not lie on each other: "
    )
    text += "the later one has to go {:+.2f} m ahead, {:+.2f} m to the left and {:+.2f} m up".format(*moved_m)
    left_deg, up_deg = (math.degrees(math.atan2(-moved_m[axis], way_m)) for axis in (1, 2))
    turned = f"a lidar that should be turned by {left_deg:.1f}° to the left and {up_deg:.1f}° up"
    yield f"{text}, as of {turned}, or of poses or a clock that are off"


def buried_share(points_m: Float[np.ndarray, "N 3"]) -> float:
    """Return the share of points in the ego frame that are far below any road: cells that were misread."""
    distance_m = np.hypot(points_m[:, 0], points_m[:, 1])
    return float((points_m[:, 2] < -BURIED_M - STEEPEST * distance_m).mean())


def _pairs(log: Log) -> list[tuple[int, int]]:
    """Return pairs of frames a few metres apart, evenly over the log."""
    frames = frames_with_lidar(log)
    pairs = []
    if len(frames):
        position_m, t_s = log.T_world_ego[frames, :3, 3], log.t_us[frames] * 1e-6
        for row, frame in enumerate(frames.tolist()):
            way_m = np.linalg.norm(position_m[row:] - position_m[row], axis=1)
            way_m[t_s[row:] - t_s[row] > MAX_APART_S] = -np.inf
            nearest = int(np.abs(way_m - WAY_M).argmin())
            if way_m[nearest] >= MIN_WAY_M:
                pairs.append((frame, int(frames[row + nearest])))
    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(PAIRS, len(pairs))).round().astype(int))
    return [pairs[row] for row in chosen.tolist()]


def _cloud(log: Log, frame: int) -> Float64[np.ndarray, "N 3"]:
    """Return the points of a sweep near the vehicle, at most one in each cell, in the ego frame."""
    loaded = read_sweep(log, frame)
    if loaded is None:
        return np.zeros((0, 3))
    sweep = loaded[0][loaded[0].returned & loaded[0].valid]
    points = sweep.points_ego.double().numpy()
    distance_m = np.linalg.norm(points[:, :2], axis=1)
    points = points[(distance_m > _NEAR_M[0]) & (distance_m < _NEAR_M[1])]
    _, kept = np.unique(np.floor(points / _CELL_M).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(kept)]


def _shift(
    before: Float64[np.ndarray, "N 3"],
    after: Float64[np.ndarray, "M 3"],
    T_before_after: Float64[np.ndarray, "4 4"],
) -> Shift:
    """Register a sweep with an earlier one, beginning where the poses put it."""
    tree = cKDTree(before)
    normals, flat = _normals(before, tree)
    thinned = after[:: math.ceil(len(after) / _MAX_POINTS)]
    points = thinned @ T_before_after[:3, :3].T + T_before_after[:3, 3]
    E, distances_m = np.eye(4), []
    for reach_m in (*_REACH_M, _REACH_M[0]):
        moved = points @ E[:3, :3].T + E[:3, 3]
        apart_m, row = map(np.asarray, tree.query(moved, distance_upper_bound=reach_m))
        matched = np.isfinite(apart_m)
        matched[matched] &= flat[row[matched]]
        if matched.sum() < _MIN_POINTS // 3:
            break
        place_m, normal = moved[matched], normals[row[matched]]
        off_m = ((before[row[matched]] - place_m) * normal).sum(axis=1)
        weight = 1 / (1 + (off_m / _ROBUST_M) ** 2)
        if reach_m == _REACH_M[0]:
            distances_m.append(float(np.minimum(np.abs(off_m), 0.5).mean()))
        # Rotation vector and translation that bring the points onto the planes
        A = np.concatenate([np.cross(place_m, normal), normal], axis=1)
        H = (A * weight[:, None]).T @ A
        hold = np.diag([100.0] * 3 + [1.0] * 3) * _HOLD * weight.sum()
        step = np.linalg.solve(H + hold, (A * weight[:, None]).T @ off_m)
        move = np.eye(4)
        move[:3, :3], move[:3, 3] = Rotation.from_rotvec(step[:3]).as_matrix(), step[3:]
        E = move @ E
    way_m = float(np.linalg.norm(T_before_after[:3, 3]))
    # What is left at the later vehicle
    moved_m = E[:3, :3] @ T_before_after[:3, 3] + E[:3, 3] - T_before_after[:3, 3]
    share = distances_m[-1] / max(distances_m[0], 1e-6) if len(distances_m) > 1 else 1.0
    return Shift(way_m, moved_m, share)


def _normals(
    points: Float64[np.ndarray, "N 3"], tree: cKDTree
) -> tuple[Float64[np.ndarray, "N 3"], np.ndarray]:
    """Return the normal of the surface around each point, and whether it is flat and no line."""
    _, rows = tree.query(points, k=10)
    around = points[rows] - points[rows].mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    flat = (spread[:, 0] < _FLAT * spread[:, 1]) & (spread[:, 1] > 0.02 * spread[:, 2])
    return axes[:, :, 0], flat
