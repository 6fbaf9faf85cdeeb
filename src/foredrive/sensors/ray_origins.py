"""The places of a drive's lidar from which RayIoU looks at a frame (Liu et al., SparseOcc, section 4).

Facts read in the public code: MCG-NJU/SparseOcc, loaders/ego_pose_dataset.py.
"""

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

MAX_ORIGINS = 8
"""Number of lidar positions of a drive from which a frame is looked at."""
ORIGIN_REACH_M = 39.0
"""They lie nearer than this to the ego vehicle, forward and sideways."""


def ray_origins(
    T_world_ego: Float64[ndarray, "F 4 4"], T_ego_lidar: Float64[ndarray, "F 4 4"], frame: int
) -> Float64[ndarray, "O 3"]:
    """Return the places from which one frame of a drive is looked at, in its ego frame, m.

    They are the positions of the lidar in all key frames of the drive less than 39 m away, forward and
    sideways. Of more than 8, 8 evenly spaced ones are taken.
    """
    # Positions of the lidar at all key frames, in the lidar frame of this one
    T_world_lidar = T_world_ego @ T_ego_lidar
    position = (np.linalg.inv(T_world_lidar[frame]) @ T_world_lidar)[:, :3, 3].astype(np.float32)
    position[frame] = 0.0
    # Into the ego frame of this frame
    in_ego = position.astype(np.float64) @ T_ego_lidar[frame, :3, :3].T + T_ego_lidar[frame, :3, 3]
    near = in_ego[(np.abs(in_ego[:, :2]) < ORIGIN_REACH_M).all(axis=1)]
    if len(near) > MAX_ORIGINS:
        near = near[np.round(np.linspace(0, len(near) - 1, MAX_ORIGINS)).astype(np.int64)]
    return near
