"""Numba kernels for the gradients of `composite_tiles`.

They run front to back like the forward pass. The contribution of everything behind a splat is the full result
minus the sum so far. So no intermediate values are stored.
"""

from typing import no_type_check

import numpy as np

from foredrive.ops.splat_listing_kernels import MEAN_X, RANGE, nearest_turn
from foredrive.ops.splatting_kernels import (
    ALL,
    BATCH,
    MAX_ALPHA,
    MIN_TRANSMITTANCE,
    POINTS,
    aligned_rows,
    find_touched_blocks,
    gather_hits,
    offsets,
    opacity_at,
    range_at,
)
from foredrive.ops.vectors import (
    HALF,
    ONE,
    ROW,
    ZERO,
    broadcast,
    greater_mask,
    inlined_part,
    kernel,
    load_row,
    lowest_set_bit,
    minimum,
    row_sums,
    select_greater,
    store,
)

GEOMETRY_COLUMNS = 12
"""Number of columns in the gradient of a pair, before the features. See `composite_tiles_backward`."""


@inlined_part
@no_type_check
def _load_gradients(points, tile, out, grad_out, state, columns):
    """Fill the rows of each block.

    The rows are: transmittance, dot product of the remaining result and its gradient, gradients of range,
    alpha and alpha before the hit, then the gradients of the features.
    """
    depth = columns - 5
    for s in range(POINTS):
        p = points.point[tile, s]
        # Slot s of a tile is lane s % 16 of block s // 16
        base = s // ROW * columns * ROW + s % ROW
        for c in range(columns):
            state[base + c * ROW] = 0
        if p >= 0:
            state[base] = 1
            # `left` is Σ out · grad over all columns that weights enter
            left = out[p, depth] * grad_out[p, depth]
            left += out[p, depth + 2] * grad_out[p, depth + 2]
            if points.by_centre is None:  # else nothing in front changes what a splat adds before the hit
                left += out[p, depth + 3] * grad_out[p, depth + 3]
            state[base + 2 * ROW] = grad_out[p, depth]
            state[base + 3 * ROW] = grad_out[p, depth + 2]
            state[base + 4 * ROW] = grad_out[p, depth + 3]
            for d in range(depth):
                state[base + (5 + d) * ROW] = grad_out[p, d]
                left += out[p, d] * grad_out[p, d]
            state[base + ROW] = left


@inlined_part
@no_type_check
def _accumulate_backward(splat, feature, base, state, dx, dy, t, hit, by_centre, sums):
    """Subtract a splat from the remaining result of a block, and add the gradient of its feature to `sums`.

    Return whether any ray continues, and e and h of `composite_tiles_backward`.
    """
    left = load_row(state, base)
    # The forward pass again: weight of the splat and transmittance behind it
    opacity = opacity_at(splat, dx, dy)
    alpha = minimum(opacity, MAX_ALPHA)
    passed = left - left * alpha
    alpha = select_greater(passed, MIN_TRANSMITTANCE, alpha, ZERO)
    weight = left * alpha
    to_range = load_row(state, base + 2 * ROW)
    range_m = range_at(splat, dx, dy, t)
    # dL/d weight: alpha, range, hit and features each add their share
    grad_weight = load_row(state, base + 3 * ROW) + to_range * range_m
    to_before = load_row(state, base + 4 * ROW)
    if by_centre is None:
        grad_weight = grad_weight + select_greater(hit, range_m, to_before, ZERO)
    cell = base + 5 * ROW
    for d in range(feature.size):
        grad = load_row(state, cell)
        grad_weight = grad_weight + grad * feature[d]
        to_feature = (GEOMETRY_COLUMNS + d) * ROW
        store(sums, to_feature, load_row(sums, to_feature) + weight * grad)
        cell += ROW
    # What remains behind this splat of Σ out · grad
    behind = load_row(state, base + ROW) - weight * grad_weight
    store(state, base, select_greater(passed, MIN_TRANSMITTANCE, passed, ZERO))
    store(state, base + ROW, behind)
    # With weight = T α: dL/d log α = T α · dL/d weight - α / (1 - α) · (all behind)
    # d/d log α: the own contribution of the splat, minus what it hides behind it.
    slope = weight * grad_weight - alpha * behind / (broadcast(ONE) - alpha)
    if by_centre is not None:
        slope = slope + alpha * select_greater(hit, splat[RANGE], to_before, ZERO)
    # The limit of 0.999 cuts the gradient
    slope = select_greater(opacity, MAX_ALPHA, ZERO, slope)
    return greater_mask(passed, MIN_TRANSMITTANCE) != 0, slope, weight * to_range


@kernel
@no_type_check
def composite_tiles_backward(start, stop, lists, points, out, grad_out, pairs):
    """Write the gradients of tiles start … stop - 1 to `pairs`, one row per pair of splat and tile.

    With e = dL/d log α and h = weight · dL/d range of each point, the columns are sums over points of e, e
    dx, e dy, e dx², e dx dy, e dy², e t dx, e t dy, h, h dx, h dy, h t, and weight · dL/d feature.

    Args:
        out, grad_out: Float32[P D + 4], the result and its gradient.
        pairs: Float32[L C], zeros. C is at least 12 + D and a multiple of 16.
    """
    columns = lists.feature.shape[1] + 5
    state, hits, sums = aligned_rows(ROW * columns), aligned_rows(ROW), aligned_rows(pairs.shape[1])
    touched = np.empty(BATCH, np.uint32)
    # Tiles write disjoint rows of `pairs`, so they can run in parallel
    for tile in range(start, stop):
        _load_gradients(points, tile, out, grad_out, state, columns)
        gather_hits(points, tile, hits)
        active = ALL
        for begin in range(lists.first[tile], lists.first[tile + 1], BATCH):
            end = min(begin + BATCH, lists.first[tile + 1])
            find_touched_blocks(lists, points, tile, begin, end, touched)
            for entry in range(begin, end):
                # Skip blocks that the splat does not reach or whose rays have all ended
                blocks = active & touched[entry - begin]
                if blocks == 0:
                    continue
                active = _composite_splat_backward(
                    lists, points, tile, entry, blocks, active, hits, state, sums
                )
                # Sum over the points: 16 rows of sums become one row of columns
                pair = lists.slot[entry] * pairs.shape[1]
                for c in range(0, pairs.shape[1], ROW):
                    store(pairs, pair + c, row_sums(sums, c * ROW))
            if active == 0:
                break


@inlined_part
@no_type_check
def _composite_splat_backward(lists, points, tile, entry, blocks, active, hits, state, sums):
    """Fill `sums` with the rows that add up to the gradient of a pair. Return the blocks that continue."""
    splat, feature = lists.packed[lists.splat[entry]], lists.feature[lists.splat[entry]]
    rows, columns = points.rows[tile], feature.size + 5
    x = nearest_turn(splat[MEAN_X], points.tile_bounds[tile], points.period)
    # Twelve named accumulators stay in registers
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = s9 = s10 = s11 = broadcast(ZERO)
    for d in range(feature.size):
        store(sums, (GEOMETRY_COLUMNS + d) * ROW, s0)
    # Loop over the set bits: the blocks that the splat touches and that have unfinished rays.
    while blocks != 0:
        block = lowest_set_bit(blocks)
        blocks &= blocks - np.uint32(1)
        dx, dy, t = offsets(splat, rows, block * ROW, x)
        hit, base = load_row(hits, block * ROW), block * columns * ROW
        on, e, h = _accumulate_backward(splat, feature, base, state, dx, dy, t, hit, points.by_centre, sums)
        if not on:
            active &= ~(np.uint32(1) << np.uint32(block))
        # Moments of e (and of h) over the points: see `composite_tiles_backward`
        ex, ey = e * dx, e * dy
        s0, s1, s2 = s0 + e, s1 + ex, s2 + ey
        s3, s4, s5 = s3 + ex * dx, s4 + ex * dy, s5 + ey * dy
        s6, s7 = s6 + ex * t, s7 + ey * t
        s8, s9, s10, s11 = s8 + h, s9 + h * dx, s10 + h * dy, s11 + h * t
    for k, row in enumerate((s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11)):
        store(sums, k * ROW, row)
    return active


@kernel
@no_type_check
def gather_gradients(start, stop, pairs, first_slot, splats, grads):
    """Sum the pair gradients of splats start … stop - 1, which are contiguous; apply the chain rule."""
    sums = np.empty(GEOMETRY_COLUMNS + grads.feature.shape[1], np.float32)
    for i in range(start, stop):
        # A splat's pairs are adjacent: the sum has a fixed order
        sums[:] = 0
        for k in range(first_slot[i], first_slot[i + 1]):
            for c in range(sums.size):
                sums[c] += pairs[k, c]
        xx = splats.inverse_covariance[i, 0]
        xy, yy = splats.inverse_covariance[i, 1], splats.inverse_covariance[i, 2]
        slope_x, slope_y = splats.range_slope[i, 0], splats.range_slope[i, 1]
        # d = p - mean - velocity · t and log α = log o - dᵀ A d / 2, so ∂ log α / ∂ mean = A d
        grads.mean[i, 0] = xx * sums[1] + xy * sums[2] - slope_x * sums[8]
        grads.mean[i, 1] = xy * sums[1] + yy * sums[2] - slope_y * sums[8]
        # ∂ log α / ∂ A: the off-diagonal entry counts twice
        grads.inverse_covariance[i, 0] = -HALF * sums[3]
        grads.inverse_covariance[i, 1] = -sums[4]
        grads.inverse_covariance[i, 2] = -HALF * sums[5]
        # As for the mean, with the time as a further factor
        grads.velocity[i, 0] = xx * sums[6] + xy * sums[7] - slope_x * sums[11]
        grads.velocity[i, 1] = xy * sums[6] + yy * sums[7] - slope_y * sums[11]
        # ∂ log α / ∂ o = 1 / o
        grads.opacity[i] = sums[0] / splats.opacity[i] if sums[0] != 0 else ZERO
        grads.range_m[i], grads.range_rate_mps[i] = sums[8], sums[11]
        grads.range_slope[i, 0], grads.range_slope[i, 1] = sums[9], sums[10]
        for d in range(sums.size - GEOMETRY_COLUMNS):
            grads.feature[i, d] = sums[GEOMETRY_COLUMNS + d]
