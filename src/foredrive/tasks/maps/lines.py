"""Predicted and true map elements, as every vector protocol reads them, and distances between polylines."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float, Float64, Int
from numpy import ndarray

from foredrive.geometry.polylines import arc_lengths, points_at
from foredrive.scene.map_elements import ElementKind

CLASSES = (ElementKind.DIVIDER, ElementKind.CROSSING, ElementKind.BOUNDARY)
"""The classes that all protocols judge."""


@dataclass(frozen=True)
class LineSet:
    """M polylines of all frames of a data set."""

    frame: Int[ndarray, "M"]
    """Number of the frame."""
    kind: Int[ndarray, "M"]
    """An `ElementKind`."""
    lines: Sequence[Float[ndarray, "_ 2"]]
    """At least two vertices each, in the ego frame at the frame's time, m. An outline ends as it begins."""
    score: Float[ndarray, "M"]
    """Score in [0, 1]; 1 for the truth."""
    identity: Int[ndarray, "M"] | None = None
    """Identity of the element within its drive. None: not tracked."""

    def __getitem__(self, which: Int[ndarray, "n"]) -> "LineSet":
        """Take elements by their indices."""
        return dataclasses.replace(
            self,
            frame=self.frame[which],
            kind=self.kind[which],
            lines=[self.lines[i] for i in which],
            score=self.score[which],
            identity=None if self.identity is None else self.identity[which],
        )

    def resampled(self, points: int) -> Float64[ndarray, "M points 2"]:
        """Return the polylines with `points` vertices each, at equal distances along the line."""
        points_of = np.empty((len(self.lines), points, 2))
        for row, line in enumerate(self.lines):
            points_of[row] = resample(line, points)
        return points_of


def resample(line: Float[ndarray, "V 2"], points: int) -> Float64[ndarray, "points 2"]:
    """Return `points` vertices at equal distances along a polyline, its ends included."""
    arc_m = arc_lengths(line)
    return points_at(line, arc_m, np.linspace(0.0, arc_m[-1], points))


def chamfer_distances(
    lines: Float[ndarray, "m P 2"], others: Float[ndarray, "n P 2"], *, at_most_m: float = np.inf
) -> Float64[ndarray, "m n"]:
    """Return half the sum of the mean distances from each line's vertices to the nearest of the other's.

    Pairs that are surely farther apart than `at_most_m` have +inf: no vertex is nearer to a line than to its
    bounding box.
    """
    return _chamfer(np.ascontiguousarray(lines), np.ascontiguousarray(others), at_most_m)


@numba.njit(cache=True, nogil=True)
@no_type_check
def _chamfer(lines, others, at_most_m):
    # Arguments: lines [m P 2] and [n P 2] in m; pairs out of reach stay at infinity
    distance_m = np.full((len(lines), len(others)), np.inf)
    for i in range(len(lines)):
        for j in range(len(others)):
            # Distances to bounding boxes are lower bounds, and much cheaper than those to lines
            if _to_box(lines[i], others[j]) + _to_box(others[j], lines[i]) <= 2 * at_most_m + 1e-9:
                distance_m[i, j] = 0.5 * (_one_way(lines[i], others[j]) + _one_way(others[j], lines[i]))
    return distance_m


@numba.njit(cache=True, nogil=True)
@no_type_check
def _one_way(line, other):
    total = 0.0
    for p in range(len(line)):
        nearest = np.inf
        for q in range(len(other)):
            # Squared distances inside of the loop, one root at the end
            x, y = line[p, 0] - other[q, 0], line[p, 1] - other[q, 1]
            nearest = min(nearest, x * x + y * y)
        total += np.sqrt(nearest)
    return total / len(line)


@numba.njit(cache=True, nogil=True)
@no_type_check
def _to_box(line, other):
    """Return the mean distance from the vertices of a line to the bounding box of the other."""
    x0, x1 = other[:, 0].min(), other[:, 0].max()
    y0, y1 = other[:, 1].min(), other[:, 1].max()
    total = 0.0
    for p in range(len(line)):
        # 0 between the sides of the box, else the distance to the nearer one
        x = max(x0 - line[p, 0], 0.0, line[p, 0] - x1)
        y = max(y0 - line[p, 1], 0.0, line[p, 1] - y1)
        total += np.sqrt(x * x + y * y)
    return total / len(line)
