"""Numba kernels that find the splats of each tile and sort them front to back."""

from typing import NamedTuple, no_type_check

import numpy as np

from foredrive.ops.vectors import inlined_part, kernel

LOG2_E = np.float32(1.4426950408889634)
ZERO, HALF = np.float32(0), np.float32(0.5)
TOLERANCE = np.float32(1e-3)
"""Tolerance of an exponent for rounding errors."""
MIN_LOG_OPACITY = np.float32(np.log2(1 / 255) - TOLERANCE)
"""log2 of the minimum opacity (1/255, minus the tolerance). A splat whose opacity stays below it in the whole
box is not listed."""

# Columns of a packed splat.
MEAN_X, MEAN_Y, VELOCITY_X, VELOCITY_Y = 0, 1, 2, 3
XX, XY, YY, LOG_OPACITY = 4, 5, 6, 7
"""log2 of the opacity at offset d is log opacity + xx dx² + xy dx dy + yy dy²."""
RANGE, SLOPE_X, SLOPE_Y, RATE = 8, 9, 10, 11
TILT_Y, TILT_X = 12, 13
"""For given dx, the exponent is largest at dy = tilt_y · dx. For given dy, at dx = tilt_x · dy."""
EXTENT_X, EXTENT_Y = 14, 15
"""Distance from the mean, along each axis, at which the opacity falls to 1/255."""
COLUMNS = 16
"""Number of columns: one cache line."""


class SplatArrays(NamedTuple):
    """Fields of `Splats`, or the gradients with respect to them, all float32 and contiguous."""

    mean: np.ndarray
    inverse_covariance: np.ndarray
    opacity: np.ndarray
    range_m: np.ndarray
    range_slope: np.ndarray
    velocity: np.ndarray
    range_rate_mps: np.ndarray
    feature: np.ndarray


class PointArrays(NamedTuple):
    """Fields of `TiledPoints`, and the hits."""

    rows: np.ndarray
    """Float32[T 3 256], x, y, time."""
    block_bounds: np.ndarray
    """Float32[T 6 16], smallest and largest x, y and time of each block."""
    tile_bounds: np.ndarray
    """Float32[T 6], smallest and largest x, y and time of each tile."""
    point: np.ndarray
    """Int32[T 256], index of the point in each slot; -1 for none."""
    hit: np.ndarray
    """Float32[P], range of the hit of each point."""
    by_centre: bool | None
    """True for `BeforeHit` "opacities", None for "weights". Kernels are compiled for each type, so that the
    usual one does not branch.
    """
    left_edge: np.ndarray
    lower_edge: np.ndarray
    first_tile: np.ndarray
    first_s: np.float32
    last_s: np.float32
    """Time of the first and the last point."""
    period: np.float32


@kernel
@no_type_check
def pack_splats(start, stop, splats, period, packed):
    """Fill rows start … stop - 1 of `packed`, Float32[N 16], the input of the other kernels."""
    for i in range(start, stop):
        row = packed[i]
        x = splats.mean[i, 0]
        # Wrap x to ±half a period
        row[MEAN_X] = x - period * np.floor(x / period + HALF) if period > 0 else x
        row[MEAN_Y] = splats.mean[i, 1]
        row[VELOCITY_X], row[VELOCITY_Y] = splats.velocity[i, 0], splats.velocity[i, 1]
        xx, xy = splats.inverse_covariance[i, 0], splats.inverse_covariance[i, 1]
        yy = splats.inverse_covariance[i, 2]
        # Exponent of the Gaussian in base 2: the factors -½ and log2(e) are part of the coefficients
        row[XX], row[XY], row[YY] = -HALF * LOG2_E * xx, -LOG2_E * xy, -HALF * LOG2_E * yy
        opacity = splats.opacity[i]
        log_opacity = np.log2(opacity) if opacity > 0 else np.float32(-np.inf)
        row[LOG_OPACITY] = log_opacity
        row[RANGE], row[RATE] = splats.range_m[i], splats.range_rate_mps[i]
        row[SLOPE_X], row[SLOPE_Y] = splats.range_slope[i, 0], splats.range_slope[i, 1]
        # Where the exponent's derivative along the other axis is zero
        row[TILT_Y], row[TILT_X] = -xy / yy, -xy / xx
        # The ellipse dᵀ A d ≤ c reaches √(c · yy / det A) along x and √(c · xx / det A) along y.
        # Double precision: thin ellipses have a determinant near zero
        area = np.float64(xx) * np.float64(yy) - np.float64(xy) * np.float64(xy)
        square = max(2 * (log_opacity - MIN_LOG_OPACITY) / LOG2_E, 0) / max(area, 1e-30)
        row[EXTENT_X], row[EXTENT_Y] = np.sqrt(square * yy), np.sqrt(square * xx)


@inlined_part
@no_type_check
def touches(row, bounds, x):
    """Return whether the opacity of a packed splat with mean x reaches 1/255 in the box of a tile.

    If the box does not contain the mean, the largest exponent is on one of the two sides nearest to the mean.
    """
    vx, vy, t0, t1 = row[VELOCITY_X], row[VELOCITY_Y], bounds[4], bounds[5]
    # Bounds of the offset d = p - mean - velocity · t over the box and its time interval.
    x0, x1 = bounds[0] - x - max(vx * t0, vx * t1), bounds[1] - x - min(vx * t0, vx * t1)
    y = row[MEAN_Y]
    y0, y1 = bounds[2] - y - max(vy * t0, vy * t1), bounds[3] - y - min(vy * t0, vy * t1)
    # Point of the box nearest to the mean along each axis: 0 if the box contains the mean's coordinate
    near_x, near_y = min(max(x0, 0), x1), min(max(y0, 0), y1)
    # The best place on the nearest vertical and on the nearest horizontal side, within the box
    along_y, along_x = min(max(row[TILT_Y] * near_x, y0), y1), min(max(row[TILT_X] * near_y, x0), x1)
    # Exponents are negative or zero: the larger one is the largest in the box
    at_side = near_x * (row[XX] * near_x + row[XY] * along_y) + row[YY] * along_y * along_y
    at_edge = along_x * (row[XX] * along_x + row[XY] * near_y) + row[YY] * near_y * near_y
    return row[LOG_OPACITY] + max(at_side, at_edge) >= MIN_LOG_OPACITY


@inlined_part
@no_type_check
def nearest_turn(x, bounds, period):
    """Return the position x shifted by whole periods to be nearest to the middle of a tile."""
    if period > 0:
        middle = HALF * (bounds[0] + bounds[1])
        return x + period * np.floor((middle - x) / period + HALF)
    return x


@inlined_part
@no_type_check
def _last_at_most(values, start, stop, x):
    """Return the index of the last element ≤ x in ascending values[start:stop]; start if there is none.

    Tiles have similar widths, so linear interpolation gives a good first guess.
    """
    span = values[stop - 1] - values[start]
    guess = (x - values[start]) / span * np.float32(stop - 1 - start) if span > 0 else ZERO
    # Correct the guess by steps
    k = start + int(min(max(guess, ZERO), np.float32(stop - 1 - start)))
    while k > start and values[k] > x:
        k -= 1
    while k + 1 < stop and values[k + 1] <= x:
        k += 1
    return k


@inlined_part
@no_type_check
def _find_tiles_in_box(row, points, box, turn, tiles, count):
    """Add the tiles that a splat touches within a box x0 x1 y0 y1 to `tiles`. Return the new count.

    The box is shifted by `turn` periods from the splat.
    """
    x0, x1, y0, y1 = box
    rows = points.lower_edge.size
    # The last row that begins at or below the box is the first that may reach into it
    first_row = _last_at_most(points.lower_edge, 0, rows, y0)
    r = first_row
    while r < rows and points.lower_edge[r] <= y1:
        first, last = points.first_tile[r], points.first_tile[r + 1]
        # Likewise within the row: tiles follow each other without gaps along x
        first_here = _last_at_most(points.left_edge, first, last, x0)
        t = first_here
        while t < last and points.left_edge[t] <= x1:
            bounds = points.tile_bounds[t]
            # `alone` means that the box overlaps a single tile.
            alone = r == first_row and t == first_here
            alone = alone and (r + 1 == rows or points.lower_edge[r + 1] > y1)
            alone = alone and (t + 1 == last or points.left_edge[t + 1] > x1)
            x = nearest_turn(row[MEAN_X], bounds, points.period)
            if abs(x - row[MEAN_X] - turn * points.period) > HALF * points.period:
                touched = False  # another turn is nearer to this tile
            elif alone:  # a small splat in one tile: the exact test would change little
                touched = x0 <= bounds[1] and x1 >= bounds[0] and y0 <= bounds[3] and y1 >= bounds[2]
            else:
                touched = touches(row, bounds, x)
            if touched:
                # Beyond the end of the buffer only count: the caller comes again with a longer one
                if count < tiles.size:
                    tiles[count] = t
                count += 1
            t += 1
        r += 1
    return count


@kernel
@no_type_check
def find_tiles(start, stop, packed, points, per_splat, tiles):
    """Write the tiles that the splats start … stop - 1 touch to `tiles`, Int32, splat by splat.

    `per_splat` gets the number of tiles of each splat. Return the total number. If `tiles` is too short, call
    the function again with a longer array.
    """
    count = 0
    # On a periodic plane, the copies one period to the left and right count too
    turns = 1 if points.period > 0 else 0
    half_turn = HALF * points.period
    for i in range(start, stop):
        row, before = packed[i], count
        if row[LOG_OPACITY] >= MIN_LOG_OPACITY and points.lower_edge.size > 0:
            # Box of the ellipse, enlarged by the motion over all measurement times
            vx, vy, t0, t1 = row[VELOCITY_X], row[VELOCITY_Y], points.first_s, points.last_s
            x0 = row[MEAN_X] - row[EXTENT_X] + min(vx * t0, vx * t1)
            x1 = row[MEAN_X] + row[EXTENT_X] + max(vx * t0, vx * t1)
            y0 = row[MEAN_Y] - row[EXTENT_Y] + min(vy * t0, vy * t1)
            y1 = row[MEAN_Y] + row[EXTENT_Y] + max(vy * t0, vy * t1)
            for turn in range(-turns, turns + 1):
                away = turn * points.period
                # Only copies that reach into one period about 0 meet tiles
                if turns == 0 or (x1 + away >= -half_turn and x0 + away <= half_turn):
                    count = _find_tiles_in_box(
                        row, points, (x0 + away, x1 + away, y0, y1), turn, tiles, count
                    )
        per_splat[i] = count - before
    return count


@kernel
@no_type_check
def sort_by_range(packed, order):
    """Fill `order`, Int32[N], with the splats sorted by ascending range. The sort is stable.

    It is a radix sort with 11 bits per pass. The bits of positive float32 numbers have the order of the
    numbers. The bits of negative ones have the reverse order.
    """
    count = order.size
    keys, other_keys = np.empty(count, np.uint32), np.empty(count, np.uint32)
    other = np.empty(count, np.int32)
    starts = np.zeros((3, 2048), np.int32)
    for i in range(count):
        key = np.float32(packed[i, RANGE]).view(np.uint32)
        # Map the float's bits to an unsigned integer of the same order.
        key = ~key if key >> np.uint32(31) else key | np.uint32(1 << 31)
        keys[i], order[i] = key, i
        # Histograms of all three digits in one pass over the keys
        for digit in range(3):
            starts[digit, (key >> np.uint32(11 * digit)) & np.uint32(2047)] += 1
    for digit in range(3):
        # Exclusive prefix sum: counts become the first place of each value
        place, next_place = starts[digit], 0
        for value in range(2048):
            place[value], next_place = next_place, next_place + place[value]
        # Stable distribution by the digit, least significant digit first
        for i in range(count):
            value = (keys[i] >> np.uint32(11 * digit)) & np.uint32(2047)
            other_keys[place[value]], other[place[value]] = keys[i], order[i]
            place[value] += 1
        keys, other_keys = other_keys, keys
        order[:] = other


@kernel
@no_type_check
def fill_tile_lists(order, first_slot, tile_of, first, splat, slot):
    """Distribute the splats to the lists of the tiles, in the given order.

    Args:
        first_slot: Int64[N + 1], start of each splat's tiles in `tile_of`, Int32[L].
        first: Int64[T + 2], zeros. On return the first T + 1 entries are the starts of the tiles' lists.
        splat, slot: Int32[L], the lists: index of the splat, and index of the entry in `tile_of`.
    """
    # Count per tile, shifted by two. While the lists are filled, first[t + 1] is the next free place of tile
    # t.
    for tile in tile_of:
        first[tile + 2] += 1
    # Prefix sum: first[t + 1] becomes the start of tile t
    for t in range(2, first.size):
        first[t] += first[t - 1]
    # Splats come in order of range, so that each list is sorted front to back
    for i in order:
        for k in range(first_slot[i], first_slot[i + 1]):
            tile_slot = first[tile_of[k] + 1]
            # `slot` leads back from a list entry to the pair's row, which is contiguous per splat
            splat[tile_slot], slot[tile_slot] = i, k
            first[tile_of[k] + 1] = tile_slot + 1
