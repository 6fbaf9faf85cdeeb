"""Self-attention among occupied pillars within windows of the ground (SST, Fan et al. 2022)."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

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
        window_yx = (cell_yx + shift).div(side, rounding_mode="floor")
        inside = cell_yx + shift - window_yx * side
        across = int(window_yx.max()) + 1 if len(window_yx) else 1
        window = (item * across + window_yx[:, 0]) * across + window_yx[:, 1]
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
