"""Spinning lidars: beams as timed rays."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from foredrive.geometry.se3 import exp_se3, rotate_vectors, transform_points
from foredrive.sensors.rays import TimedRays


@dataclass(frozen=True)
class SpinningLidar:
    """A column of lasers that turns clockwise, seen from above, and fires a whole column at a time.

    A revolution starts and ends looking backwards, and the frame's time is its end, so that all of a frame
    has been seen by then: straight ahead was seen half a period before.
    """

    elevation_rad: tuple[float, ...]
    """Elevation of each channel in the lidar frame, positive is up."""
    azimuth_steps: int
    """Columns a revolution."""
    rate_hz: float
    """Revolutions a second."""
    min_range_m: float
    max_range_m: float
    range_noise_m: float
    """Standard deviation of a measured range."""
    T_ego_lidar: Float[Tensor, "4 4"]
    """lidar (x forward, y left, z up) -> ego."""

    @property
    def channel(self) -> Int[Tensor, "N"]:
        """Channel of every beam, in the order of `beams`."""
        return torch.arange(len(self.elevation_rad)).repeat(self.azimuth_steps)

    def beams(self, twist_ego: Float[Tensor, "6"]) -> TimedRays:
        """The beams of one revolution, column by column, channels within a column in their order.

        Args:
            twist_ego: the ego frame's velocity (m/s), then its turn rate (rad/s), in its own axes, taken
                as constant over the revolution.

        Returns:
            Rays [N] in the ego frame at the end of the revolution; dt_s runs from -1/rate to 0.
        """
        steps = torch.arange(self.azimuth_steps)
        column_dt_s = ((steps + 1) / self.azimuth_steps - 1) / self.rate_hz
        azimuth = math.pi - (steps + 0.5) * (2 * math.pi / self.azimuth_steps)
        elevation = torch.tensor(self.elevation_rad)
        level = elevation.cos()
        direction = torch.stack(
            [
                azimuth.cos()[:, None] * level,
                azimuth.sin()[:, None] * level,
                elevation.sin().expand(self.azimuth_steps, -1),
            ],
            dim=-1,
        )  # [columns, channels, 3], lidar frame
        T_end_then = exp_se3(column_dt_s[:, None] * twist_ego)  # ego frame at firing -> at the end
        T = T_end_then @ self.T_ego_lidar
        origin = transform_points(T, torch.zeros_like(direction))
        return TimedRays(
            origin_ego=origin.flatten(0, 1),
            dir_ego=rotate_vectors(T, direction).flatten(0, 1),
            dt_s=column_dt_s.repeat_interleave(len(elevation)),
        )
