"""Lidar beams as angles and firing times."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from foredrive.geometry.se3 import exp_se3, rotate_vectors
from foredrive.ops.splat_points import TiledPoints, beam_points
from foredrive.sensors import TimedRays

SECTORS = 720
"""Number of sectors of azimuth in `scan_times`: half a degree each, 0.14 ms of a spinning lidar."""


def tiled_lidar_beams(
    rays: TimedRays,
    T_ego_lidar: Float[Tensor, "4 4"],
    twist_ego: Float[Tensor, "6"],
    splats_s: float = 0.0,
) -> TiledPoints:
    """Return angles and firing times of a lidar's beams in its own frame, for splats from `project_lidar`.

    Args:
        rays: [N] in the ego frame at their reference time, ego motion compensated: a sensor's beams
            (`SpinningLidar.beams`) or those of a recorded sweep.
        T_ego_lidar: lidar -> ego.
        twist_ego: velocity (m/s) then turn rate (rad/s) of the ego frame in its own axes, as used for the
            compensation of the rays.
        splats_s: time 0 of the splats, relative to the reference time of the rays. `T_lidar_scene` of the
            splats is the pose at that time.
    """
    T_then_ego = exp_se3(-rays.dt_s[:, None] * twist_ego)  # ego at reference time -> ego at firing time
    fired = rotate_vectors(T_then_ego, rays.dir_ego[:, None])[:, 0] @ T_ego_lidar[:3, :3]
    azimuth = torch.atan2(fired[:, 1], fired[:, 0])
    elevation = torch.atan2(fired[:, 2], fired[:, :2].norm(dim=-1))
    return beam_points(azimuth, elevation, rays.dt_s - splats_s)


def scan_times(points: TiledPoints) -> Float[Tensor, "S"]:
    """Return the mean firing time of the beams in each of `SECTORS` sectors of azimuth, s; 0 without."""
    there = points.index >= 0
    sector, time_s = sector_of(points.position[..., 0][there]), points.time_s[there]
    total = time_s.new_zeros(SECTORS).index_add(0, sector, time_s)
    return total / sector.bincount(minlength=SECTORS).clamp(min=1)


def sector_of(azimuth_rad: Float[Tensor, "*n"]) -> Int[Tensor, "*n"]:
    """Return the index of the sector that contains an azimuth; the first one begins at -π."""
    turns = azimuth_rad / (2 * math.pi) + 0.5
    return ((turns - turns.floor()) * SECTORS).long().clamp(max=SECTORS - 1)
