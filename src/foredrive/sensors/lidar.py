"""Timed rays of spinning lidars."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from foredrive.geometry.se3 import exp_se3, rotate_vectors, transform_points
from foredrive.sensors.rays import TimedRays

GOLDEN_ANGLE_RAD = math.pi * (3.0 - math.sqrt(5.0))


@dataclass(frozen=True)
class SpinningLidar:
    """A column of lasers that turns clockwise (seen from above) and fires column by column.

    A revolution starts and ends in the backward direction. The time of the frame is the end of the
    revolution, so all beams of a frame were fired before it. The forward beams were fired half a period
    earlier. `lidar_models` has real devices.

    Raises:
        ValueError: a table has a different number of channels, the lasers of a column need more time than a
            column takes, or `rays_per_beam` is below 1.
    """

    elevation_rad: tuple[float, ...]
    """Elevation of each channel in the lidar frame, positive upwards."""
    azimuth_steps: int
    """Columns per revolution."""
    rate_hz: float
    """Revolutions per second."""
    min_range_m: float
    max_range_m: float
    range_noise_m: float
    """Standard deviation of a measured range."""
    T_ego_lidar: Float[Tensor, "4 4"]
    """lidar (x forward, y left, z up) -> ego."""
    firing_s: tuple[float, ...] | None = None
    """Firing time of each channel within its column; the head turns meanwhile. None: all at the same time."""
    azimuth_offset_rad: tuple[float, ...] | None = None
    """Counter-clockwise azimuth offset of each channel from its column. None means 0."""
    divergence_rad: float = 0.0
    """Full opening angle of the beam cone."""
    rays_per_beam: int = 1
    """Number of rays that sample the footprint of a beam. 1 is the axis alone."""
    pulse_m: float = 0.75
    """Depth interval in which the echoes of one pulse merge: half the length of a 5 ns pulse."""
    echo: Literal["strongest", "last"] = "strongest"
    """The echo of a beam that is returned."""

    def __post_init__(self) -> None:
        if self.rays_per_beam < 1:
            raise ValueError(f"{self.rays_per_beam} rays for a beam, at least 1 is needed")
        for table in (self.firing_s, self.azimuth_offset_rad):
            if table is not None and len(table) != len(self.elevation_rad):
                raise ValueError(f"{len(self.elevation_rad)} channels, but a table of {len(table)}")
        # All lasers must have fired before the next column begins
        column_s = 1.0 / (self.rate_hz * self.azimuth_steps)
        if self.firing_s is not None and max(self.firing_s) - min(self.firing_s) > column_s:
            raise ValueError(f"the lasers of a column fire longer than the {column_s * 1e6:.1f} µs it takes")

    @property
    def channel(self) -> Int[Tensor, "N"]:
        """Return the channel of every beam, in the order of `beams`."""
        return torch.arange(len(self.elevation_rad)).repeat(self.azimuth_steps)

    def beams(self, twist_ego: Float[Tensor, "6"]) -> TimedRays:
        """Return the beams of one revolution: column by column, and in channel order within a column.

        The azimuth and time of a column are those of the channel that fires last.

        Args:
            twist_ego: velocity (m/s) and turn rate (rad/s) of the ego frame in its own axes, assumed constant
                over the revolution.

        Returns:
            Rays [N] in the ego frame at the end of the revolution. dt_s runs from -1/rate to 0.
        """
        dt_s, direction = self._firing
        # The ego frame moves while the head turns: pose at firing in the frame at the end
        T_end_then = exp_se3(dt_s[..., None] * twist_ego)  # ego frame at firing -> at the end
        T = T_end_then @ self.T_ego_lidar
        # Beams start at the lidar's centre at their own time
        origin = transform_points(T, torch.zeros_like(direction))
        return TimedRays(
            origin_ego=origin.reshape(-1, 3),
            dir_ego=rotate_vectors(T, direction).reshape(-1, 3),
            dt_s=dt_s.expand(-1, len(self.elevation_rad)).reshape(-1),
        )

    @cached_property
    def _firing(self) -> tuple[Float[Tensor, "columns moments"], Float[Tensor, "columns moments _ 3"]]:
        """Return firing times relative to the end of the revolution, s, and directions in the lidar frame."""
        steps = torch.arange(self.azimuth_steps)
        # Columns end at equal steps of time, the last one at 0
        dt_s = (((steps + 1) / self.azimuth_steps - 1) / self.rate_hz)[:, None]
        # Clockwise from backwards: the azimuth falls from π
        azimuth = (math.pi - (steps + 0.5) * (2 * math.pi / self.azimuth_steps))[:, None]
        if self.firing_s is not None:
            # Channels that fire earlier point further back in the turn, that is at a larger azimuth
            early_s = max(self.firing_s) - torch.tensor(self.firing_s)
            dt_s = dt_s - early_s
            azimuth = azimuth + 2 * math.pi * self.rate_hz * early_s
        if self.azimuth_offset_rad is not None:
            azimuth = azimuth + torch.tensor(self.azimuth_offset_rad)
        elevation = torch.tensor(self.elevation_rad)
        level = elevation.cos()
        direction = torch.stack(
            [
                azimuth.cos() * level,
                azimuth.sin() * level,
                elevation.sin().expand(self.azimuth_steps, -1),
            ],
            dim=-1,
        )  # [columns, channels, 3], lidar frame
        moments = dt_s.shape[1]  # firing times per column: 1, or one per channel
        return dt_s, direction.reshape(self.azimuth_steps, moments, -1, 3)

    def footprints(self, beams: TimedRays) -> TimedRays:
        """Return the rays of all beams [N · rays_per_beam]. The rays of a beam are adjacent.

        The rays fill the beam cone evenly (Vogel, "A better way to construct the sunflower head", 1979), so
        each ray carries the same share of the pulse.
        """
        if self.rays_per_beam == 1:
            return beams
        k = torch.arange(self.rays_per_beam)
        # Equal shares of the disc's area: the radius grows with the square root
        radius = 0.5 * self.divergence_rad * ((k + 0.5) / self.rays_per_beam).sqrt()
        ahead = beams.dir_ego[..., None, :]
        # Two unit vectors across the beam: level and upright
        up = torch.tensor([0.0, 0.0, 1.0]).expand_as(ahead)
        level = torch.nn.functional.normalize(ahead.cross(up, dim=-1), dim=-1)
        upright = level.cross(ahead, dim=-1)
        # Successive rays turn by the golden angle
        aside = (k * GOLDEN_ANGLE_RAD).cos()[:, None] * level + (k * GOLDEN_ANGLE_RAD).sin()[
            :, None
        ] * upright
        direction = radius.cos()[:, None] * ahead + radius.sin()[:, None] * aside
        return TimedRays(
            origin_ego=beams.origin_ego.repeat_interleave(self.rays_per_beam, dim=0),
            dir_ego=direction.flatten(0, 1),
            dt_s=beams.dt_s.repeat_interleave(self.rays_per_beam),
        )
