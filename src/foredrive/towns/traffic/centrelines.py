"""Centrelines of lanes: joined without gaps, evenly sampled, with curvatures and speed profiles."""

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import uniform_filter1d

from foredrive.geometry.polylines import arc_lengths, points_at
from foredrive.towns.map.town_map import Lane

SAMPLE_M = 0.5
SMOOTHED_SAMPLES = 7
CUBIC_SAMPLES = 9
"""Number of samples in the cubic smoothing of centrelines (Savitzky & Golay 1964). It moves them by a few
centimetres."""
LATERAL_MPS2 = 2.0
"""Comfortable lateral acceleration in curves, m/s²."""
SLOWING_MPS2 = 1.5
"""Comfortable deceleration before a curve or a lower limit, m/s²."""
MIN_OFFSET_M = 0.02


def join_centrelines(lanes: list[Lane], index: dict[str, int]) -> list[Float64[np.ndarray, "_ 3"]]:
    """Return centrelines without gaps: each begins where the last lane ends and ends where the next lane
    begins.

    Where two lanes merge, that point may lie to the side.
    """
    lines = [lane.centreline_xyz for lane in lanes]
    # First pull each end to the nearest successor's start, then each start to the nearest predecessor's end
    for i, lane in enumerate(lanes):
        lines[i] = _bent_to(lines[i], [lines[index[name]][0] for name in lane.successor_ids])
    for i, lane in enumerate(lanes):
        lines[i] = _bent_to(lines[i][::-1], [lines[index[name]][-1] for name in lane.predecessor_ids])[::-1]
    return lines


def _bent_to(
    line: Float64[np.ndarray, "n 3"], beginnings: list[Float64[np.ndarray, "3"]]
) -> Float64[np.ndarray, "_ 3"]:
    """Bend a line so that it ends in the nearest of some points."""
    offset = min((begin - line[-1] for begin in beginnings), key=np.linalg.norm, default=np.zeros(3))
    if np.linalg.norm(offset) < MIN_OFFSET_M:
        return line
    # Twice the samples, so that the quintic blend bends smoothly
    x = np.linspace(0.0, 1.0, 2 * len(line))[:, None]
    every = np.linspace(0.0, len(line) - 1.0, len(x))
    fine = points_at(line, np.arange(len(line), dtype=np.float64), every)
    # Quintic blend 0 → 1 with zero slope and curvature at both ends: neither end gets a kink
    return fine + x**3 * (10 - 15 * x + 6 * x**2) * offset


def resample(line: Float64[np.ndarray, "_ 3"]) -> Float64[np.ndarray, "_ 3"]:
    """Sample a line evenly, at most `SAMPLE_M` apart, and smooth it. Its ends do not move."""
    from scipy.signal import savgol_filter  # takes 0.3 s

    along = arc_lengths(line)
    count = max(2, int(np.ceil(along[-1] / SAMPLE_M)) + 1)
    s = np.linspace(0.0, along[-1], count)
    even = points_at(line, along, s)
    if count < CUBIC_SAMPLES:
        return even
    # The filter moves the ends too, so they are put back: neighbouring lanes must still meet
    smooth = savgol_filter(even, CUBIC_SAMPLES, 3, axis=0)  # the maps' polylines have corners, and one a kink
    smooth[[0, -1]] = even[[0, -1]]
    return smooth


def headings(line: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "_"]:
    """Return the heading of each segment between two samples, rad, unwrapped."""
    d = np.diff(line, axis=0)
    return np.unwrap(np.arctan2(d[:, 1], d[:, 0]))


def curvatures(line: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n"]:
    """Return the curvature at each sample, 1/m, averaged over some metres because the maps' polylines have
    corners."""
    if len(line) < 3:
        return np.zeros(len(line))
    # Headings belong to the middles of the segments; they are interpolated back to the samples
    step_m = np.linalg.norm(np.diff(line, axis=0), axis=1).mean()
    heading = uniform_filter1d(headings(line), SMOOTHED_SAMPLES, mode="nearest")
    at_samples = np.interp(np.arange(len(line)) - 0.5, np.arange(len(line) - 1), heading)
    return np.gradient(at_samples) / step_m


def speed_profile(
    curvature: Float64[np.ndarray, "n"], limit_mps: Float64[np.ndarray, "n"], length_m: float
) -> Float64[np.ndarray, "n"]:
    """Return the driving speed at each sample, m/s: v² ≤ a_lateral / |curvature|, then v² ≤ v_next² + 2 b ds
    backwards."""
    step_m = length_m / (len(curvature) - 1)
    # Square of the speed allowed by limit and curvature at each sample alone
    square = np.minimum(limit_mps**2, LATERAL_MPS2 / np.abs(curvature).clip(1e-6))
    # v² + 2 b s must not exceed its minimum over all later samples: one backward pass of minima suffices
    to_end = 2 * SLOWING_MPS2 * step_m * np.arange(len(curvature))
    return np.sqrt(np.minimum.accumulate((square + to_end)[::-1])[::-1] - to_end)
