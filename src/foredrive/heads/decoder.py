"""The decoder layer for all kinds of query: agents, points of map elements, modes of motion."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn


@dataclass(frozen=True)
class DecoderConfig:
    """Sizes of a decoder."""

    layers: int = 2
    heads: int = 4
    feed_forward: int = 2
    """Width of the feed-forward network as a multiple of the queries' width."""


class QueryDecoderLayer(nn.Module):
    """Attention among queries, attention to the plane, and a feed-forward network, each after a norm.

    Places are added to queries and keys but not to values (Carion et al. 2020, DETR). Norms
    come first, as in Xiong et al. 2020.

    Args:
        width: channels of queries and plane.
        config: sizes.
    """

    def __init__(self, width: int, config: DecoderConfig) -> None:
        super().__init__()
        self.among = nn.MultiheadAttention(width, config.heads, batch_first=True)
        self.to_plane = nn.MultiheadAttention(width, config.heads, batch_first=True)
        hidden = config.feed_forward * width
        self.feed_forward = nn.Sequential(nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, width))
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(3))

    def forward(
        self,
        queries: Float[Tensor, "b Q W"],
        place: Float[Tensor, "b Q W"],
        cells: Float[Tensor, "b C W"],
        cell_place: Float[Tensor, "#b C W"],
    ) -> Float[Tensor, "b Q W"]:
        """Return the queries after one layer. `place` and `cell_place` are embeddings of positions."""
        normed = self.norms[0](queries)
        # Positions are part of queries and keys, values are features alone
        asked = normed + place
        queries = queries + self.among(asked, asked, normed, need_weights=False)[0]
        asked = self.norms[1](queries) + place
        keys = cells + cell_place
        queries = queries + self.to_plane(asked, keys, cells, need_weights=False)[0]
        after: Tensor = queries + self.feed_forward(self.norms[2](queries))
        return after


class PlaceEmbedding(nn.Module):
    """An embedding of positions in the plane: sines and cosines of several wavelengths, then a linear layer.

    Args:
        width: channels of the embedding.
        octaves: number of wavelengths. The longest is twice the plane, each next one half as long.
    """

    frequency: Tensor

    def __init__(self, width: int, octaves: int = 6) -> None:
        super().__init__()
        self.register_buffer("frequency", math.pi * 2.0 ** torch.arange(octaves), persistent=False)
        self.linear = nn.Linear(4 * octaves, width)

    def forward(self, share: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n W"]:
        """Embed positions that are given as shares of the plane's extent."""
        angle = (share[..., None] * self.frequency).flatten(-2)
        embedding: Tensor = self.linear(torch.cat([angle.sin(), angle.cos()], dim=-1))
        return embedding
