"""Spatial search in the samples of all centrelines."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int
from scipy.spatial import cKDTree

from foredrive.towns.traffic.lane_graph import LaneGraph

LEVEL_M = 2.5
"""Height difference between a lane and a point above which they are on different levels, m."""
HEIGHT_SAMPLES = 8
"""Number of nearest samples that are searched for one on the right level."""


@dataclass(frozen=True)
class LaneIndex:
    """The P samples of a town's centrelines."""

    xyz: Float64[np.ndarray, "P 3"]
    lane: Int[np.ndarray, "P"]
    along_m: Float64[np.ndarray, "P"]
    """Arc length on the lane, m."""
    ahead: Float64[np.ndarray, "P 2"]
    """Unit heading, seen from above."""
    heading: Float64[np.ndarray, "P"]
    slope: Float64[np.ndarray, "P"]
    tree: cKDTree
    """Search tree of the samples, seen from above."""

    def within(self, xyz: Float64[np.ndarray, "3"], reach_m: float) -> Int[np.ndarray, "K"]:
        """Return the samples on the level of a point within a distance of it, seen from above, sorted by
        lane."""
        # return_sorted orders by sample index, and samples are stored lane by lane
        samples = np.array(self.tree.query_ball_point(xyz[:2], reach_m, return_sorted=True), dtype=np.int64)
        return samples[np.abs(self.xyz[samples, 2] - xyz[2]) < LEVEL_M]

    def height_m(self, xy: Float64[np.ndarray, "n 2"], about_m: float) -> Float64[np.ndarray, "n"]:
        """Return the height of the road at points, on the level of the height `about_m`.

        Beside the road the height is the same as on it. Where no lane of that level is close, it is
        `about_m`.
        """
        # The nearest sample on the level among the nearest few: argmax gives the first that fits
        samples = np.asarray(self.tree.query(xy, HEIGHT_SAMPLES)[1])
        level = np.abs(self.xyz[samples, 2] - about_m) < LEVEL_M
        nearest = samples[np.arange(len(xy)), np.argmax(level, axis=1)]
        # The height continues along the slope, at most a metre from the sample
        along_m = np.sum((xy - self.xyz[nearest, :2]) * self.ahead[nearest], axis=1)
        z = self.xyz[nearest, 2] + along_m.clip(-1.0, 1.0) * self.slope[nearest]
        return np.where(level.any(axis=1), z, about_m)


def build_lane_index(graph: LaneGraph) -> LaneIndex:
    """Build the search for the samples of a graph's lanes."""
    lane = np.repeat(np.arange(len(graph.ids)), graph.count)
    index = np.arange(len(lane))
    # Direction of the segment that begins at each sample; the last sample takes the one before
    last = index == (graph.first + graph.count - 1)[lane]
    step = graph.xyz[np.where(last, index, index + 1)] - graph.xyz[np.where(last, index - 1, index)]
    flat_m = np.hypot(step[:, 0], step[:, 1]).clip(1e-9)
    return LaneIndex(
        xyz=graph.xyz,
        lane=lane,
        along_m=(index - graph.first[lane]) * graph.step_m[lane],
        ahead=step[:, :2] / flat_m[:, None],
        heading=np.arctan2(step[:, 1], step[:, 0]),
        slope=step[:, 2] / flat_m,
        tree=cKDTree(graph.xyz[:, :2]),
    )
