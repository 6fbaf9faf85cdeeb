"""A transformer decoder layer for few queries and a large memory."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn


def attend_few(
    attention: nn.MultiheadAttention, query: Float[Tensor, "b Q C"], memory: Float[Tensor, "b N C"]
) -> Float[Tensor, "b Q C"]:
    """Return `attention(query, memory, memory)` without computing keys and values for each of the N places.

    Since q·(W m) = (Wᵀ q)·m, the queries are projected into the space of the memory, and the value projection
    is applied after the average. This takes Q·H·N·C products instead of N·C², and no [b N C] tensor is kept
    except the memory itself: 16 times less for one query with 4 heads of 32 channels. The bias of the keys
    shifts all scores of a query equally, so the softmax cancels it.

    Args:
        attention: batch first, one packed projection, no masks. Its dropout acts on the weights as usual.
        query, memory: C channels each; Q and N are arbitrary.
    """
    assert attention.in_proj_weight is not None
    b, count, channels = query.shape
    heads, width = attention.num_heads, channels // attention.num_heads
    to_query, to_key, to_value = attention.in_proj_weight.chunk(3)
    bias_query, _, bias_value = attention.in_proj_bias.chunk(3)
    # Scaled query of each head, then its projection into the space of the memory (Wᵀ q)
    asked = F.linear(query, to_query, bias_query).view(b, count, heads, width) * width**-0.5
    asked = torch.einsum("bqhw,hwc->bqhc", asked, to_key.view(heads, width, channels))
    # Scores and weights over the memory, all heads and queries in one product
    weight = (asked.flatten(1, 2) @ memory.transpose(1, 2)).softmax(-1)  # [b, Q·H, N]
    weight = F.dropout(weight, attention.dropout, attention.training)
    # Weighted mean of the memory, then the value projection of each head
    seen = (weight @ memory).view(b, count, heads, channels)
    value = torch.einsum("bqhc,hwc->bqhw", seen, to_value.view(heads, width, channels))
    # Dropped weights must drop their share of the bias too.
    value = value + weight.sum(-1).view(b, count, heads, 1) * bias_value.view(heads, width)
    return attention.out_proj(value.flatten(2))


class FewQueriesDecoderLayer(nn.Module):
    """The layer `nn.TransformerDecoderLayer(norm_first=True, batch_first=True)` with `attend_few`.

    It has the same parameters.

    Args:
        width: C.
        heads: heads of both attentions.
        feed_forward: hidden width.
        dropout: dropout probability.
    """

    def __init__(self, width: int, heads: int, feed_forward: int, dropout: float = 0.1) -> None:
        super().__init__()
        self.self_attn = nn.MultiheadAttention(width, heads, dropout, batch_first=True)
        self.multihead_attn = nn.MultiheadAttention(width, heads, dropout, batch_first=True)
        self.linear1 = nn.Linear(width, feed_forward)
        self.linear2 = nn.Linear(feed_forward, width)
        self.norm1, self.norm2, self.norm3 = (nn.LayerNorm(width) for _ in range(3))
        self.dropout = nn.Dropout(dropout)

    def forward(
        self, query: Float[Tensor, "b Q C"], memory: Float[Tensor, "b N C"]
    ) -> Float[Tensor, "b Q C"]:
        """Return the queries after self-attention and attention to the memory."""
        own = self.norm1(query)
        query = query + self.dropout(self.self_attn(own, own, own, need_weights=False)[0])
        query = query + self.dropout(attend_few(self.multihead_attn, self.norm2(query), memory))
        hidden = self.dropout(self.linear1(self.norm3(query)).relu())
        return query + self.dropout(self.linear2(hidden))
