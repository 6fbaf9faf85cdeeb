"""Lidar beams as angles and firing times, in the form that compositing needs."""

import dataclasses
import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from foredrive.geometry.se3 import exp_se3, rotate_vectors, sensor_twist
from foredrive.methods.reconstruction.views import SweepView
from foredrive.ops.splat_points import TiledPoints, beam_points
from foredrive.sensors import TimedRays

SECTORS = 720
"""Number of sectors of azimuth in `scan_times`: half a degree each, 0.14 ms of a spinning lidar."""


@dataclass(frozen=True)
class PreparedSweep:
    """The beams of a sweep in the form that compositing needs: prepared once, used in every step."""

    tiles: TiledPoints
    """Times are relative to the middle of the sweep."""
    scan_s: Float[Tensor, "S"] | None
    """Result of `scan_times`. None: all beams are simultaneous."""
    dir_scene: Float[Tensor, "P 3"]
    T_scene_lidar: Float[Tensor, "4 4"]
    """Pose at the middle of the sweep."""
    twist_lidar: Float[Tensor, "6"]
    middle_s: float
    """Middle of the firing times, relative to the time of the sweep."""


def prepared_sweep(view: SweepView, rolling: bool = True) -> PreparedSweep:
    """Return the beams of a sweep in the lidar's frame: axes of the vehicle, origin at the lidar.

    Time 0 of the beams is the middle of the sweep. The motion of each Gaussian is right at the time at which
    its azimuth is scanned.

    Args:
        view: the sweep; its ranges are not read.
        rolling: beams have their own times. If False, all are simultaneous.
    """
    beams = view.beams
    rays = TimedRays(beams.origin_ego, beams.dir_ego, beams.dt_s)
    T_ego_lidar = torch.eye(4).to(beams.origin_ego)
    if len(beams.dt_s):
        # The mount is where the beam fired nearest to the sweep's time starts: ego motion is zero there
        T_ego_lidar[:3, 3] = beams.origin_ego[beams.dt_s.abs().argmin()]
    twist, middle_s = view.twist_ego, 0.0
    if not rolling:
        # Simultaneous beams: no motion of the sensor and no times of firing
        twist, rays = torch.zeros_like(twist), dataclasses.replace(rays, dt_s=torch.zeros_like(rays.dt_s))
    elif len(rays.dt_s):
        # Times relative to the middle of the sweep halve the largest time that motion is extrapolated over
        middle_s = float(rays.dt_s.min() + rays.dt_s.max()) / 2
    tiles = tiled_lidar_beams(rays, T_ego_lidar, twist, middle_s)
    return PreparedSweep(
        tiles=tiles,
        scan_s=scan_times(tiles) if bool(tiles.time_s.any()) else None,
        dir_scene=rotate_vectors(view.T_scene_ego, beams.dir_ego),
        # Pose of the lidar at the middle: ego pose of the sweep, moved on by its own motion, then the mount
        T_scene_lidar=view.T_scene_ego @ exp_se3(middle_s * twist) @ T_ego_lidar,
        twist_lidar=sensor_twist(T_ego_lidar, view.twist_ego),
        middle_s=middle_s,
    )


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
    # Row vectors times the matrix rotate to the lidar's axes (the inverse of lidar -> ego)
    fired = rotate_vectors(T_then_ego, rays.dir_ego[:, None])[:, 0] @ T_ego_lidar[:3, :3]
    azimuth = torch.atan2(fired[:, 1], fired[:, 0])
    elevation = torch.atan2(fired[:, 2], fired[:, :2].norm(dim=-1))
    return beam_points(azimuth, elevation, rays.dt_s - splats_s)


def scan_times(points: TiledPoints) -> Float[Tensor, "S"]:
    """Return the mean firing time of the beams in each of `SECTORS` sectors of azimuth, s; 0 without."""
    # Index -1 marks empty places of the tiles
    hits = points.index >= 0
    sector, time_s = sector_of(points.position[..., 0][hits]), points.time_s[hits]
    total = time_s.new_zeros(SECTORS).index_add(0, sector, time_s)
    return total / sector.bincount(minlength=SECTORS).clamp(min=1)


def sector_of(azimuth_rad: Float[Tensor, "*n"]) -> Int[Tensor, "*n"]:
    """Return the index of the sector that contains an azimuth; the first one begins at -π."""
    # Turns since -π; the fraction wraps azimuths outside of ±π
    turns = azimuth_rad / (2 * math.pi) + 0.5
    return ((turns - turns.floor()) * SECTORS).long().clamp(max=SECTORS - 1)
