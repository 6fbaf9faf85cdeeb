"""Poses between and beyond those of a log."""

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial.transform import Rotation, Slerp

MAX_GAP_S = 1.0
"""Maximum time between poses for interpolation."""
STANDS_M, _STANDS_RAD = 0.1, np.deg2rad(1.0)
"""A vehicle that moves and turns by less between two poses stands, however far apart they are."""


def interpolated_poses(
    at_us: Int64[np.ndarray, "P"], T: Float64[np.ndarray, "P 4 4"], t_us: Float64[np.ndarray, "N"]
) -> Float64[np.ndarray, "N 4 4"]:
    """Return poses at N times: positions linear, rotations at a constant rate between two of the P ≥ 2 poses.

    Before the first and after the last pose they are that pose. Times `at_us` increase.
    """
    out = np.tile(np.eye(4), (len(t_us), 1, 1))
    if not len(t_us):
        return out
    after = np.searchsorted(at_us, t_us).clip(1, len(at_us) - 1)
    # Only the poses around the wanted times, with times from a near origin for precision
    span = slice(after.min() - 1, after.max() + 1)
    start_us, inside_us = at_us[span][0], t_us.clip(at_us[0], at_us[-1])
    turn = Slerp((at_us[span] - start_us) * 1e-6, Rotation.from_matrix(T[span, :3, :3]))
    out[:, :3, :3] = turn((inside_us - start_us) * 1e-6).as_matrix()
    for axis in range(3):
        out[:, axis, 3] = np.interp(inside_us, at_us[span], T[span, axis, 3])
    return out


def in_holes(
    at_us: Int64[np.ndarray, "P"], T: Float64[np.ndarray, "P 4 4"], t_us: Int64[np.ndarray, "N"]
) -> Bool[np.ndarray, "N"]:
    """Return which times lie between two poses of a moving vehicle that are more than `MAX_GAP_S` apart.

    Times at a pose, and before the first or after the last one, do not. Times `at_us` increase.
    """
    after = np.searchsorted(at_us, t_us).clip(1, max(len(at_us) - 1, 1))
    if len(at_us) < 2:
        return np.zeros(len(t_us), bool)
    between = (at_us[after - 1] < t_us) & (t_us < at_us[after])
    step = np.linalg.inv(T[after - 1]) @ T[after]
    turned_rad = np.arccos(((np.trace(step[:, :3, :3], axis1=1, axis2=2) - 1) / 2).clip(-1, 1))
    moved = (np.linalg.norm(step[:, :3, 3], axis=1) > STANDS_M) | (turned_rad > _STANDS_RAD)
    return between & moved & (at_us[after] - at_us[after - 1] > MAX_GAP_S * 1e6)
