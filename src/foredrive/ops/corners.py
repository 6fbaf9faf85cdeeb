"""What the numba kernels of lifting and of volumes share: blocks of points, and the cells around each.

A point lies between 4 pixels or 8 voxels, its corners. A block's points are first turned into corners and
weights by loops that LLVM vectorises over points; then the corners are read eight channels at a time.
"""

from typing import NamedTuple, no_type_check

import numpy as np

from foredrive.ops.vectors import ONE, add_dots, inlined_part, kernel_part, load, mul_add, store

BLOCK = 256
"""Most points prepared at once: their buffers stay in the first-level cache. Buffers are flat, with rows of
constant length, which lets LLVM see that rows do not overlap."""


class Block(NamedTuple):
    """The points of a block; row k of a buffer begins at k · BLOCK."""

    place: np.ndarray
    """Float, a row an axis (x, y and for volumes z); integers are cell centres."""
    weight: np.ndarray
    """Float, one row."""
    corner: np.ndarray
    """Int32, a row a corner: where it lies in its image's or volume's memory."""
    part: np.ndarray
    """Float, likewise: the corners' parts of the weight."""
    dots: np.ndarray
    """Float, one after the other for each point: what its corners hold, times the gradient of the result."""


@kernel_part
@no_type_check
def new_block(axes):
    """Buffers for points in an image (2 axes) or a volume (3)."""
    size = 2**axes * BLOCK
    place, weight = np.empty(axes * BLOCK, np.float32), np.empty(BLOCK, np.float32)
    return Block(
        place, weight, np.empty(size, np.int32), np.empty(size, np.float32), np.empty(size, np.float32)
    )


@inlined_part
@no_type_check
def read_point(values, base, block, p, corners, total, zero):
    """Total + what point p reads, in the one or eight channels that `zero` has, from `base` on."""
    point = zero
    for k in range(corners):
        value = load(values, base + block.corner[k * BLOCK + p], zero)
        point = mul_add(block.part[k * BLOCK + p], value, point)
    return mul_add(ONE, point, total)


@inlined_part
@no_type_check
def send_back(values, base, block, p, corners, grad, zero, grad_values, to_points):
    """Send the gradient of what point p reads to `grad_values`, unless that is empty, and to `block.dots`."""
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
    if grad_values.size > 0:
        for k in range(corners):
            at = base + block.corner[k * BLOCK + p]
            store(grad_values, at, mul_add(block.part[k * BLOCK + p], grad, load(grad_values, at, zero)))
