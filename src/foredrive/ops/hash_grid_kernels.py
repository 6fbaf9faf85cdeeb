"""Numba kernels of `read_hash_grid`: one level of the grid at a time.

A level's table fits into the second-level cache, so a level is done for all points before the next one.
Points are processed in blocks. Loops that LLVM vectorises over the points of a block find the rows and the
weights of their eight corners, then the rows are read point by point.
"""

from typing import NamedTuple, no_type_check

import numpy as np

from foredrive.ops.short_vectors import dot, load_lanes, store_lanes, zeros2, zeros4
from foredrive.ops.vectors import ONE, ZERO, kernel, kernel_part, load, mul_add, store, zeros8

BLOCK = 256
"""Points of a block. The buffers of a block fit into the first-level cache."""
PRIME_Y, PRIME_Z, PRIME_ACTOR = 2654435761, 805459861, 3674653429
"""Factors of the hash (Müller et al. 2022, eq. 4), one more of that paper's code for the actor."""
_PY, _PZ, _PA = np.uint32(PRIME_Y), np.uint32(PRIME_Z), np.uint32(PRIME_ACTOR)


class GridInputs(NamedTuple):
    """Inputs of the kernels."""

    table: np.ndarray
    """Float[R F], rows of all levels."""
    points: np.ndarray
    """Float[N 3], in the unit cube."""
    footprint: np.ndarray
    """Float[N] in sides of the cube, or of size 0."""
    actor: np.ndarray
    """Int32[N], or of size 0."""


class GridLevel(NamedTuple):
    """One level of a hash grid. Its fields are explained in `hash_grid.Level`."""

    cells: int
    first_row: int
    rows: int
    dense: bool


class GridGradients(NamedTuple):
    """Gradients with respect to the result and to the inputs of the same names; not wanted: of size 0."""

    out: np.ndarray
    """Float[L F N]."""
    table: np.ndarray
    """Float[R F]."""
    points: np.ndarray
    """Float[L 3 N], one part per level."""


class _Block(NamedTuple):
    """The points of a block. Row k of a buffer begins at k · BLOCK."""

    inside: np.ndarray
    """Float position in the cell, x y z."""
    scale: np.ndarray
    """Float weight of the level; then three rows with the derivative of the position in cells by x y z."""
    corner: np.ndarray
    """Int32 offset of each corner's row in the level's table."""
    part: np.ndarray
    """Float weight of each corner, the level's weight included."""
    dots: np.ndarray
    """Float dot product of each corner's row with the gradient of the result."""


@kernel_part
@no_type_check
def _new_block():
    return _Block(
        np.empty(3 * BLOCK, np.float32),
        np.empty(4 * BLOCK, np.float32),
        np.empty(8 * BLOCK, np.int32),
        np.empty(8 * BLOCK, np.float32),
        np.empty(8 * BLOCK, np.float32),
    )


@kernel_part
@no_type_check
def _fill_block(inputs, block, level, first, count):
    """Find the cells, the corners and their weights of the points first … first + count - 1."""
    cells = np.float32(level.cells)
    cell = block.dots  # not in use yet: rows 0 to 2 take the cells
    scale = block.scale
    # Weight of the level: 1, or 1 / (2 · cells · footprint) where that is less
    for i in range(count):
        scale[i] = ONE
    if inputs.footprint.size > 0:
        for i in range(count):
            width = np.float32(2) * cells * inputs.footprint[first + i]
            scale[i] = ONE / width if width > ONE else ONE
    for axis in range(3):
        axis_start = axis * BLOCK
        for i in range(count):
            place = inputs.points[first + i, axis] * cells
            # NaN differs from itself. A NaN weight carries it to all features of the level
            scale[i] = scale[i] if place == place else np.float32(np.nan)
            # Positions outside of the cube are clamped, so they have no gradient
            within = (place >= ZERO) & (place <= cells)
            scale[BLOCK + axis_start + i] = cells if within else ZERO
            place = place if place > ZERO else ZERO  # NaN becomes 0 too
            place = place if place < cells else cells
            low = np.floor(place)
            # The upper face belongs to the last cell, with position 1 in it
            low = low if low < cells - ONE else cells - ONE
            cell[axis_start + i] = low
            block.inside[axis_start + i] = place - low
    if level.dense:
        _dense_corners(inputs, block, level, first, count)
    else:
        _hashed_corners(inputs, block, level, first, count)
    _weights(block, count)


@kernel_part
@no_type_check
def _dense_corners(inputs, block, level, first, count):
    cell, corner = block.dots, block.corner
    features = np.int32(inputs.table.shape[1])
    side = np.int32(level.cells + 1)
    step_y, step_z = np.int32(side * features), np.int32(side * side * features)
    # Offset of the lowest corner in floats: x runs fastest, then y, z and the actor
    for i in range(count):
        x, y, z = np.int32(cell[i]), np.int32(cell[BLOCK + i]), np.int32(cell[2 * BLOCK + i])
        corner[i] = np.int32(x * features + y * step_y + z * step_z)
    # Each actor has side³ vertices
    if inputs.actor.size > 0:
        for i in range(count):
            corner[i] = np.int32(corner[i] + inputs.actor[first + i] * np.int32(step_z * side))
    # The other corners: bit 0 of the number is one step along x, bit 1 along y, bit 2 along z
    for i in range(count):
        low = corner[i]
        corner[BLOCK + i] = np.int32(low + features)
        corner[2 * BLOCK + i] = np.int32(low + step_y)
        corner[3 * BLOCK + i] = np.int32(low + step_y + features)
        corner[4 * BLOCK + i] = np.int32(low + step_z)
        corner[5 * BLOCK + i] = np.int32(low + step_z + features)
        corner[6 * BLOCK + i] = np.int32(low + step_z + step_y)
        corner[7 * BLOCK + i] = np.int32(low + step_z + step_y + features)


@kernel_part
@no_type_check
def _hashed_corners(inputs, block, level, first, count):
    cell, corner = block.dots, block.corner
    features = np.int32(inputs.table.shape[1])
    # The number of rows is a power of two, so the mask replaces the modulo
    mask = np.uint32(level.rows - 1)
    # The last corner's row of the buffer holds the actor's part of the hash until it is overwritten below
    if inputs.actor.size > 0:
        for i in range(count):
            corner[7 * BLOCK + i] = np.int32(np.uint32(inputs.actor[first + i]) * _PA)
    else:
        for i in range(count):
            corner[7 * BLOCK + i] = np.int32(0)
    for i in range(count):
        # Unsigned 32-bit products wrap around, as in the paper's code
        x0 = np.uint32(np.int32(cell[i])) ^ np.uint32(corner[7 * BLOCK + i])
        x1 = np.uint32(np.int32(cell[i]) + np.int32(1)) ^ np.uint32(corner[7 * BLOCK + i])
        y0 = np.uint32(np.uint32(np.int32(cell[BLOCK + i])) * _PY)
        z0 = np.uint32(np.uint32(np.int32(cell[2 * BLOCK + i])) * _PZ)
        # (y + 1) · π = y · π + π, so the neighbour's product costs one addition
        y1, z1 = np.uint32(y0 + _PY), np.uint32(z0 + _PZ)
        yz0, yz1, yz2, yz3 = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
        # XOR of the parts, reduced to the table's rows; the offset counts floats
        corner[i] = np.int32((x0 ^ yz0) & mask) * features
        corner[BLOCK + i] = np.int32((x1 ^ yz0) & mask) * features
        corner[2 * BLOCK + i] = np.int32((x0 ^ yz1) & mask) * features
        corner[3 * BLOCK + i] = np.int32((x1 ^ yz1) & mask) * features
        corner[4 * BLOCK + i] = np.int32((x0 ^ yz2) & mask) * features
        corner[5 * BLOCK + i] = np.int32((x1 ^ yz2) & mask) * features
        corner[6 * BLOCK + i] = np.int32((x0 ^ yz3) & mask) * features
        corner[7 * BLOCK + i] = np.int32((x1 ^ yz3) & mask) * features


@kernel_part
@no_type_check
def _weights(block, count):
    inside, part = block.inside, block.part
    for i in range(count):
        x1, y1, z1 = inside[i], inside[BLOCK + i], inside[2 * BLOCK + i]
        x0, y0 = ONE - x1, ONE - y1
        # The weight of the level is multiplied into the weights along z
        low, high = block.scale[i] * (ONE - z1), block.scale[i] * z1
        part[i], part[BLOCK + i] = low * y0 * x0, low * y0 * x1
        part[2 * BLOCK + i], part[3 * BLOCK + i] = low * y1 * x0, low * y1 * x1
        part[4 * BLOCK + i], part[5 * BLOCK + i] = high * y0 * x0, high * y0 * x1
        part[6 * BLOCK + i], part[7 * BLOCK + i] = high * y1 * x0, high * y1 * x1


@kernel_part
@no_type_check
def _read(inputs, block, level, first, count, number, zero, out):
    """Write the features of a block, the rows number · F and following of `out`."""
    features, points = inputs.table.shape[1], inputs.points.shape[0]
    # Features are stored with the points last, so the lanes of a point are `points` apart
    base = level.first_row * features
    place = number * features * points + first
    corner, part, table = block.corner, block.part, inputs.table
    for i in range(count):
        total = zero
        for k in range(8):
            total = mul_add(part[k * BLOCK + i], load(table, base + corner[k * BLOCK + i], zero), total)
        store_lanes(out, place + i, points, total)


@kernel
@no_type_check
def read_level(inputs, level, number, first, last, out):
    """Write the features of level `number` for points first … last - 1 to `out`, Float[L F N]."""
    block, features = _new_block(), inputs.table.shape[1]
    for start in range(first, last, BLOCK):
        count = min(BLOCK, last - start)
        # `zero` selects the version for the number of features: numba compiles one for each type
        _fill_block(inputs, block, level, start, count)
        if features == 1:
            _read(inputs, block, level, start, count, number, ZERO, out)
        elif features == 2:
            _read(inputs, block, level, start, count, number, zeros2(), out)
        elif features == 4:
            _read(inputs, block, level, start, count, number, zeros4(), out)
        else:
            _read(inputs, block, level, start, count, number, zeros8(), out)


@kernel_part
@no_type_check
def _read_back(inputs, block, level, first, count, number, zero, grads):
    """Add the gradients of the table's rows, and write the dot products of a block."""
    features, points = inputs.table.shape[1], inputs.points.shape[0]
    base = level.first_row * features
    place = number * features * points + first
    corner, part, table = block.corner, block.part, inputs.table
    to_points, to_table = grads.points.size > 0, grads.table.size > 0
    for i in range(count):
        grad = load_lanes(grads.out, place + i, points, zero)
        if to_points:
            # Dot products first: they need only the table, not its gradient
            for k in range(8):
                row = load(table, base + corner[k * BLOCK + i], zero)
                block.dots[k * BLOCK + i] = dot(row, grad)
        if to_table:
            for k in range(8):
                table_row = base + corner[k * BLOCK + i]
                store(
                    grads.table,
                    table_row,
                    mul_add(part[k * BLOCK + i], grad, load(grads.table, table_row, zero)),
                )


@kernel_part
@no_type_check
def _slopes(block, first, count, number, grad_points):
    """Convert the dot products of a block into gradients with respect to its points."""
    inside, scale, dots = block.inside, block.scale, block.dots
    along_x, along_y, along_z = grad_points[number, 0], grad_points[number, 1], grad_points[number, 2]
    for i in range(count):
        x1, y1, z1 = inside[i], inside[BLOCK + i], inside[2 * BLOCK + i]
        x0, y0, z0 = ONE - x1, ONE - y1, ONE - z1
        d0, d1, d2, d3 = dots[i], dots[BLOCK + i], dots[2 * BLOCK + i], dots[3 * BLOCK + i]
        d4, d5, d6, d7 = dots[4 * BLOCK + i], dots[5 * BLOCK + i], dots[6 * BLOCK + i], dots[7 * BLOCK + i]
        # The derivative along an axis is the difference of its two corners, interpolated along the other axes
        w = scale[i]
        to_x = z0 * (y0 * (d1 - d0) + y1 * (d3 - d2)) + z1 * (y0 * (d5 - d4) + y1 * (d7 - d6))
        to_y = z0 * (x0 * (d2 - d0) + x1 * (d3 - d1)) + z1 * (x0 * (d6 - d4) + x1 * (d7 - d5))
        to_z = y0 * (x0 * (d4 - d0) + x1 * (d5 - d1)) + y1 * (x0 * (d6 - d2) + x1 * (d7 - d3))
        # Chain rule: the weight of the level, and the derivative of the position in cells
        along_x[first + i] = w * scale[BLOCK + i] * to_x
        along_y[first + i] = w * scale[2 * BLOCK + i] * to_y
        along_z[first + i] = w * scale[3 * BLOCK + i] * to_z


@kernel
@no_type_check
def read_level_back(inputs, level, number, grads):
    """Add the gradients of one level's rows, and write those of the points.

    Levels have disjoint rows, and each has its own part of `grads.points`. So levels can run in parallel.
    """
    block, features, points = _new_block(), inputs.table.shape[1], inputs.points.shape[0]
    for start in range(0, points, BLOCK):
        count = min(BLOCK, points - start)
        # Corners and weights are computed again and not kept from the forward pass
        _fill_block(inputs, block, level, start, count)
        if features == 1:
            _read_back(inputs, block, level, start, count, number, ZERO, grads)
        elif features == 2:
            _read_back(inputs, block, level, start, count, number, zeros2(), grads)
        elif features == 4:
            _read_back(inputs, block, level, start, count, number, zeros4(), grads)
        else:
            _read_back(inputs, block, level, start, count, number, zeros8(), grads)
        if grads.points.size > 0:
            _slopes(block, start, count, number, grads.points)
