"""Self-attention within windows of the ground, over the pillars that are there (SST, Fan et al. 2022)."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from foredrive.ops.set_attention import attend_within


class Windows(NamedTuple):
    """Which pillars attend to each other, and where each lies in its window."""

    order: Int[Tensor, "K"]
    """Pillars, window by window."""
    counts: Int[Tensor, "W"]
    """How many each window holds."""
    place: Int[Tensor, "K"]
    """Row by row within a window."""

    @classmethod
    def cut(cls, cell_yx: Int[Tensor, "K 2"], item: Int[Tensor, "K"], side: int, shift: int) -> "Windows":
        """Windows of `side` cells each way whose borders lie `shift` cells before the grid's own."""
        window_yx = (cell_yx + shift).div(side, rounding_mode="floor")
        inside = cell_yx + shift - window_yx * side
        across = int(window_yx.max()) + 1 if len(window_yx) else 1
        window = (item * across + window_yx[:, 0]) * across + window_yx[:, 1]
        order = window.argsort(stable=True)
        _, counts = torch.unique_consecutive(window[order], return_counts=True)
        return cls(order, counts, inside[:, 0] * side + inside[:, 1])


class WindowBlock(nn.Module):
    """Pre-norm attention within windows and a feed-forward layer; where pillars lie tells queries and keys.

    Args:
        width, heads, hidden: d, its heads, the feed-forward layer's width.
        side: of a window, in cells.
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
        """Pillars after they have attended to those in their window."""
        normed = self.norm(features)
        query_key = self.to_query_key(normed + self.place[windows.place])
        value = self.to_value(normed)
        features = features + self.merge(
            attend_within(query_key, value, windows.order, windows.counts, self.heads)
        )
        return features + self.feed(features)


class WindowAttention(nn.Module):
    """Blocks whose windows are shifted by half a window in every other block (Liu et al. 2021)."""

    def __init__(self, *, blocks: int, width: int, heads: int, hidden: int, side: int) -> None:
        super().__init__()
        self.side = side
        self.blocks = nn.ModuleList([WindowBlock(width, heads, hidden, side) for _ in range(blocks)])

    def forward(
        self, features: Float[Tensor, "K D"], cell_yx: Int[Tensor, "K 2"], item: Int[Tensor, "K"]
    ) -> Float[Tensor, "K D"]:
        """Features of pillars that know their surroundings; pillars of different items never meet."""
        if len(features) == 0:
            return features
        both = [Windows.cut(cell_yx, item, self.side, shift) for shift in (0, self.side // 2)]
        for number, block in enumerate(self.blocks):
            features = block(features, both[number % 2])
        return features
