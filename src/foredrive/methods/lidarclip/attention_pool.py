"""Pooling of many tokens into one vector, as in CLIP's ResNets (Radford et al. 2021, section 2.4)."""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn


class AttentionPool(nn.Module):
    """Attention whose single query is the mean of the tokens, followed by a projection to D channels.

    A learned token is added to the tokens of each item, so that an item without tokens has an embedding too.

    Args:
        width: channels C of the tokens.
        heads: attention heads.
        dim: channels D of the output.
    """

    def __init__(self, width: int, heads: int, dim: int) -> None:
        super().__init__()
        self.heads = heads
        self.own = nn.Parameter(0.02 * torch.randn(width))
        self.norm = nn.LayerNorm(width)
        self.to_query = nn.Linear(width, width)
        self.to_key_value = nn.Linear(width, 2 * width)
        self.out = nn.Linear(2 * width, dim)

    def forward(
        self, tokens: Float[Tensor, "n T C"], filled: Bool[Tensor, "n T"] | None = None
    ) -> Float[Tensor, "n D"]:
        """Return one vector per item. `filled` marks the tokens that count; None means all of them."""
        rows = len(tokens)
        # The learned token comes first and is always filled
        tokens = torch.cat([self.own.expand(rows, 1, -1), tokens], dim=1)
        mask = None if filled is None else F.pad(filled, (1, 0), value=True)
        share = tokens.new_ones(tokens.shape[:2]) if mask is None else mask.to(tokens.dtype)
        # Shares of a mean over the filled tokens
        share = share / share.sum(1, keepdim=True)
        tokens = self.norm(tokens)
        # The mean is the query, and is passed on beside what the query attends to
        mean = torch.einsum("nt, ntc -> nc", share, tokens)
        return self.out(torch.cat([mean, self._seen(mean, tokens, mask)], dim=-1))

    def _seen(
        self, mean: Float[Tensor, "n C"], tokens: Float[Tensor, "n T C"], mask: Bool[Tensor, "n T"] | None
    ) -> Float[Tensor, "n C"]:
        """Return the attention of one query per item without computing a key or a value for any token.

        Keys are linear in the tokens, so the query is mapped into the space of the tokens instead. The bias
        of the keys adds the same number to all scores, which the softmax removes. The mean of the values is
        the value of the mean.
        """
        # The query of each head, in the space of the keys
        query = self.to_query(mean).unflatten(1, (self.heads, -1))
        to_key, to_value = self.to_key_value.weight.unflatten(0, (2, self.heads, -1))
        # Map the query to token space: q · (W t) = (Wᵀ q) · t
        asked = torch.einsum("nhd, hdc -> nhc", query, to_key) / math.sqrt(query.shape[-1])
        fit = asked @ tokens.mT
        if mask is not None:
            fit = fit.masked_fill(~mask[:, None], -torch.inf)
        # Attend to the tokens and map the result to values: one map per item instead of one per token
        seen = torch.einsum("nhc, hdc -> nhd", fit.softmax(-1) @ tokens, to_value)
        return seen.flatten(1) + self.to_key_value.bias[mean.shape[1] :]
