"""Numba kernels that composite splats on tiles of points, forward and backward.

Loops run over a tile's splats and, within, over the blocks of 16 points that a splat touches; what a block has
gathered lies in the first-level cache. The backward pass goes front to back like the forward pass: what is left
of a ray's result behind a splat is the whole result less what has come so far, so that nothing is stored.
"""

from typing import NamedTuple, no_type_check

import numpy as np

from foredrive.ops.lanes import inlined_part, kernel
from foredrive.ops.rows import (
    ROW,
    bits_more,
    exp2_row,
    greatest,
    least,
    load_row,
    lowest_bit,
    prefetch,
    row_of,
    store_row,
    totals,
    where_more,
)
from foredrive.ops.splat_listing_kernels import (
    LEAST,
    LOG_OPACITY,
    MEAN_X,
    MEAN_Y,
    RANGE,
    RATE,
    SLOPE_X,
    SLOPE_Y,
    TILT_X,
    TILT_Y,
    VELOCITY_X,
    VELOCITY_Y,
    XX,
    XY,
    YY,
    turned,
)

ZERO, ONE, HALF = np.float32(0), np.float32(1), np.float32(0.5)
MIN_ALPHA, MAX_ALPHA, MIN_LEFT = np.float32(1 / 255), np.float32(0.999), np.float32(1e-4)
POINTS = ROW * ROW
"""Slots of a tile."""
ALL = np.uint32(0xFFFF)
EXTRA = 4
"""Columns of a result behind the features: expected range, median range, alpha, alpha before the hit."""
SUMS = 12
"""Columns of a pair's gradient in front of the features, see `composite_back`."""
BATCH = 64
"""Splats of a tile that are looked for at once: while one is fetched, others are."""


class Scene(NamedTuple):
    """Splats and who sees them."""

    packed: np.ndarray
    """Float32[N 16], see `pack_splats`."""
    feature: np.ndarray
    """Float32[N D]."""
    splat: np.ndarray
    """Int32[L], the tiles' lists one after the other."""
    slot: np.ndarray
    """Int32[L]: where a pair's gradient goes."""
    first: np.ndarray
    """Int64[≥ T + 1], where a tile's list begins."""


class Places(NamedTuple):
    """What looks."""

    rows: np.ndarray
    """Float32[T 3 256]: x, y, time."""
    block_bounds: np.ndarray
    """Float32[T 6 16]."""
    tile_bounds: np.ndarray
    """Float32[T 6]."""
    index: np.ndarray
    """Int32[T 256]."""
    hit: np.ndarray
    """Float32[P]."""
    period: np.float32


@inlined_part
@no_type_check
def _aligned(rows):
    """Room for rows, at the beginning of a cache line."""
    room = np.empty((rows + 1) * ROW, np.float32)
    skip = (ROW - room.ctypes.data // 4 % ROW) % ROW
    return room[skip : skip + rows * ROW]


@inlined_part
@no_type_check
def _touched(splat, bounds, x):
    """Bits of the blocks in which a splat's opacity reaches 1/255; see `touches`, here 16 boxes at a time."""
    y, vx, vy = splat[MEAN_Y], splat[VELOCITY_X], splat[VELOCITY_Y]
    t0, t1 = load_row(bounds, 4 * ROW), load_row(bounds, 5 * ROW)
    moved, moved_to = t0 * vx, t1 * vx
    x0 = load_row(bounds, 0) - x - greatest(moved, moved_to)
    x1 = load_row(bounds, ROW) - x - least(moved, moved_to)
    moved, moved_to = t0 * vy, t1 * vy
    y0 = load_row(bounds, 2 * ROW) - y - greatest(moved, moved_to)
    y1 = load_row(bounds, 3 * ROW) - y - least(moved, moved_to)
    near_x, near_y = least(greatest(x0, ZERO), x1), least(greatest(y0, ZERO), y1)
    along_y = least(greatest(near_x * splat[TILT_Y], y0), y1)
    along_x = least(greatest(near_y * splat[TILT_X], x0), x1)
    xx, xy, yy = splat[XX], splat[XY], splat[YY]
    at_side = near_x * (near_x * xx + along_y * xy) + along_y * along_y * yy
    at_edge = along_x * (along_x * xx + near_y * xy) + near_y * near_y * yy
    return bits_more(greatest(at_side, at_edge) + splat[LOG_OPACITY], LEAST)


@inlined_part
@no_type_check
def _offsets(splat, rows, at, x):
    """d of a block's points from a splat, and their time."""
    t = load_row(rows, 2 * POINTS + at)
    dx = load_row(rows, at) - x - t * splat[VELOCITY_X]
    dy = load_row(rows, POINTS + at) - splat[MEAN_Y] - t * splat[VELOCITY_Y]
    return dx, dy, t


@inlined_part
@no_type_check
def _opacity(splat, dx, dy):
    """The opacity of a splat at d, before it is cut off above."""
    exponent = dx * (dx * splat[XX] + dy * splat[XY]) + (dy * dy * splat[YY] + splat[LOG_OPACITY])
    opacity = exp2_row(exponent)
    return where_more(MIN_ALPHA, opacity, ZERO, opacity)


@inlined_part
@no_type_check
def _range(splat, dx, dy, t):
    return dx * splat[SLOPE_X] + dy * splat[SLOPE_Y] + (t * splat[RATE] + splat[RANGE])


@inlined_part
@no_type_check
def _gather_hits(places, tile, hits):
    for s in range(POINTS):
        hits[s] = places.hit[max(places.index[tile, s], 0)]


@inlined_part
@no_type_check
def _start(state, columns):
    """Nothing seen yet: transmittance 1, then the columns of a result with the features last."""
    state[:] = 0
    for block in range(ROW):
        base = block * columns * ROW
        store_row(state, base, row_of(ONE))
        store_row(state, base + 2 * ROW, row_of(np.float32(np.inf)))


@inlined_part
@no_type_check
def _add(splat, feature, base, state, dx, dy, t, hit):
    """Put a splat behind what a block has seen; returns whether any of its rays goes on."""
    left = load_row(state, base)
    alpha = least(_opacity(splat, dx, dy), MAX_ALPHA)
    passed = left - left * alpha
    weight = where_more(passed, MIN_LEFT, left * alpha, ZERO)
    range_m = _range(splat, dx, dy, t)
    store_row(state, base, where_more(passed, MIN_LEFT, passed, ZERO))
    store_row(state, base + ROW, load_row(state, base + ROW) + weight * range_m)
    crossed = where_more(weight, ZERO, where_more(left, HALF, HALF, ZERO), ZERO)  # 0.5 where it may cross
    crossed = where_more(passed, HALF, ZERO, crossed)
    median = load_row(state, base + 2 * ROW)
    store_row(state, base + 2 * ROW, where_more(crossed, ZERO, range_m, median))
    store_row(state, base + 3 * ROW, load_row(state, base + 3 * ROW) + weight)
    nearer = where_more(hit, range_m, weight, ZERO)
    store_row(state, base + 4 * ROW, load_row(state, base + 4 * ROW) + nearer)
    at = base + (EXTRA + 1) * ROW
    for d in range(feature.size):
        store_row(state, at, load_row(state, at) + weight * feature[d])
        at += ROW
    return bits_more(passed, MIN_LEFT) != 0


@inlined_part
@no_type_check
def _look_for(scene, places, tile, begin, end, touched):
    """Fill `touched` with the blocks that the entries begin … end of a tile's list touch."""
    bounds, tile_bounds = places.block_bounds[tile], places.tile_bounds[tile]
    for at in range(begin, end):
        splat = scene.packed[scene.splat[at]]
        prefetch(scene.feature, scene.splat[at] * scene.feature.shape[1])
        touched[at - begin] = _touched(splat, bounds, turned(splat[MEAN_X], tile_bounds, places.period))


@kernel
@no_type_check
def composite_tiles(start, stop, scene, places, out):
    """Write what the points of tiles start … stop see to `out`, Float32[P D + 4], features first."""
    columns = scene.feature.shape[1] + EXTRA + 1
    state, hits, touched = _aligned(ROW * columns), _aligned(ROW), np.empty(BATCH, np.uint32)
    for tile in range(start, stop):
        _start(state, columns)
        _gather_hits(places, tile, hits)
        going = ALL
        for begin in range(scene.first[tile], scene.first[tile + 1], BATCH):
            end = min(begin + BATCH, scene.first[tile + 1])
            _look_for(scene, places, tile, begin, end, touched)
            for at in range(begin, end):
                going = _pass(scene, places, tile, at, touched[at - begin], going, hits, state)
            if going == 0:
                break
        _write(places, tile, state, columns, out)


@inlined_part
@no_type_check
def _pass(scene, places, tile, at, touched, going, hits, state):
    """Put the splat of entry `at` behind what the blocks it touches have seen; returns those that go on."""
    splat, feature = scene.packed[scene.splat[at]], scene.feature[scene.splat[at]]
    rows, columns = places.rows[tile], feature.size + EXTRA + 1
    x = turned(splat[MEAN_X], places.tile_bounds[tile], places.period)
    blocks = going & touched
    while blocks != 0:
        block = lowest_bit(blocks)
        blocks &= blocks - np.uint32(1)
        dx, dy, t = _offsets(splat, rows, block * ROW, x)
        hit = load_row(hits, block * ROW)
        if not _add(splat, feature, block * columns * ROW, state, dx, dy, t, hit):
            going &= ~(np.uint32(1) << np.uint32(block))
    return going


@inlined_part
@no_type_check
def _write(places, tile, state, columns, out):
    depth = columns - EXTRA - 1
    for s in range(POINTS):
        p = places.index[tile, s]
        if p >= 0:
            base = s // ROW * columns * ROW + s % ROW
            for d in range(depth):
                out[p, d] = state[base + (EXTRA + 1 + d) * ROW]
            for k in range(EXTRA):
                out[p, depth + k] = state[base + (1 + k) * ROW]


@inlined_part
@no_type_check
def _start_back(places, tile, out, grad_out, state, columns):
    """Rows of a block: transmittance, what is left of the result times its gradient, gradients of range, alpha
    and alpha before the hit, then of the features."""
    depth = columns - 5
    for s in range(POINTS):
        p = places.index[tile, s]
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
    """What a splat's place in a block changes, see `composite_back`; the features' gradient is added to `sums`.

    Returns whether any ray goes on, dL/d log α, and the weight times the range's gradient.
    """
    left = load_row(state, base)
    opacity = _opacity(splat, dx, dy)
    alpha = least(opacity, MAX_ALPHA)
    passed = left - left * alpha
    alpha = where_more(passed, MIN_LEFT, alpha, ZERO)
    weight = left * alpha
    to_range = load_row(state, base + 2 * ROW)
    range_m = _range(splat, dx, dy, t)
    worth = load_row(state, base + 3 * ROW) + to_range * range_m
    worth = worth + where_more(hit, range_m, load_row(state, base + 4 * ROW), ZERO)
    at = base + 5 * ROW
    for d in range(feature.size):
        grad = load_row(state, at)
        worth = worth + grad * feature[d]
        to_feature = (SUMS + d) * ROW
        store_row(sums, to_feature, load_row(sums, to_feature) + weight * grad)
        at += ROW
    behind = load_row(state, base + ROW) - weight * worth
    store_row(state, base, where_more(passed, MIN_LEFT, passed, ZERO))
    store_row(state, base + ROW, behind)
    slope = weight * worth - alpha * behind / (row_of(ONE) - alpha)
    return bits_more(passed, MIN_LEFT) != 0, where_more(opacity, MAX_ALPHA, ZERO, slope), weight * to_range


@kernel
@no_type_check
def composite_back(start, stop, scene, places, out, grad_out, pairs):
    """Write the gradients of tiles start … stop, pair by pair of splat and tile, to `pairs`.

    With e = dL/d log α and h = weight · dL/d range of each point, the columns are the sums over points of e,
    e dx, e dy, e dx², e dx dy, e dy², e t dx, e t dy, h, h dx, h dy, h t, and weight · dL/d feature.

    Args:
        out, grad_out: Float32[P D + 4], the result and its gradient.
        pairs: Float32[L C], zeros; C is 12 + D or more, a multiple of 16.
    """
    columns = scene.feature.shape[1] + 5
    state, hits, sums = _aligned(ROW * columns), _aligned(ROW), _aligned(pairs.shape[1])
    touched = np.empty(BATCH, np.uint32)
    for tile in range(start, stop):
        _start_back(places, tile, out, grad_out, state, columns)
        _gather_hits(places, tile, hits)
        going = ALL
        for begin in range(scene.first[tile], scene.first[tile + 1], BATCH):
            end = min(begin + BATCH, scene.first[tile + 1])
            _look_for(scene, places, tile, begin, end, touched)
            for at in range(begin, end):
                blocks = going & touched[at - begin]
                if blocks == 0:
                    continue
                going = _pass_back(scene, places, tile, at, blocks, going, hits, state, sums)
                pair = scene.slot[at] * pairs.shape[1]
                for c in range(0, pairs.shape[1], ROW):
                    store_row(pairs, pair + c, totals(sums, c * ROW))
            if going == 0:
                break


@inlined_part
@no_type_check
def _pass_back(scene, places, tile, at, blocks, going, hits, state, sums):
    """Fill `sums` with the rows that add up to a pair's gradient; returns the blocks that go on."""
    splat, feature = scene.packed[scene.splat[at]], scene.feature[scene.splat[at]]
    rows, columns = places.rows[tile], feature.size + 5
    x = turned(splat[MEAN_X], places.tile_bounds[tile], places.period)
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = s9 = s10 = s11 = row_of(ZERO)
    for d in range(feature.size):
        store_row(sums, (SUMS + d) * ROW, s0)
    while blocks != 0:
        block = lowest_bit(blocks)
        blocks &= blocks - np.uint32(1)
        dx, dy, t = _offsets(splat, rows, block * ROW, x)
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
        store_row(sums, k * ROW, row)
    return going


class Gradients(NamedTuple):
    """With respect to the fields of `Splats` of the same names."""

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
    """Add up what `composite_back` wrote about the splats start … stop, which lies together."""
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
