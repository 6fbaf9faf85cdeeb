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
"""1 / √d, and powers of 2 in place of e."""
NOTHING = np.float32(-1e30)


@kernel
@no_type_check
def attend_sets(first, last, query_key, value, order, ends, largest, out):
    """Sets `first` to `last` of `attend_within`, into out[K C]; in `order` they lie between ends[S + 1]."""
    width = value.shape[1]
    room = (largest + ROW - 1) // ROW * ROW
    keys = np.empty(ROW * room, np.float32)  # channel by channel: 16 keys lie side by side
    values = np.empty(room * ROW, np.float32)
    start = np.empty(room, np.float32)  # of sums over channels, which nothing is where no token is
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
                    part = exp2_row(load_row(share, ROW * block) - best)
                    store(share, ROW * block, part)
                    total = total + part
                mean = _weigh(share, values, blocks) * (ONE / total_of(total))
                store(out, width * token + channel, mean)


@inlined_part
@no_type_check
def _pack(query_key, value, tokens, channel, room, keys, values):
    """Keys and values of a head; what pads them to whole rows is 0."""
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
    """How well each key fits a query, into `share`; returns the best fit."""
    best = row_of(NOTHING)
    for block in range(blocks):
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
    """The sum of values, each times its share."""
    a, b, c, d = row_of(ZERO), row_of(ZERO), row_of(ZERO), row_of(ZERO)
    for place in range(0, ROW * blocks, 4):
        a = a + load_row(values, ROW * place) * share[place]
        b = b + load_row(values, ROW * (place + 1)) * share[place + 1]
        c = c + load_row(values, ROW * (place + 2)) * share[place + 2]
        d = d + load_row(values, ROW * (place + 3)) * share[place + 3]
    return (a + b) + (c + d)
