"""Height alignment of the roads that cross in a junction.

Each connecting road of the maps has its own elevation profile. Where two of them cross, the profiles differ
by up to half a metre (Town03, Town07).
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from foredrive.geometry.polylines import arc_lengths

Points = Float[np.ndarray, "N 3"]
Line = Float[np.ndarray, "_ 3"]

REACH_M, SIGMA_M = 1.8, 0.7
LEVEL_GAP_M = 1.5
"""Height difference above which points belong to different levels, m."""
BLEND_M = 4.0
"""Distance from the end of a road over which its own height returns, m, so that it meets the road outside."""
STEP_M = 0.02
"""Height range below which a junction is left unchanged, m."""


def level_junction(roads: Sequence[tuple[Line, Line]]) -> list[tuple[Line, Line]]:
    """Align the heights of all strips of a junction where they overlap.

    Takes and returns the left and right borders of each strip.
    """
    middles = [0.5 * (left + right) for left, right in roads]
    # Borders and middle lines of all roads of the junction
    points = np.concatenate([*(line for road in roads for line in road), *middles])
    if np.ptp(points[:, 2]) < STEP_M:
        return list(roads)
    tree = cKDTree(points[:, :2])
    levelled = []
    for (left, right), middle in zip(roads, middles, strict=True):
        # The blend is 0 at the ends, where the junction meets other roads
        share = _blend(middle)
        left_z, right_z = (_mean_height(line, points, tree) for line in (left, right))
        levelled.append((_blended(left, left_z, share), _blended(right, right_z, share)))
    return levelled


def _blend(line: Points) -> Float[np.ndarray, "N"]:
    """Return 0 at the ends of a line and 1 further than BLEND_M from them."""
    along = arc_lengths(line)
    # Distance from the nearer end, then a smoothstep
    t = np.clip(np.minimum(along, along[-1] - along) / BLEND_M, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _blended(line: Points, z: Float[np.ndarray, "N"], share: Float[np.ndarray, "N"]) -> Points:
    return np.column_stack([line[:, :2], line[:, 2] + share * (z - line[:, 2])])


def _mean_height(line: Points, points: Float[np.ndarray, "P 3"], tree: cKDTree) -> Float[np.ndarray, "N"]:
    """Return the Gaussian mean of the heights around each point of a line, over points of the same level."""
    near = tree.query_ball_point(line[:, :2], REACH_M, return_sorted=True)
    # Flat list of pairs (point of the line, point nearby)
    row = np.repeat(np.arange(len(line)), [len(n) for n in near])
    other = points[np.concatenate(near).astype(int)]
    # Gaussian weight by distance; points on another level do not count
    weight = np.exp(-0.5 * ((other[:, :2] - line[row, :2]) ** 2).sum(1) / SIGMA_M**2)
    weight *= np.abs(other[:, 2] - line[row, 2]) < LEVEL_GAP_M
    # Weighted means by row
    total = np.bincount(row, weight, len(line))
    return np.bincount(row, weight * other[:, 2], len(line)) / total
