"""Reconstruction of beams that did not return, for sweeps recorded without them."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.se3 import exp_se3, rotate_vectors, transform_points
from foredrive.scene import LidarSweep
from foredrive.sensors.lidar import SpinningLidar

_FEWEST = 20
"""Minimum number of returns to estimate the azimuth of a channel. Below it the table is used."""


_NEAR_STEPS = 0.75
"""Distance from a return, in columns, within which no miss is added. Real columns are not quite even."""


def with_missed_beams(sweep: LidarSweep, lidar: SpinningLidar, twist_ego: Float[Tensor, "6"]) -> LidarSweep:
    """Add the beams that a lidar fired but that did not return.

    A beam missed where the firing pattern has no return. Each return is assigned to the channel with the
    nearest elevation, and to a position on the circle of that channel. Azimuth and elevation of a channel are
    estimated from its returns, because devices differ. The range of a miss is 0 (unknown).

    Args:
        sweep: returns only, unbatched, in the ego frame at the time of the sweep.
        lidar: firing pattern. Of `T_ego_lidar` the rotation is used, and for misses also the position.
        twist_ego: velocity (m/s) and turn rate (rad/s) of the ego frame in its own axes.
    """
    # Directions in the lidar frame at the time of firing, and the channel by elevation
    T_then_ego = exp_se3(-sweep.dt_s[:, None] * twist_ego)
    fired = rotate_vectors(T_then_ego, sweep.dir_ego[:, None])[:, 0] @ lidar.T_ego_lidar[:3, :3]
    elevation = torch.asin(fired[:, 2].clamp(-1, 1))
    channel = (elevation[:, None] - torch.tensor(lidar.elevation_rad)).abs().argmin(1)
    # Clockwise angle minus the rotation of the head: nearly constant within a channel.
    turn_radps = 2 * math.pi * lidar.rate_hz
    lag = -torch.atan2(fired[:, 1], fired[:, 0]) - turn_radps * sweep.dt_s
    begin_s = float(sweep.dt_s.min()) if len(sweep.dt_s) else 0.0
    offsets = lidar.azimuth_offset_rad or (0.0,) * len(lidar.elevation_rad)
    all_of_it = _mean_angle(lag + torch.tensor(offsets)[channel])
    step = 2 * math.pi / lidar.azimuth_steps
    parts = []
    for number, (table_rad, offset_rad) in enumerate(zip(lidar.elevation_rad, offsets, strict=True)):
        mine = (channel == number).nonzero()[:, 0]
        enough = len(mine) >= _FEWEST
        # Lag and phase of this channel from its own returns, or the table if there are too few
        channel_lag = _mean_angle(lag[mine]) if enough else all_of_it - offset_rad
        # Angle of the head since the sweep began, for each return
        since = turn_radps * (sweep.dt_s[mine] - begin_s) + _wrapped(lag[mine] - channel_lag)
        # Circular mean of the position within a column step
        phase = _mean_angle(since / step * 2 * math.pi) / (2 * math.pi) * step if enough else 0.0
        # Columns without a return nearby
        since_missed = _alone(torch.arange(lidar.azimuth_steps) * step + phase, since, _NEAR_STEPS * step)
        # Time and azimuth of the missed beams, from the head's angle
        dt_s = begin_s + since_missed / turn_radps
        azimuth = -(since_missed + turn_radps * begin_s + channel_lag)
        upward = elevation[mine].mean() if enough else torch.tensor(table_rad)
        parts.append(_misses(dt_s, azimuth, upward.expand_as(azimuth), number, lidar, twist_ego))
    names = ("origin_ego", "dir_ego", "range_m", "returned", "intensity", "dt_s", "beam", "valid")
    returned = LidarSweep(**{**{n: getattr(sweep, n) for n in names}, "beam": channel})
    return LidarSweep(*(torch.cat([getattr(part, name) for part in (returned, *parts)]) for name in names))


def _alone(place: Float[Tensor, "S"], taken: Float[Tensor, "N"], reach: float) -> Float[Tensor, "M"]:
    """Return the places on a circle (rad) that have no element of `taken` within `reach`."""
    place, taken = place % (2 * math.pi), (taken % (2 * math.pi)).sort().values
    # The circle is repeated to both sides, so that neighbours across 0 are found
    taken = torch.cat([taken - 2 * math.pi, taken, taken + 2 * math.pi])
    if not len(taken):
        return place
    after = torch.searchsorted(taken, place).clamp(1, len(taken) - 1)
    return place[torch.minimum((taken[after] - place).abs(), (place - taken[after - 1]).abs()) > reach]


def _misses(
    dt_s: Float[Tensor, "M"],
    azimuth_rad: Float[Tensor, "M"],
    elevation_rad: Float[Tensor, "M"],
    channel: int,
    lidar: SpinningLidar,
    twist_ego: Float[Tensor, "6"],
) -> LidarSweep:
    level = elevation_rad.cos()
    fired = torch.stack([azimuth_rad.cos() * level, azimuth_rad.sin() * level, elevation_rad.sin()], dim=-1)
    # Pose of the lidar when the beam was fired
    T = exp_se3(dt_s[:, None] * twist_ego) @ lidar.T_ego_lidar
    zero, no = torch.zeros_like(dt_s), torch.zeros_like(dt_s, dtype=torch.bool)
    return LidarSweep(
        origin_ego=transform_points(T, torch.zeros_like(fired)[:, None])[:, 0],
        dir_ego=rotate_vectors(T, fired[:, None])[:, 0],
        range_m=zero,
        returned=no,
        intensity=zero,
        dt_s=dt_s,
        beam=torch.full_like(no, channel, dtype=torch.int64),
        valid=~no,
    )


def _mean_angle(angle_rad: Float[Tensor, "N"]) -> float:
    return float(torch.atan2(angle_rad.sin().sum(), angle_rad.cos().sum()))


def _wrapped(angle_rad: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
    return torch.remainder(angle_rad + math.pi, 2 * math.pi) - math.pi
