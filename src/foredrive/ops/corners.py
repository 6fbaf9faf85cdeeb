"""Shared parts of the numba kernels for lifting and volumes: blocks of points and their corners.

The corners of a point are the 4 pixels or 8 voxels around it. First, loops that LLVM vectorises over points
compute the corners and weights of a block. Then the corners are read, eight channels at a time.
"""

from typing import NamedTuple, no_type_check

import numpy as np

from foredrive.ops.vectors import ONE, add_dots, inlined_part, kernel_part, load, mul_add, store

BLOCK = 256
"""Maximum number of points in a block. The buffers then fit into the first-level cache. They are flat with
rows of constant length, which shows LLVM that rows do not overlap."""


class Block(NamedTuple):
    """The points of a block. Row k of a buffer begins at k · BLOCK."""

    place: np.ndarray
    """Float coordinates, one row per axis (x, y and, for volumes, z). Integers are cell centres."""
    weight: np.ndarray
    """Float weights of the points, one row."""
    corner: np.ndarray
    """Int32 memory offset of each corner in its image or volume, one row per corner."""
    part: np.ndarray
    """Float weight of each corner (weight of the point times interpolation weight), one row per corner."""
    dots: np.ndarray
    """Float dot product of each corner's values with the gradient of the result, point by point."""


@kernel_part
@no_type_check
def new_block(axes):
    """Return empty buffers for points in an image (2 axes) or a volume (3 axes)."""
    size = 2**axes * BLOCK
    place, weight = np.empty(axes * BLOCK, np.float32), np.empty(BLOCK, np.float32)
    return Block(
        place, weight, np.empty(size, np.int32), np.empty(size, np.float32), np.empty(size, np.float32)
    )


@inlined_part
@no_type_check
def set_corners(block, i, weight, row0, row1, x0, x1, wy0, wy1, wx0, wx1, channels):
    """Fill `corner` and `part` at i for four corners in one plane. row0 and row1 are starts of pixel rows."""
    # Offsets count floats, because channels are last: pixel index times channels
    corner, part = block.corner, block.part
    corner[i] = (row0 + x0) * channels
    corner[BLOCK + i] = (row0 + x1) * channels
    corner[2 * BLOCK + i] = (row1 + x0) * channels
    corner[3 * BLOCK + i] = (row1 + x1) * channels
    # Bilinear weight of each corner, times the weight of the point
    part[i] = weight * wy0 * wx0
    part[BLOCK + i] = weight * wy0 * wx1
    part[2 * BLOCK + i] = weight * wy1 * wx0
    part[3 * BLOCK + i] = weight * wy1 * wx1


@inlined_part
@no_type_check
def sample_point(values, base, block, p, corners, total, zero):
    """Return total + weighted interpolated value at point p, in the channels from `base` on.

    `zero` sets the number of channels: a float32 for one, a vector for eight.
    """
    point = zero
    for k in range(corners):
        value = load(values, base + block.corner[k * BLOCK + p], zero)
        point = mul_add(block.part[k * BLOCK + p], value, point)
    return mul_add(ONE, point, total)


@inlined_part
@no_type_check
def sample_point_backward(values, base, block, p, corners, grad, zero, grad_values, to_points):
    """Add the gradient of `sample_point` to `grad_values` (unless that is empty) and to `block.dots`."""
    # Dots of the corner values with the gradient, from which the gradients of place and weight follow
    if to_points:
        for k in range(0, corners, 4):
            add_dots(
                block.dots,
                corners * p + k,
                load(values, base + block.corner[k * BLOCK + p], zero),
                load(values, base + block.corner[(k + 1) * BLOCK + p], zero),
                load(values, base + block.corner[(k + 2) * BLOCK + p], zero),
                load(values, base + block.corner[(k + 3) * BLOCK + p], zero),
                grad,
            )
    # Each corner gets the gradient times its interpolation weight
    if grad_values.size > 0:
        for k in range(corners):
            row = base + block.corner[k * BLOCK + p]
            store(grad_values, row, mul_add(block.part[k * BLOCK + p], grad, load(grad_values, row, zero)))
