"""Lidar beams as angles and firing times."""

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.se3 import exp_se3, rotate_vectors
from foredrive.ops.splat_points import TiledPoints, beam_points
from foredrive.sensors import TimedRays


def tiled_lidar_beams(
    rays: TimedRays,
    T_ego_lidar: Float[Tensor, "4 4"],
    twist_ego: Float[Tensor, "6"],
) -> TiledPoints:
    """Return angles and firing times of a lidar's beams in its own frame, for splats from `project_lidar`.

    The reference time of the splats is that of the rays: take `T_lidar_scene` and `twist_lidar` at that time.

    Args:
        rays: [N] in the ego frame at their reference time, ego motion compensated: a sensor's beams
            (`SpinningLidar.beams`) or those of a recorded sweep.
        T_ego_lidar: lidar -> ego.
        twist_ego: velocity (m/s) then turn rate (rad/s) of the ego frame in its own axes, as used for the
            compensation of the rays.
    """
    T_then_ego = exp_se3(-rays.dt_s[:, None] * twist_ego)  # ego at reference time -> ego at firing time
    fired = rotate_vectors(T_then_ego, rays.dir_ego[:, None])[:, 0] @ T_ego_lidar[:3, :3]
    azimuth = torch.atan2(fired[:, 1], fired[:, 0])
    elevation = torch.atan2(fired[:, 2], fired[:, :2].norm(dim=-1))
    return beam_points(azimuth, elevation, rays.dt_s)
