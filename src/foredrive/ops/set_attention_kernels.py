"""Numba kernel of attention within sets: one set and one head of 16 channels at a time."""

from typing import no_type_check

import numpy as np

from foredrive.ops.vectors import (
    ONE,
    ROW,
    ZERO,
    broadcast,
    exp2_row,
    inlined_part,
    kernel,
    load_row,
    maximum,
    row_max,
    row_sum,
    store,
)

SCALE = np.float32(np.log2(np.e) / np.sqrt(ROW))
"""1 / √d, with the change from base e to base 2."""
MASKED = np.float32(-1e30)


@kernel
@no_type_check
# query_key Float32[K 2C], value and out Float32[K C], order and ends Int64
def attend_sets(first, last, query_key, value, order, ends, max_count, out):
    """Compute sets `first` to `last` - 1 of `attend_within` into out[K C].

    The tokens of set s are order[ends[s] : ends[s + 1]].
    """
    width = value.shape[1]
    padded = (max_count + ROW - 1) // ROW * ROW
    keys = np.empty(ROW * padded, np.float32)  # channel-major: 16 keys are adjacent
    values = np.empty(padded * ROW, np.float32)
    start = np.empty(padded, np.float32)  # initial score of each key: 0, or -1e30 for padding
    scores = np.empty(padded, np.float32)
    query = np.empty(ROW, np.float32)
    for group in range(first, last):
        tokens = order[ends[group] : ends[group + 1]]
        blocks = (len(tokens) + ROW - 1) // ROW
        # Padded keys begin at -1e30, so that their exponentials vanish; their values are 0
        start[: len(tokens)], start[len(tokens) :] = ZERO, MASKED
        for channel in range(0, width, ROW):
            _load_head(query_key, value, tokens, channel, padded, keys, values)
            for token in tokens:
                # The scaled query: 16 channels of this head, at the token's row
                store(query, 0, load_row(query_key, 2 * width * token + channel) * SCALE)
                best = _scores(query, keys, start, padded, blocks, scores)
                total = broadcast(ZERO)
                for block in range(blocks):
                    # Softmax: exponentials relative to the best score, then the weighted mean of the values.
                    part = exp2_row(load_row(scores, ROW * block) - best)
                    store(scores, ROW * block, part)
                    total = total + part
                mean = _weighted_sum(scores, values, blocks) * (ONE / row_sum(total))
                store(out, width * token + channel, mean)


@inlined_part
@no_type_check
def _load_head(query_key, value, tokens, channel, padded, keys, values):
    """Copy keys and values of one head. The padding up to whole rows is 0."""
    width, count = value.shape[1], len(tokens)
    for place in range(count):
        token = tokens[place]
        store(values, ROW * place, load_row(value, width * token + channel))
        for k in range(ROW):
            keys[padded * k + place] = query_key[token, width + channel + k]
    for place in range(count, (count + ROW - 1) // ROW * ROW):
        # Whole blocks of 16 keys are read, so the rest of the last one must be defined
        store(values, ROW * place, broadcast(ZERO))
        for k in range(ROW):
            keys[padded * k + place] = ZERO


@inlined_part
@no_type_check
def _scores(query, keys, start, padded, blocks, scores):
    """Write the scores of all keys for one query to `scores`. Return the largest score."""
    best = broadcast(MASKED)
    for block in range(blocks):
        # Two accumulators shorten the chain of dependent additions.
        # The score of 16 keys at a time: sum over the channels of key · query
        even, odd = load_row(start, ROW * block), broadcast(ZERO)
        for k in range(0, ROW, 2):
            even = even + load_row(keys, padded * k + ROW * block) * query[k]
            odd = odd + load_row(keys, padded * (k + 1) + ROW * block) * query[k + 1]
        score = even + odd
        store(scores, ROW * block, score)
        best = maximum(best, score)
    return row_max(best)


@inlined_part
@no_type_check
def _weighted_sum(scores, values, blocks):
    """Return the sum of the values, each multiplied by its score."""
    # Four accumulators for the same reason
    a, b, c, d = broadcast(ZERO), broadcast(ZERO), broadcast(ZERO), broadcast(ZERO)
    for place in range(0, ROW * blocks, 4):
        a = a + load_row(values, ROW * place) * scores[place]
        b = b + load_row(values, ROW * (place + 1)) * scores[place + 1]
        c = c + load_row(values, ROW * (place + 2)) * scores[place + 2]
        d = d + load_row(values, ROW * (place + 3)) * scores[place + 3]
    return (a + b) + (c + d)
