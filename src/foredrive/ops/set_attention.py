"""Attention within sets of tokens of any sizes. The caller does not pad the sets."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.ops.precision import numba_supports
from foredrive.ops.set_attention_kernels import attend_sets
from foredrive.ops.threads import in_parallel
from foredrive.ops.vectors import ROW

MIN_SETS = 8
"""Minimum number of sets per thread."""
BUCKETS = (8, 16, 32, 64)
"""Set sizes of the reference version. Sets up to each size are padded to one length and attend together."""


def attend_within(
    query_key: Float[Tensor, "K C2"],
    value: Float[Tensor, "K C"],
    order: Int[Tensor, "K"],
    counts: Int[Tensor, "S"],
    heads: int,
) -> Float[Tensor, "K C"]:
    """Return softmax(q kᵀ / √d) v of each token within its set, by head (Vaswani et al. 2017, eq. 1).

    The kernel requires float32 on the CPU, heads of 16 channels and no gradients.

    Args:
        query_key: queries followed by keys in the channel dimension: C2 = 2 C.
        order: indices of the tokens, set by set.
        counts: number of tokens in each set, at least 1.
    """
    inputs = (query_key, value)
    # The kernel has no backward pass, and reads exactly one row of 16 channels per head
    wanted = torch.is_grad_enabled() and any(t.requires_grad for t in inputs)
    single = all(t.dtype == torch.float32 for t in inputs)
    if wanted or not single or value.shape[1] != heads * ROW or not numba_supports(*inputs, order):
        return attend_within_reference(query_key, value, order, counts, heads)
    out = torch.empty_like(value, memory_format=torch.contiguous_format)
    # Start of each set in `order`, and the end of the last one
    ends = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    arrays = [t.detach().contiguous().numpy() for t in (query_key, value, order, ends)]

    def job(start: int, stop: int) -> None:
        attend_sets(start, stop, *arrays, int(counts.max()), out.numpy())

    in_parallel(job, len(counts), grain=MIN_SETS)
    return out


def attend_within_reference(
    query_key: Float[Tensor, "K C2"],
    value: Float[Tensor, "K C"],
    order: Int[Tensor, "K"],
    counts: Int[Tensor, "S"],
    heads: int,
) -> Float[Tensor, "K C"]:
    """Compute `attend_within` in plain PyTorch."""
    groups = _groups(order, counts)
    # Queries, keys and values side by side, so that one gather fetches all three
    split = torch.cat([query_key, value], dim=-1)
    parts = [_attend(split[group.token], group.filled, heads) for group in groups]
    # Back to the order of the tokens: each token is in exactly one set
    kept = torch.cat([group.token[group.filled] for group in groups])
    return torch.empty_like(value).index_copy_(0, kept, torch.cat(parts))


class _Group(NamedTuple):
    """Sets of similar sizes, padded to L tokens."""

    token: Int[Tensor, "s L"]
    """Tokens of each set. A padded place holds the first token of the set."""
    filled: Bool[Tensor, "s L"]


def _groups(order: Int[Tensor, "K"], counts: Int[Tensor, "S"]) -> list[_Group]:
    starts, groups, min_count = counts.cumsum(0) - counts, [], 0
    max_count = int(counts.max())
    # One group for each size up to the largest, so that little is padded
    for length in (*(bucket for bucket in BUCKETS if bucket < max_count), max_count):
        chosen = (counts > min_count) & (counts <= length)
        min_count = length
        if bool(chosen.any()):
            count = counts[chosen, None]
            steps = torch.arange(int(count.max()), device=order.device)
            filled = steps < count
            groups.append(_Group(order[starts[chosen, None] + torch.where(filled, steps, 0)], filled))
    return groups


def _attend(split: Float[Tensor, "s L C3"], filled: Bool[Tensor, "s L"], heads: int) -> Float[Tensor, "F C"]:
    # The mask keeps padded keys out of the softmax; padded queries are dropped at the end
    query, key, value = (part.unflatten(-1, (heads, -1)).transpose(1, 2) for part in split.chunk(3, -1))
    out = F.scaled_dot_product_attention(query, key, value, attn_mask=filled[:, None, None])
    return out.transpose(1, 2).flatten(2)[filled]
