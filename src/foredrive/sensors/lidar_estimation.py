"""Estimation of a lidar model from the beams of a sweep."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.se3 import exp_se3, rotate_vectors
from foredrive.scene import LidarSweep
from foredrive.sensors.lidar import SpinningLidar

_MAX_SPREAD_RAD = math.radians(0.25)
"""Maximum standard deviation of the elevations of one channel. If it is larger, the beams are not from one
channel, or the lidar is tilted."""


def estimate_lidar(
    sweep: LidarSweep, twist_ego: Float[Tensor, "6"], *, period_s: float, reach_m: float
) -> SpinningLidar | None:
    """Estimate channels, columns, rate and position of the lidar that fired a sweep.

    The lidar axes are assumed to be the vehicle axes, and all lasers of a column to fire at the same time.
    Beams may be missing in some channels: the channel with the most beams gives the number of columns. Return
    None if the channels of the beams are unknown, or if the elevation within a channel varies too much.

    Args:
        sweep: valid beams of one lidar, unbatched, in the ego frame at the time of the sweep.
        twist_ego: velocity (m/s) and turn rate (rad/s) of the ego frame in its own axes.
        period_s: time of one revolution, used where beams have no times.
        reach_m: maximum range.
    """
    if not len(sweep.beam) or bool((sweep.beam < 0).any()):
        return None
    # Directions in the ego frame at the time of firing
    T_then_ego = exp_se3(-sweep.dt_s[:, None] * twist_ego)
    upwards = rotate_vectors(T_then_ego, sweep.dir_ego[:, None])[:, 0, 2]
    elevation = torch.asin(upwards.clamp(-1, 1))
    # Mean elevation of each channel; a large spread means that the assumption does not hold
    channels = [elevation[sweep.beam == channel] for channel in sweep.beam.unique()]
    if max(float(channel.std(correction=0)) for channel in channels) > _MAX_SPREAD_RAD:
        return None
    steps = max(len(channel) for channel in channels)
    # Time from the first to the last column: one step less than a revolution
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
