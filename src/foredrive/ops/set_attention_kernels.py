"""Numba kernel of attention within sets: one set and one head of 16 channels at a time."""

from typing import no_type_check

import numpy as np

from foredrive.ops.vectors import (
    ONE,
    ROW,
    ZERO,
    exp2_row,
    greatest,
    greatest_in,
    inlined_part,
    kernel,
    load_row,
    row_of,
    store,
    total_of,
)

SCALE = np.float32(np.log2(np.e) / np.sqrt(ROW))
"""1 / √d, with the change from base e to base 2."""
NOTHING = np.float32(-1e30)


@kernel
@no_type_check
def attend_sets(first, last, query_key, value, order, ends, largest, out):
    """Compute sets `first` to `last` - 1 of `attend_within` into out[K C].

    The tokens of set s are order[ends[s] : ends[s + 1]].
    """
    width = value.shape[1]
    room = (largest + ROW - 1) // ROW * ROW
    keys = np.empty(ROW * room, np.float32)  # channel-major: 16 keys are adjacent
    values = np.empty(room * ROW, np.float32)
    start = np.empty(room, np.float32)  # initial score of each key: 0, or -1e30 for padding
    share = np.empty(room, np.float32)
    query = np.empty(ROW, np.float32)
    for member in range(first, last):
        tokens = order[ends[member] : ends[member + 1]]
        blocks = (len(tokens) + ROW - 1) // ROW
        start[: len(tokens)], start[len(tokens) :] = ZERO, NOTHING
        for channel in range(0, width, ROW):
            _pack(query_key, value, tokens, channel, room, keys, values)
            for token in tokens:
                store(query, 0, load_row(query_key, 2 * width * token + channel) * SCALE)
                best = _fits(query, keys, start, room, blocks, share)
                total = row_of(ZERO)
                for block in range(blocks):
                    # Softmax: exponentials relative to the best score, then the weighted mean of the values.
                    part = exp2_row(load_row(share, ROW * block) - best)
                    store(share, ROW * block, part)
                    total = total + part
                mean = _weigh(share, values, blocks) * (ONE / total_of(total))
                store(out, width * token + channel, mean)


@inlined_part
@no_type_check
def _pack(query_key, value, tokens, channel, room, keys, values):
    """Copy keys and values of one head. The padding up to whole rows is 0."""
    width, count = value.shape[1], len(tokens)
    for place in range(count):
        token = tokens[place]
        store(values, ROW * place, load_row(value, width * token + channel))
        for k in range(ROW):
            keys[room * k + place] = query_key[token, width + channel + k]
    for place in range(count, (count + ROW - 1) // ROW * ROW):
        store(values, ROW * place, row_of(ZERO))
        for k in range(ROW):
            keys[room * k + place] = ZERO


@inlined_part
@no_type_check
def _fits(query, keys, start, room, blocks, share):
    """Write the scores of all keys for one query to `share`. Return the largest score."""
    best = row_of(NOTHING)
    for block in range(blocks):
        # Two accumulators shorten the chain of dependent additions.
        even, odd = load_row(start, ROW * block), row_of(ZERO)
        for k in range(0, ROW, 2):
            even = even + load_row(keys, room * k + ROW * block) * query[k]
            odd = odd + load_row(keys, room * (k + 1) + ROW * block) * query[k + 1]
        fit = even + odd
        store(share, ROW * block, fit)
        best = greatest(best, fit)
    return greatest_in(best)


@inlined_part
@no_type_check
def _weigh(share, values, blocks):
    """Return the sum of the values, each multiplied by its share."""
    a, b, c, d = row_of(ZERO), row_of(ZERO), row_of(ZERO), row_of(ZERO)
    for place in range(0, ROW * blocks, 4):
        a = a + load_row(values, ROW * place) * share[place]
        b = b + load_row(values, ROW * (place + 1)) * share[place + 1]
        c = c + load_row(values, ROW * (place + 2)) * share[place + 2]
        d = d + load_row(values, ROW * (place + 3)) * share[place + 3]
    return (a + b) + (c + d)
