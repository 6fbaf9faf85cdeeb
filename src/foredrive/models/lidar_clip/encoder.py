"""An encoder of lidar sweeps into the embedding space of an image tower."""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from foredrive.models.attention_pool import AttentionPool
from foredrive.models.lidar_clip.pillars import PillarEncoder, PillarGrid, PointCloud
from foredrive.models.lidar_clip.windows import WindowAttention

POINT_WIDTH = 64
WAVES = 8
"""Sines and cosines per coordinate. The longest period is twice the grid, the shortest a few cells."""


class LidarEncoder(nn.Module):
    """The encoder of LidarCLIP (Hess et al. 2024, section 3): pillars, windowed attention, an attention pool.

    It reads the returns of one sector, with the x axis along its middle. It takes any number of returns from
    any lidar.

    Args:
        grid: the ground area that is read.
        dim: D of the image tower.
        width, heads, hidden, blocks: sizes of the attention.
        window: side of a window, in pillars.
    """

    cell_waves: Tensor

    def __init__(
        self,
        grid: PillarGrid,
        *,
        dim: int,
        width: int = 128,
        heads: int = 8,
        hidden: int = 256,
        blocks: int = 4,
        window: int = 12,
    ) -> None:
        super().__init__()
        self.pillars = PillarEncoder(grid, (POINT_WIDTH, width))
        cells = (torch.arange(grid.cells) + 0.5) / grid.cells
        angle = cells[:, None] * math.pi * 2.0 ** (torch.arange(WAVES) * 0.5)
        self.register_buffer("cell_waves", torch.cat([angle.sin(), angle.cos()], dim=-1), persistent=False)
        self.place = nn.Linear(4 * WAVES, width)
        self.attention = WindowAttention(blocks=blocks, width=width, heads=heads, hidden=hidden, side=window)
        self.pool = AttentionPool(width, heads, dim)

    def forward(self, cloud: PointCloud, items: int) -> Float[Tensor, "n D"]:
        """Return one vector for each of `items` sweeps, including sweeps without returns."""
        pillars = self.pillars(cloud, items)
        waves = self.cell_waves[pillars.cell_yx].flatten(1)
        features = self.attention(pillars.features + self.place(waves), pillars.cell_yx, pillars.item)
        return self.pool(*_padded(features, pillars.item, items))


def _padded(
    features: Float[Tensor, "K C"], item: Int[Tensor, "K"], items: int
) -> tuple[Float[Tensor, "n T C"], Bool[Tensor, "n T"]]:
    """Return the tokens grouped by item, padded, and a mask of the real ones."""
    count = torch.bincount(item, minlength=items)
    place = torch.arange(len(item), device=item.device) - (count.cumsum(0) - count)[item]
    longest = int(count.max())
    tokens = features.new_zeros(items, longest, features.shape[1]).index_put((item, place), features)
    return tokens, torch.arange(longest, device=item.device) < count[:, None]
