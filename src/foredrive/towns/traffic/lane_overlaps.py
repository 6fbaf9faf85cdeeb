"""Overlaps of two lanes: lanes that part from a common start, cross, or merge."""

from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float64, Int

APART_M = 3.4
"""Distance between reference lines at which all vehicles, long ones included, pass each other in a junction,
m."""
APART_ABREAST_M = 2.9
"""The same for lanes that run side by side, m."""
OVERPASS_M = 3.0
"""Height difference above which lanes do not meet, m."""


class LaneOverlaps(NamedTuple):
    """The lanes that each lane overlaps, in compressed rows: lane i has first[i]:first[i+1]."""

    first: Int[np.ndarray, "L_1"]
    other: Int[np.ndarray, "M"]
    enter_m: Float64[np.ndarray, "M"]
    """Arc length on this lane from which its traffic blocks the other lane, m."""
    other_enter_m: Float64[np.ndarray, "M"]
    """Arc length on the other lane from which its traffic blocks this lane, m."""
    other_clear_m: Float64[np.ndarray, "M"]
    """Arc length on the other lane from which its traffic is out of the way, m; infinite: at its end."""


def find_overlaps(
    lines: list[Float64[np.ndarray, "_ 3"]],
    lengths_m: Float64[np.ndarray, "L"],
    successors: list[list[int]],
    predecessors: list[list[int]],
    junction: Int[np.ndarray, "L"],
    groups: list[str],
) -> tuple[LaneOverlaps, LaneOverlaps]:
    """Find siblings (lanes that part from a common start) and conflicts (lanes that cross or merge).

    Lanes meet within a junction, or outside of junctions where they share an end. Lanes that follow each
    other do not meet, nor does a lane that passes over another.

    Args:
        lines: centrelines, sampled finely and evenly.
        groups: group of each lane. Lanes of one group run side by side.
    """
    parted, crossed = _Rows(), _Rows()
    flat = [shapely.LineString(line[:, :2]) for line in lines]
    # Candidate pairs by distance in the plane; each pair once
    pairs = shapely.STRtree(flat).query(flat, predicate="dwithin", distance=APART_M).T
    for a, b in pairs[pairs[:, 0] < pairs[:, 1]].tolist():
        parting = bool(set(predecessors[a]) & set(predecessors[b]))
        # Lanes may meet if they share a junction, a predecessor or a successor
        merging = bool(set(successors[a]) & set(successors[b]))
        together = junction[a] >= 0 and junction[a] == junction[b]
        serial = b in successors[a] or a in successors[b]
        if serial or not (together or parting or merging):
            continue
        # Lanes side by side need less distance than paths that cross
        abreast = groups[a] == groups[b] or not together
        near = _near(lines[a], lines[b], APART_ABREAST_M if abreast else APART_M)
        # The common start is a sibling stretch; only what comes together again later is a conflict
        if parting:
            near_a, near_b = _first_stretch(near.max(axis=1)), _first_stretch(near.max(axis=0))
            parted.add(a, b, near_a, near_b, lengths_m)
            near[near_a] = near[:, near_b] = False
        crossed.add(a, b, near.max(axis=1), near.max(axis=0), lengths_m)
    return parted.compressed(len(lines)), crossed.compressed(len(lines))


def _near(a: Float64[np.ndarray, "n 3"], b: Float64[np.ndarray, "m 3"], apart_m: float) -> np.ndarray:
    gap = a[:, None] - b[None]
    return (np.hypot(gap[..., 0], gap[..., 1]) < apart_m) & (np.abs(gap[..., 2]) < OVERPASS_M)


def _first_stretch(near: Bool[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Return the samples from the common start up to the point where the lanes part."""
    return np.logical_and.accumulate(near)


class _Rows:
    """Overlaps under construction."""

    def __init__(self) -> None:
        self._rows: list[tuple[int, int, float, float, float]] = []

    def add(
        self, a: int, b: int, near_a: np.ndarray, near_b: np.ndarray, lengths_m: Float64[np.ndarray, "L"]
    ) -> None:
        """Add the stretches of two lanes, as masks over their samples, on which they are close to each
        other."""
        if not near_a.any() or not near_b.any():
            return
        enter_a, clear_a = _span_m(near_a, lengths_m[a])
        enter_b, clear_b = _span_m(near_b, lengths_m[b])
        # Each pair is listed twice, once from each lane's point of view
        self._rows += [(a, b, enter_a, enter_b, clear_b), (b, a, enter_b, enter_a, clear_a)]

    def compressed(self, lane_count: int) -> LaneOverlaps:
        """Return the rows sorted by lane."""
        # Compressed rows: sorted by lane, `first` is the running count
        table = np.array(sorted(self._rows)).reshape(-1, 5)
        counts = np.bincount(table[:, 0].astype(np.int64), minlength=lane_count)
        return LaneOverlaps(
            np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            table[:, 1].astype(np.int64),
            *(np.ascontiguousarray(column) for column in table[:, 2:].T),
        )


def _span_m(near: Bool[np.ndarray, "n"], length_m: float) -> tuple[float, float]:
    """Return the first and the last arc length of the samples that are near, m; infinite if they reach the
    end."""
    first, last = np.flatnonzero(near)[[0, -1]]
    step_m = length_m / (len(near) - 1)
    return float(first * step_m), float("inf") if last + 1 >= len(near) else float((last + 1) * step_m)
