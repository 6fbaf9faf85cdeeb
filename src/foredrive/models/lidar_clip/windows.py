"""Self-attention within windows of the ground, over the pillars that are there (SST, Fan et al. 2022)."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

BUCKETS = (8, 16, 32, 64)
"""Windows with at most as many pillars are padded to one length and attend together."""


class Group(NamedTuple):
    """Windows of about as many pillars, padded to L."""

    pillar: Int[Tensor, "w L"]
    """Which they hold; a padded place has the window's first."""
    filled: Bool[Tensor, "w L"]


class Windows(NamedTuple):
    """Which pillars attend to each other, and where each lies in its window."""

    groups: tuple[Group, ...]
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
        return cls(tuple(_groups(order, counts, side)), inside[:, 0] * side + inside[:, 1])


def _groups(order: Int[Tensor, "K"], counts: Int[Tensor, "W"], side: int) -> list[Group]:
    starts, groups, least = counts.cumsum(0) - counts, [], 0
    for length in (*(bucket for bucket in BUCKETS if bucket < side**2), side**2):
        chosen = (counts > least) & (counts <= length)
        least = length
        if bool(chosen.any()):
            count = counts[chosen, None]
            steps = torch.arange(int(count.max()), device=order.device)
            filled = steps < count
            groups.append(Group(order[starts[chosen, None] + torch.where(filled, steps, 0)], filled))
    return groups


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
        split = torch.cat([query_key, self.to_value(normed)], dim=-1)
        parts = [self._attend(split, group) for group in windows.groups]
        kept = torch.cat([group.pillar[group.filled] for group in windows.groups])
        attended = torch.empty_like(features).index_copy_(0, kept, torch.cat(parts))
        features = features + self.merge(attended)
        return features + self.feed(features)

    def _attend(self, split: Float[Tensor, "K three_D"], group: Group) -> Float[Tensor, "F D"]:
        rows, length = group.pillar.shape
        query, key, value = (
            part.view(rows, length, self.heads, -1).transpose(1, 2)
            for part in split[group.pillar].chunk(3, -1)
        )
        mask = group.filled[:, None, None, :]
        out = F.scaled_dot_product_attention(query, key, value, attn_mask=mask)
        return out.transpose(1, 2).reshape(rows, length, -1)[group.filled]


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
