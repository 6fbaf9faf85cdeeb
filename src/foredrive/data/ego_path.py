"""Poses between and beyond those of a log."""

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation, Slerp


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
