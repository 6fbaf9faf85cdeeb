"""Beams as a lidar fires them."""

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.se3 import exp_se3, rotate_vectors
from foredrive.ops.splat_points import TiledPoints, beam_points
from foredrive.sensors import TimedRays


def lidar_points(
    rays: TimedRays,
    T_ego_lidar: Float[Tensor, "4 4"],
    twist_ego: Float[Tensor, "6"],
) -> TiledPoints:
    """Where and when a lidar's beams look in its own frame, for splats from `project_lidar`.

    The splats' time is that of the rays: their `T_lidar_scene` and `twist_lidar` are to be taken then.

    Args:
        rays: [N] in the ego frame at their reference time, ego motion until then included: a sensor's beams
            (`SpinningLidar.beams`) or those of a recorded sweep.
        T_ego_lidar: lidar -> ego.
        twist_ego: the ego frame's velocity (m/s) then turn rate (rad/s), in its own axes: what the rays were
            turned by.
    """
    T_then_ego = exp_se3(-rays.dt_s[:, None] * twist_ego)  # ego at the reference time -> when fired
    fired = rotate_vectors(T_then_ego, rays.dir_ego[:, None])[:, 0] @ T_ego_lidar[:3, :3]
    azimuth = torch.atan2(fired[:, 1], fired[:, 0])
    elevation = torch.atan2(fired[:, 2], fired[:, :2].norm(dim=-1))
    return beam_points(azimuth, elevation, rays.dt_s)
