"""Numba kernel that composites splats on tiles of points. `splatting_back_kernels` has its gradients.

The outer loop runs over the splats of a tile, the inner one over the blocks of 16 points that a splat
touches. The sums of a block stay in the first-level cache.
"""

from typing import NamedTuple, no_type_check

import numpy as np

from foredrive.ops.splat_listing_kernels import (
    LOG_OPACITY,
    MEAN_X,
    MEAN_Y,
    MIN_LOG_OPACITY,
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
    nearest_turn,
)
from foredrive.ops.vectors import (
    HALF,
    ONE,
    ROW,
    ZERO,
    broadcast,
    exp2_row,
    greater_mask,
    inlined_part,
    kernel,
    load_row,
    lowest_set_bit,
    maximum,
    minimum,
    prefetch,
    select_greater,
    store,
)

MIN_ALPHA, MAX_ALPHA, MIN_TRANSMITTANCE = np.float32(1 / 255), np.float32(0.999), np.float32(1e-4)
POINTS = ROW * ROW
"""Number of slots of a tile."""
ALL = np.uint32(0xFFFF)
EXTRA_COLUMNS = 4
"""Number of result columns after the features: expected range, median range, alpha, alpha before the hit."""
BATCH, PREFETCH_DISTANCE = 64, 12
"""Number of splats of a tile tested at once, and the prefetch distance in splats."""


class TileLists(NamedTuple):
    """Splats and the lists of the tiles."""

    packed: np.ndarray
    """Float32[N 16], see `pack_splats`."""
    feature: np.ndarray
    """Float32[N D]."""
    splat: np.ndarray
    """Int32[L], lists of all tiles one after the other."""
    slot: np.ndarray
    """Int32[L], row of the gradient of each pair."""
    first: np.ndarray
    """Int64[≥ T + 1], start of the list of each tile."""


@inlined_part
@no_type_check
def aligned_rows(rows):
    """Return memory for `rows` rows that starts at a cache line."""
    # One row more than needed leaves room for the shift to the alignment
    buffer = np.empty((rows + 1) * ROW, np.float32)
    skip = (ROW - buffer.ctypes.data // 4 % ROW) % ROW
    return buffer[skip : skip + rows * ROW]


@inlined_part
@no_type_check
def blocks_touched(splat, bounds, x):
    """Return a bit mask of the blocks in which the opacity of a splat reaches 1/255.

    It is the test of `touches` for 16 boxes at a time.
    """
    y, vx, vy = splat[MEAN_Y], splat[VELOCITY_X], splat[VELOCITY_Y]
    t0, t1 = load_row(bounds, 4 * ROW), load_row(bounds, 5 * ROW)
    moved, moved_to = t0 * vx, t1 * vx
    # Offsets of the 16 boxes from the mean, enlarged by the motion over their time intervals
    x0 = load_row(bounds, 0) - x - maximum(moved, moved_to)
    x1 = load_row(bounds, ROW) - x - minimum(moved, moved_to)
    moved, moved_to = t0 * vy, t1 * vy
    y0 = load_row(bounds, 2 * ROW) - y - maximum(moved, moved_to)
    y1 = load_row(bounds, 3 * ROW) - y - minimum(moved, moved_to)
    # Nearest point of each box along each axis, and the best place on the nearest sides
    near_x, near_y = minimum(maximum(x0, ZERO), x1), minimum(maximum(y0, ZERO), y1)
    along_y = minimum(maximum(near_x * splat[TILT_Y], y0), y1)
    along_x = minimum(maximum(near_y * splat[TILT_X], x0), x1)
    xx, xy, yy = splat[XX], splat[XY], splat[YY]
    at_side = near_x * (near_x * xx + along_y * xy) + along_y * along_y * yy
    at_edge = along_x * (along_x * xx + near_y * xy) + near_y * near_y * yy
    return greater_mask(maximum(at_side, at_edge) + splat[LOG_OPACITY], MIN_LOG_OPACITY)


@inlined_part
@no_type_check
def offsets(splat, rows, first, x):
    """Return the offsets d of the points of a block from a splat, and their times."""
    t = load_row(rows, 2 * POINTS + first)
    dx = load_row(rows, first) - x - t * splat[VELOCITY_X]
    dy = load_row(rows, POINTS + first) - splat[MEAN_Y] - t * splat[VELOCITY_Y]
    return dx, dy, t


@inlined_part
@no_type_check
def opacity_at(splat, dx, dy):
    """Return the opacity of a splat at d, before the limit of 0.999. It is 0 below 1/255."""
    exponent = dx * (dx * splat[XX] + dy * splat[XY]) + dy * dy * splat[YY]
    opacity = exp2_row(minimum(exponent, ZERO) + splat[LOG_OPACITY])  # rounding may make it > 0
    return select_greater(MIN_ALPHA, opacity, ZERO, opacity)


@inlined_part
@no_type_check
def range_at(splat, dx, dy, t):
    """Return the range of a splat at d and time t."""
    return dx * splat[SLOPE_X] + dy * splat[SLOPE_Y] + (t * splat[RATE] + splat[RANGE])


@inlined_part
@no_type_check
def gather_hits(points, tile, hits):
    """Fill `hits` with the hit ranges of the slots of a tile."""
    for s in range(POINTS):
        hits[s] = points.hit[max(points.point[tile, s], 0)]


@inlined_part
@no_type_check
def _reset_state(state, columns):
    """Initialise the rows of each block: transmittance 1, median range infinite, all else 0.

    The order is transmittance, expected range, median range, alpha, alpha before the hit, features.
    """
    state[:] = 0
    for block in range(ROW):
        base = block * columns * ROW
        store(state, base, broadcast(ONE))
        store(state, base + 2 * ROW, broadcast(np.float32(np.inf)))


@inlined_part
@no_type_check
def _accumulate(splat, feature, base, state, dx, dy, t, hit, by_centre):
    """Add a splat behind the splats that a block already has. Return whether any of its rays continues."""
    transmittance = load_row(state, base)
    alpha = minimum(opacity_at(splat, dx, dy), MAX_ALPHA)
    passed = transmittance - transmittance * alpha
    # A ray ends, without counting the splat, when its transmittance would fall to MIN_TRANSMITTANCE.
    # Weight T α of the splat
    weight = select_greater(passed, MIN_TRANSMITTANCE, transmittance * alpha, ZERO)
    range_m = range_at(splat, dx, dy, t)
    store(state, base, select_greater(passed, MIN_TRANSMITTANCE, passed, ZERO))
    store(state, base + ROW, load_row(state, base + ROW) + weight * range_m)
    # The median range is that of the splat at which the transmittance falls from above 0.5 to 0.5 or less.
    # `crossed` is 0.5 at the rays where that happens, else 0.
    crossed = select_greater(weight, ZERO, select_greater(transmittance, HALF, HALF, ZERO), ZERO)
    crossed = select_greater(passed, HALF, ZERO, crossed)
    median = load_row(state, base + 2 * ROW)
    store(state, base + 2 * ROW, select_greater(crossed, ZERO, range_m, median))
    store(state, base + 3 * ROW, load_row(state, base + 3 * ROW) + weight)
    if by_centre is not None:
        # The opacity itself, of rays that have not ended, compared by the range of the centre
        alpha = select_greater(passed, MIN_TRANSMITTANCE, alpha, ZERO)
        nearer = select_greater(hit, splat[RANGE], alpha, ZERO)
    else:
        nearer = select_greater(hit, range_m, weight, ZERO)
    store(state, base + 4 * ROW, load_row(state, base + 4 * ROW) + nearer)
    # Features follow the transmittance and the four other sums
    cell = base + (EXTRA_COLUMNS + 1) * ROW
    for d in range(feature.size):
        store(state, cell, load_row(state, cell) + weight * feature[d])
        cell += ROW
    return greater_mask(passed, MIN_TRANSMITTANCE) != 0


@inlined_part
@no_type_check
def find_touched_blocks(lists, points, tile, begin, end, touched):
    """Fill `touched` with the block masks of the entries begin … end - 1 of a tile's list."""
    bounds, tile_bounds = points.block_bounds[tile], points.tile_bounds[tile]
    last = lists.splat.size - 1
    for entry in range(begin, end):
        splat = lists.packed[lists.splat[entry]]
        # The splats of a list are scattered in memory: fetch those of the next steps ahead
        soon = lists.splat[min(entry + PREFETCH_DISTANCE, last)]
        prefetch(lists.packed, soon * lists.packed.shape[1])
        prefetch(lists.feature, soon * lists.feature.shape[1])
        touched[entry - begin] = blocks_touched(
            splat, bounds, nearest_turn(splat[MEAN_X], tile_bounds, points.period)
        )


@kernel
@no_type_check
def composite_tiles(start, stop, lists, points, out):
    """Write the results of tiles start … stop - 1 to `out`, Float32[P D + 4], features first."""
    columns = lists.feature.shape[1] + EXTRA_COLUMNS + 1
    state, hits, touched = aligned_rows(ROW * columns), aligned_rows(ROW), np.empty(BATCH, np.uint32)
    for tile in range(start, stop):
        _reset_state(state, columns)
        gather_hits(points, tile, hits)
        active = ALL  # bit mask of the blocks that have unfinished rays
        for begin in range(lists.first[tile], lists.first[tile + 1], BATCH):
            end = min(begin + BATCH, lists.first[tile + 1])
            find_touched_blocks(lists, points, tile, begin, end, touched)
            for entry in range(begin, end):
                # Front to back: the order of the list
                active = _composite_splat(
                    lists, points, tile, entry, touched[entry - begin], active, hits, state
                )
            if active == 0:
                break
        _write(points, tile, state, columns, out)


@inlined_part
@no_type_check
def _composite_splat(lists, points, tile, entry, touched, active, hits, state):
    """Add the splat of entry `entry` to the blocks that it touches. Return the blocks that continue."""
    splat, feature = lists.packed[lists.splat[entry]], lists.feature[lists.splat[entry]]
    rows, columns = points.rows[tile], feature.size + EXTRA_COLUMNS + 1
    x = nearest_turn(splat[MEAN_X], points.tile_bounds[tile], points.period)
    blocks = active & touched
    # Loop over the set bits.
    while blocks != 0:
        block = lowest_set_bit(blocks)
        # Clear the lowest set bit
        blocks &= blocks - np.uint32(1)
        dx, dy, t = offsets(splat, rows, block * ROW, x)
        hit, base = load_row(hits, block * ROW), block * columns * ROW
        # No ray of the block continues: later splats skip it
        if not _accumulate(splat, feature, base, state, dx, dy, t, hit, points.by_centre):
            active &= ~(np.uint32(1) << np.uint32(block))
    return active


@inlined_part
@no_type_check
def _write(points, tile, state, columns, out):
    depth = columns - EXTRA_COLUMNS - 1
    for s in range(POINTS):
        p = points.point[tile, s]
        if p >= 0:
            # State is by block, then column, then lane
            base = s // ROW * columns * ROW + s % ROW
            for d in range(depth):
                out[p, d] = state[base + (EXTRA_COLUMNS + 1 + d) * ROW]
            for k in range(EXTRA_COLUMNS):
                out[p, depth + k] = state[base + (1 + k) * ROW]
