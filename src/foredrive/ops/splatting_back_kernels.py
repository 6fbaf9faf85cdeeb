"""Numba kernels for the gradients of `composite_tiles`.

They run front to back like the forward pass. The contribution of everything behind a splat is the full result
minus the sum so far. So no intermediate values are stored.
"""

from typing import NamedTuple, no_type_check

import numpy as np

from foredrive.ops.splat_listing_kernels import MEAN_X, turned
from foredrive.ops.splatting_kernels import (
    ALL,
    BATCH,
    EXTRA,
    MAX_ALPHA,
    MIN_LEFT,
    POINTS,
    aligned,
    gather_hits,
    look_for,
    offsets,
    opacity_at,
    range_at,
)
from foredrive.ops.vectors import (
    HALF,
    ONE,
    ROW,
    ZERO,
    bits_more,
    inlined_part,
    kernel,
    least,
    load_row,
    lowest_bit,
    row_of,
    store,
    totals,
    where_more,
)

SUMS = 12
"""Number of columns in the gradient of a pair, before the features. See `composite_back`."""


@inlined_part
@no_type_check
def _start_back(places, tile, out, grad_out, state, columns):
    """Fill the rows of each block.

    The rows are: transmittance, dot product of the remaining result and its gradient, gradients of range,
    alpha and alpha before the hit, then the gradients of the features.
    """
    depth = columns - 5
    for s in range(POINTS):
        p = places.point[tile, s]
        base = s // ROW * columns * ROW + s % ROW
        for c in range(columns):
            state[base + c * ROW] = 0
        if p >= 0:
            state[base] = 1
            left = out[p, depth] * grad_out[p, depth]
            for k in range(2, EXTRA):
                left += out[p, depth + k] * grad_out[p, depth + k]
            state[base + 2 * ROW] = grad_out[p, depth]
            state[base + 3 * ROW] = grad_out[p, depth + 2]
            state[base + 4 * ROW] = grad_out[p, depth + 3]
            for d in range(depth):
                state[base + (5 + d) * ROW] = grad_out[p, d]
                left += out[p, d] * grad_out[p, d]
            state[base + ROW] = left


@inlined_part
@no_type_check
def _add_back(splat, feature, base, state, dx, dy, t, hit, sums):
    """Subtract a splat from the remaining result of a block, and add the gradient of its feature to `sums`.

    Return whether any ray continues, and e and h of `composite_back`.
    """
    left = load_row(state, base)
    opacity = opacity_at(splat, dx, dy)
    alpha = least(opacity, MAX_ALPHA)
    passed = left - left * alpha
    alpha = where_more(passed, MIN_LEFT, alpha, ZERO)
    weight = left * alpha
    to_range = load_row(state, base + 2 * ROW)
    range_m = range_at(splat, dx, dy, t)
    worth = load_row(state, base + 3 * ROW) + to_range * range_m
    worth = worth + where_more(hit, range_m, load_row(state, base + 4 * ROW), ZERO)
    at = base + 5 * ROW
    for d in range(feature.size):
        grad = load_row(state, at)
        worth = worth + grad * feature[d]
        to_feature = (SUMS + d) * ROW
        store(sums, to_feature, load_row(sums, to_feature) + weight * grad)
        at += ROW
    behind = load_row(state, base + ROW) - weight * worth
    store(state, base, where_more(passed, MIN_LEFT, passed, ZERO))
    store(state, base + ROW, behind)
    # d/d log α: the own contribution of the splat, minus what it hides behind it.
    slope = weight * worth - alpha * behind / (row_of(ONE) - alpha)
    return bits_more(passed, MIN_LEFT) != 0, where_more(opacity, MAX_ALPHA, ZERO, slope), weight * to_range


@kernel
@no_type_check
def composite_back(start, stop, scene, places, out, grad_out, pairs):
    """Write the gradients of tiles start … stop - 1 to `pairs`, one row per pair of splat and tile.

    With e = dL/d log α and h = weight · dL/d range of each point, the columns are sums over points of e, e
    dx, e dy, e dx², e dx dy, e dy², e t dx, e t dy, h, h dx, h dy, h t, and weight · dL/d feature.

    Args:
        out, grad_out: Float32[P D + 4], the result and its gradient.
        pairs: Float32[L C], zeros. C is at least 12 + D and a multiple of 16.
    """
    columns = scene.feature.shape[1] + 5
    state, hits, sums = aligned(ROW * columns), aligned(ROW), aligned(pairs.shape[1])
    touched = np.empty(BATCH, np.uint32)
    for tile in range(start, stop):
        _start_back(places, tile, out, grad_out, state, columns)
        gather_hits(places, tile, hits)
        going = ALL
        for begin in range(scene.first[tile], scene.first[tile + 1], BATCH):
            end = min(begin + BATCH, scene.first[tile + 1])
            look_for(scene, places, tile, begin, end, touched)
            for at in range(begin, end):
                blocks = going & touched[at - begin]
                if blocks == 0:
                    continue
                going = _pass_back(scene, places, tile, at, blocks, going, hits, state, sums)
                pair = scene.slot[at] * pairs.shape[1]
                for c in range(0, pairs.shape[1], ROW):
                    store(pairs, pair + c, totals(sums, c * ROW))
            if going == 0:
                break


@inlined_part
@no_type_check
def _pass_back(scene, places, tile, at, blocks, going, hits, state, sums):
    """Fill `sums` with the rows that add up to the gradient of a pair. Return the blocks that continue."""
    splat, feature = scene.packed[scene.splat[at]], scene.feature[scene.splat[at]]
    rows, columns = places.rows[tile], feature.size + 5
    x = turned(splat[MEAN_X], places.tile_bounds[tile], places.period)
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = s9 = s10 = s11 = row_of(ZERO)
    for d in range(feature.size):
        store(sums, (SUMS + d) * ROW, s0)
    # Loop over the set bits: the blocks that the splat touches and that have unfinished rays.
    while blocks != 0:
        block = lowest_bit(blocks)
        blocks &= blocks - np.uint32(1)
        dx, dy, t = offsets(splat, rows, block * ROW, x)
        hit = load_row(hits, block * ROW)
        on, e, h = _add_back(splat, feature, block * columns * ROW, state, dx, dy, t, hit, sums)
        if not on:
            going &= ~(np.uint32(1) << np.uint32(block))
        ex, ey = e * dx, e * dy
        s0, s1, s2 = s0 + e, s1 + ex, s2 + ey
        s3, s4, s5 = s3 + ex * dx, s4 + ex * dy, s5 + ey * dy
        s6, s7 = s6 + ex * t, s7 + ey * t
        s8, s9, s10, s11 = s8 + h, s9 + h * dx, s10 + h * dy, s11 + h * t
    for k, row in enumerate((s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11)):
        store(sums, k * ROW, row)
    return going


class Gradients(NamedTuple):
    """Gradients with respect to the fields of `Splats` of the same names."""

    mean: np.ndarray
    inverse_covariance: np.ndarray
    opacity: np.ndarray
    range_m: np.ndarray
    range_slope: np.ndarray
    velocity: np.ndarray
    range_rate_mps: np.ndarray
    feature: np.ndarray


@kernel
@no_type_check
def gather_gradients(start, stop, pairs, first_slot, raw, grads):
    """Sum the pair gradients of splats start … stop - 1, which are contiguous; apply the chain rule."""
    sums = np.empty(SUMS + grads.feature.shape[1], np.float32)
    for i in range(start, stop):
        sums[:] = 0
        for k in range(first_slot[i], first_slot[i + 1]):
            for c in range(sums.size):
                sums[c] += pairs[k, c]
        xx = raw.inverse_covariance[i, 0]
        xy, yy = raw.inverse_covariance[i, 1], raw.inverse_covariance[i, 2]
        slope_x, slope_y = raw.range_slope[i, 0], raw.range_slope[i, 1]
        grads.mean[i, 0] = xx * sums[1] + xy * sums[2] - slope_x * sums[8]
        grads.mean[i, 1] = xy * sums[1] + yy * sums[2] - slope_y * sums[8]
        grads.inverse_covariance[i, 0] = -HALF * sums[3]
        grads.inverse_covariance[i, 1] = -sums[4]
        grads.inverse_covariance[i, 2] = -HALF * sums[5]
        grads.velocity[i, 0] = xx * sums[6] + xy * sums[7] - slope_x * sums[11]
        grads.velocity[i, 1] = xy * sums[6] + yy * sums[7] - slope_y * sums[11]
        grads.opacity[i] = sums[0] / raw.opacity[i] if sums[0] != 0 else ZERO
        grads.range_m[i], grads.range_rate_mps[i] = sums[8], sums[11]
        grads.range_slope[i, 0], grads.range_slope[i, 1] = sums[9], sums[10]
        for d in range(sums.size - SUMS):
            grads.feature[i, d] = sums[SUMS + d]
