"""Many tokens to one vector, as CLIP's ResNets do it (Radford et al. 2021, section 2.4)."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn


class AttentionPool(nn.Module):
    """Attention whose one query is the mean of the tokens, and a projection to D.

    A learned token stands beside those of each item, so that an item without any has an embedding too.

    Args:
        width, heads: of the tokens, and of the attention.
        dim: D.
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
        """One vector an item; None where every token counts."""
        rows = len(tokens)
        tokens = torch.cat([self.own.expand(rows, 1, -1), tokens], dim=1)
        mask = None if filled is None else F.pad(filled, (1, 0), value=True)
        share = tokens.new_ones(tokens.shape[:2]) if mask is None else mask.to(tokens.dtype)
        share = share / share.sum(1, keepdim=True)
        tokens = self.norm(tokens)
        mean = torch.einsum("nt, ntc -> nc", share, tokens)
        query = self.to_query(mean).view(rows, 1, self.heads, -1).transpose(1, 2)
        key, value = (
            part.view(rows, part.shape[1], self.heads, -1).transpose(1, 2)
            for part in self.to_key_value(tokens).chunk(2, dim=-1)
        )
        seen = F.scaled_dot_product_attention(
            query, key, value, attn_mask=None if mask is None else mask[:, None, None, :]
        )
        return self.out(torch.cat([mean, seen.transpose(1, 2).reshape(rows, -1)], dim=-1))
