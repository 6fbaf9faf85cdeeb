"""Which lidar fired a sweep, told from its beams."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.se3 import exp_se3, rotate_vectors
from foredrive.scene import LidarSweep
from foredrive.sensors.lidar import SpinningLidar

_MOST_SPREAD_RAD = math.radians(0.25)
"""How far a channel's beams may lie (standard deviation) from one elevation; more, and they are not one
channel's, or the lidar is mounted askew."""


def measure_lidar(
    sweep: LidarSweep, twist_ego: Float[Tensor, "6"], *, period_s: float, reach_m: float
) -> SpinningLidar | None:
    """Channels, columns, rate and position; None where the channels of beams are not known, or uneven.

    Axes are taken to be those of the vehicle, columns to fire at once, and beams that are missing to miss in
    some channels only: the fullest says how many columns there are.

    Args:
        sweep: valid beams of one lidar, unbatched, in the ego frame at the sweep's time.
        twist_ego: velocity (m/s) then turn rate (rad/s) of the ego frame in its own axes.
        period_s: of a revolution, where beams carry no times.
        reach_m: how far it sees.
    """
    if not len(sweep.beam) or bool((sweep.beam < 0).any()):
        return None
    T_then_ego = exp_se3(-sweep.dt_s[:, None] * twist_ego)
    upwards = rotate_vectors(T_then_ego, sweep.dir_ego[:, None])[:, 0, 2]
    elevation = torch.asin(upwards.clamp(-1, 1))
    channels = [elevation[sweep.beam == channel] for channel in sweep.beam.unique()]
    if max(float(channel.std(correction=0)) for channel in channels) > _MOST_SPREAD_RAD:
        return None
    steps = max(len(channel) for channel in channels)
    span_s = float(sweep.dt_s.max() - sweep.dt_s.min())
    T_ego_lidar = torch.eye(4)
    T_ego_lidar[:3, 3] = sweep.origin_ego[sweep.dt_s.abs().argmin()]
    near_m = sweep.range_m[sweep.returned]
    return SpinningLidar(
        elevation_rad=tuple(float(channel.mean()) for channel in channels),
        azimuth_steps=steps,
        rate_hz=(1 - 1 / steps) / span_s if span_s > 0 else 1 / period_s,
        min_range_m=float(near_m.min()) if len(near_m) else 0.0,
        max_range_m=reach_m,
        range_noise_m=0.0,
        T_ego_lidar=T_ego_lidar,
    )
