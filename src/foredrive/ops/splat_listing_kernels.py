"""Numba kernels that find which splats touch which tiles, front to back."""

from typing import NamedTuple, no_type_check

import numpy as np

from foredrive.ops.vectors import inlined_part, kernel

LOG2_E = np.float32(1.4426950408889634)
ZERO, HALF = np.float32(0), np.float32(0.5)
SLACK = np.float32(1e-3)
"""Of an exponent: what rounding may do to it."""
LEAST = np.float32(np.log2(1 / 255) - SLACK)
"""Splats whose opacity is below 2 to this power everywhere in a box are not listed there."""

# columns of a packed splat
MEAN_X, MEAN_Y, VELOCITY_X, VELOCITY_Y = 0, 1, 2, 3
XX, XY, YY, LOG_OPACITY = 4, 5, 6, 7
"""log2 of the opacity at d is log opacity + xx dx² + xy dx dy + yy dy²."""
RANGE, SLOPE_X, SLOPE_Y, RATE = 8, 9, 10, 11
TILT_Y, TILT_X = 12, 13
"""Where along y the exponent is greatest is tilt_y · dx; along x, tilt_x · dy."""
REACH_X, REACH_Y = 14, 15
"""How far from the mean the opacity reaches 1/255."""
COLUMNS = 16
"""One cache line."""


class Raw(NamedTuple):
    """Arrays of the `Splats` that decide where a splat is; all float32 and contiguous."""

    mean: np.ndarray
    inverse_covariance: np.ndarray
    opacity: np.ndarray
    range_m: np.ndarray
    range_slope: np.ndarray
    velocity: np.ndarray
    range_rate_mps: np.ndarray


class Tiles(NamedTuple):
    """Arrays of the `TiledPoints` that say where tiles are."""

    bounds: np.ndarray
    """Float32[T 6]."""
    left_edge: np.ndarray
    lower_edge: np.ndarray
    first_tile: np.ndarray
    first_s: np.float32
    last_s: np.float32
    """Time of the first and the last point."""
    period: np.float32


@kernel
@no_type_check
def pack_splats(start, stop, raw, period, packed):
    """Fill rows start … stop of `packed`, Float32[N 16], with what the other kernels read of each splat."""
    for i in range(start, stop):
        row = packed[i]
        x = raw.mean[i, 0]
        row[MEAN_X] = x - period * np.floor(x / period + HALF) if period > 0 else x
        row[MEAN_Y] = raw.mean[i, 1]
        row[VELOCITY_X], row[VELOCITY_Y] = raw.velocity[i, 0], raw.velocity[i, 1]
        xx, xy, yy = (
            raw.inverse_covariance[i, 0],
            raw.inverse_covariance[i, 1],
            raw.inverse_covariance[i, 2],
        )
        row[XX], row[XY], row[YY] = -HALF * LOG2_E * xx, -LOG2_E * xy, -HALF * LOG2_E * yy
        opacity = raw.opacity[i]
        log_opacity = np.log2(opacity) if opacity > 0 else np.float32(-np.inf)
        row[LOG_OPACITY] = log_opacity
        row[RANGE], row[RATE] = raw.range_m[i], raw.range_rate_mps[i]
        row[SLOPE_X], row[SLOPE_Y] = raw.range_slope[i, 0], raw.range_slope[i, 1]
        row[TILT_Y], row[TILT_X] = -xy / yy, -xy / xx
        area = np.float64(xx) * np.float64(yy) - np.float64(xy) * np.float64(xy)
        square = max(2 * (log_opacity - LEAST) / LOG2_E, 0) / max(area, 1e-30)
        row[REACH_X], row[REACH_Y] = np.sqrt(square * yy), np.sqrt(square * xx)


@inlined_part
@no_type_check
def touches(row, bounds, x):
    """Whether the opacity of a packed splat whose mean is at x reaches 1/255 in a tile's box.

    The greatest exponent in a box that does not hold the mean lies on one of the two sides next to it.
    """
    vx, vy, t0, t1 = row[VELOCITY_X], row[VELOCITY_Y], bounds[4], bounds[5]
    x0, x1 = bounds[0] - x - max(vx * t0, vx * t1), bounds[1] - x - min(vx * t0, vx * t1)
    y = row[MEAN_Y]
    y0, y1 = bounds[2] - y - max(vy * t0, vy * t1), bounds[3] - y - min(vy * t0, vy * t1)
    near_x, near_y = min(max(x0, 0), x1), min(max(y0, 0), y1)
    along_y, along_x = min(max(row[TILT_Y] * near_x, y0), y1), min(max(row[TILT_X] * near_y, x0), x1)
    at_side = near_x * (row[XX] * near_x + row[XY] * along_y) + row[YY] * along_y * along_y
    at_edge = along_x * (row[XX] * along_x + row[XY] * near_y) + row[YY] * near_y * near_y
    return row[LOG_OPACITY] + max(at_side, at_edge) >= LEAST


@inlined_part
@no_type_check
def turned(x, bounds, period):
    """The mean's place x, whole periods away, that is nearest to the middle of a tile."""
    if period > 0:
        middle = HALF * (bounds[0] + bounds[1])
        return x + period * np.floor((middle - x) / period + HALF)
    return x


@inlined_part
@no_type_check
def _last_at_most(values, start, stop, x):
    """Place of the last of ascending values[start:stop] that is at most x; start if none is.

    Tiles are about equally wide: a guess is seldom far off.
    """
    span = values[stop - 1] - values[start]
    guess = (x - values[start]) / span * np.float32(stop - 1 - start) if span > 0 else ZERO
    k = start + int(min(max(guess, ZERO), np.float32(stop - 1 - start)))
    while k > start and values[k] > x:
        k -= 1
    while k + 1 < stop and values[k + 1] <= x:
        k += 1
    return k


@inlined_part
@no_type_check
def _list_box(row, tiles, box, turn, found, count):
    """Add the tiles that a splat touches within a box, x0 x1 y0 y1, that is so many turns away from it."""
    x0, x1, y0, y1 = box
    rows = tiles.lower_edge.size
    first_row = _last_at_most(tiles.lower_edge, 0, rows, y0)
    r = first_row
    while r < rows and tiles.lower_edge[r] <= y1:
        first, last = tiles.first_tile[r], tiles.first_tile[r + 1]
        first_here = _last_at_most(tiles.left_edge, first, last, x0)
        t = first_here
        while t < last and tiles.left_edge[t] <= x1:
            bounds = tiles.bounds[t]
            alone = r == first_row and t == first_here
            alone = alone and (r + 1 == rows or tiles.lower_edge[r + 1] > y1)
            alone = alone and (t + 1 == last or tiles.left_edge[t + 1] > x1)
            x = turned(row[MEAN_X], bounds, tiles.period)
            if abs(x - row[MEAN_X] - turn * tiles.period) > HALF * tiles.period:
                yes = False  # another turn is nearer to this tile
            elif alone:  # a small splat in one tile: a closer look would change little
                yes = x0 <= bounds[1] and x1 >= bounds[0] and y0 <= bounds[3] and y1 >= bounds[2]
            else:
                yes = touches(row, bounds, x)
            if yes:
                if count < found.size:
                    found[count] = t
                count += 1
            t += 1
        r += 1
    return count


@kernel
@no_type_check
def list_tiles(start, stop, packed, tiles, per_splat, found):
    """Write to `found`, Int32, the tiles that the splats start … stop touch, one splat after the other.

    Writes to `per_splat` how many each touches, and returns how many that are in all: if `found` is too
    short for them, it has to be called again.
    """
    count = 0
    turns = 1 if tiles.period > 0 else 0
    half_turn = HALF * tiles.period
    for i in range(start, stop):
        row, before = packed[i], count
        if row[LOG_OPACITY] >= LEAST and tiles.lower_edge.size > 0:
            vx, vy, t0, t1 = row[VELOCITY_X], row[VELOCITY_Y], tiles.first_s, tiles.last_s
            x0 = row[MEAN_X] - row[REACH_X] + min(vx * t0, vx * t1)
            x1 = row[MEAN_X] + row[REACH_X] + max(vx * t0, vx * t1)
            y0 = row[MEAN_Y] - row[REACH_Y] + min(vy * t0, vy * t1)
            y1 = row[MEAN_Y] + row[REACH_Y] + max(vy * t0, vy * t1)
            for turn in range(-turns, turns + 1):
                away = turn * tiles.period
                if turns == 0 or (x1 + away >= -half_turn and x0 + away <= half_turn):
                    count = _list_box(row, tiles, (x0 + away, x1 + away, y0, y1), turn, found, count)
        per_splat[i] = count - before
    return count


@kernel
@no_type_check
def front_to_back(packed, order):
    """Fill `order`, Int32[N], with the splats by ascending range, equal ones as they come.

    Radix sort by 11 bits at a time: the bits of positive float32 are ordered as they are themselves, those of
    negative ones the other way round.
    """
    count = order.size
    keys, other_keys = np.empty(count, np.uint32), np.empty(count, np.uint32)
    other = np.empty(count, np.int32)
    places = np.zeros((3, 2048), np.int32)
    for i in range(count):
        key = np.float32(packed[i, RANGE]).view(np.uint32)
        key = ~key if key >> np.uint32(31) else key | np.uint32(1 << 31)
        keys[i], order[i] = key, i
        for digit in range(3):
            places[digit, (key >> np.uint32(11 * digit)) & np.uint32(2047)] += 1
    for digit in range(3):
        place, at = places[digit], 0
        for value in range(2048):
            place[value], at = at, at + place[value]
        for i in range(count):
            value = (keys[i] >> np.uint32(11 * digit)) & np.uint32(2047)
            other_keys[place[value]], other[place[value]] = keys[i], order[i]
            place[value] += 1
        keys, other_keys = other_keys, keys
        order[:] = other


@kernel
@no_type_check
def hand_out(order, first_slot, tile_of, first, splat, slot):
    """Hand splats out to the tiles in the given order.

    Args:
        first_slot: Int64[N + 1], where a splat's tiles begin in `tile_of`, Int32[L].
        first: Int64[T + 2], zeros; the first T + 1 become where a tile's list begins.
        splat, slot: Int32[L], the lists: which splat, and which entry of `tile_of` that is.
    """
    for tile in tile_of:
        first[tile + 2] += 1
    for t in range(2, first.size):
        first[t] += first[t - 1]
    for i in order:
        for k in range(first_slot[i], first_slot[i + 1]):
            at = first[tile_of[k] + 1]
            splat[at], slot[at] = i, k
            first[tile_of[k] + 1] = at + 1
