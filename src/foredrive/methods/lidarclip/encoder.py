"""An encoder of lidar sweeps into the embedding space of an image tower.

Occupied pillars attend to each other within windows of the ground (SST, Fan et al. 2022).
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from foredrive.methods.lidarclip.attention_pool import AttentionPool
from foredrive.methods.lidarclip.pillars import PillarEncoder, PillarGrid, PointCloud
from foredrive.ops.set_attention import attend_within


class Windows(NamedTuple):
    """A partition of pillars into windows; pillars attend to each other within a window."""

    order: Int[Tensor, "K"]
    """Pillar indices, window by window."""
    counts: Int[Tensor, "W"]
    """Number of pillars in each window."""
    place: Int[Tensor, "K"]
    """Cell of each pillar within its window, in row order."""

    @classmethod
    def cut(cls, cell_yx: Int[Tensor, "K 2"], item: Int[Tensor, "K"], side: int, shift: int) -> "Windows":
        """Cut the grid into windows of `side` by `side` cells, borders `shift` cells before the grid's."""
        # A positive shift moves the borders of windows towards the origin
        window_yx = (cell_yx + shift).div(side, rounding_mode="floor")
        inside = cell_yx + shift - window_yx * side
        across = int(window_yx.max()) + 1 if len(window_yx) else 1
        # One number per window and item; `across` bounds the window numbers along both axes
        window = (item * across + window_yx[:, 0]) * across + window_yx[:, 1]
        # A stable order groups the pillars of a window; their counts delimit the groups
        order = window.argsort(stable=True)
        _, counts = torch.unique_consecutive(window[order], return_counts=True)
        return cls(order, counts, inside[:, 0] * side + inside[:, 1])


class WindowLayer(nn.Module):
    """Pre-norm attention within windows and a feed-forward layer. Queries and keys get a place code.

    Args:
        width, heads: channels d and heads of the attention.
        hidden: width of the feed-forward layer.
        side: side of a window, in cells.
    """

    def __init__(self, width: int, heads: int, hidden: int, side: int) -> None:
        super().__init__()
        self.heads = heads
        self.place = nn.Parameter(0.02 * torch.randn(side * side, width))
        self.norm = nn.LayerNorm(width)
        self.to_query_key = nn.Linear(width, 2 * width)
        self.to_value = nn.Linear(width, width)
        self.merge = nn.Linear(width, width)
        self.feed = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, hidden), nn.GELU(), nn.Linear(hidden, width)
        )

    def forward(self, features: Float[Tensor, "K D"], windows: Windows) -> Float[Tensor, "K D"]:
        """Return the pillars after attention within their windows."""
        normed = self.norm(features)
        # The place code tells where in the window a pillar lies; values do not contain it
        query_key = self.to_query_key(normed + self.place[windows.place])
        value = self.to_value(normed)
        features = features + self.merge(
            attend_within(query_key, value, windows.order, windows.counts, self.heads)
        )
        return features + self.feed(features)


class WindowAttention(nn.Module):
    """Layers whose windows are shifted by half a window in every other layer (Liu et al. 2021)."""

    def __init__(self, *, layers: int, width: int, heads: int, hidden: int, side: int) -> None:
        super().__init__()
        self.side = side
        # The weights of stored towers have this name; it is one layer each.
        self.blocks = nn.ModuleList([WindowLayer(width, heads, hidden, side) for _ in range(layers)])

    def forward(
        self, features: Float[Tensor, "K D"], cell_yx: Int[Tensor, "K 2"], item: Int[Tensor, "K"]
    ) -> Float[Tensor, "K D"]:
        """Return pillar features with context. Pillars of different items never attend to each other."""
        if len(features) == 0:
            return features
        both = [Windows.cut(cell_yx, item, self.side, shift) for shift in (0, self.side // 2)]
        for number, layer in enumerate(self.blocks):
            features = layer(features, both[number % 2])
        return features


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
        # Sines and cosines of the position in the grid, periods falling by √2 from twice the grid
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
    # Rank of each pillar within its item: the pillars are sorted by item
    place = torch.arange(len(item), device=item.device) - (count.cumsum(0) - count)[item]
    max_count = int(count.max())
    tokens = features.new_zeros(items, max_count, features.shape[1]).index_put((item, place), features)
    return tokens, torch.arange(max_count, device=item.device) < count[:, None]
