"""An encoder of lidar sweeps into the embedding space of an image tower."""

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from foredrive.models.attention_pool import AttentionPool
from foredrive.models.lidar_clip.pillars import PillarEncoder, PillarGrid, PointCloud
from foredrive.models.lidar_clip.windows import WindowAttention


@dataclass(frozen=True)
class LidarEncoderConfig:
    """Sizes of a `LidarEncoder`."""

    width: int = 128
    heads: int = 8
    hidden: int = 256
    """Width of the feed-forward layers."""
    blocks: int = 4
    block_layers: int = 1
    """Layers of attention in a block. SST has two, in plain and in shifted windows; towers that were stored
    without this number have one, by turns in plain and in shifted windows."""
    window: int = 12
    """Side of a window of attention, in pillars."""
    point_width: int = 64
    """Width of the features of points."""
    waves: int = 8
    """Sines and cosines per coordinate. The longest period is twice the grid, the shortest a few cells."""
    grid: PillarGrid = field(default_factory=PillarGrid)
    """Ground area that is read."""


class LidarEncoder(nn.Module):
    """The encoder of LidarCLIP (Hess et al. 2024, section 3): pillars, windowed attention, an attention pool.

    It reads the returns of one sector, with the x axis along its middle. It takes any number of returns from
    any lidar.

    Args:
        config: sizes.
        dim: D of the image tower.
    """

    cell_waves: Tensor

    def __init__(self, config: LidarEncoderConfig, *, dim: int) -> None:
        super().__init__()
        width, heads, cells = config.width, config.heads, config.grid.cells
        self.pillars = PillarEncoder(config.grid, (config.point_width, width))
        middle = (torch.arange(cells) + 0.5) / cells
        angle = middle[:, None] * math.pi * 2.0 ** (torch.arange(config.waves) * 0.5)
        self.register_buffer("cell_waves", torch.cat([angle.sin(), angle.cos()], dim=-1), persistent=False)
        self.place = nn.Linear(4 * config.waves, width)
        self.attention = WindowAttention(
            layers=config.blocks * config.block_layers,
            width=width,
            heads=heads,
            hidden=config.hidden,
            side=config.window,
        )
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
    max_count = int(count.max())
    tokens = features.new_zeros(items, max_count, features.shape[1]).index_put((item, place), features)
    return tokens, torch.arange(max_count, device=item.device) < count[:, None]
