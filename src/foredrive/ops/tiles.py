"""Shared parts of the Triton kernels: tiles of rows × points × channels, and interpolation between cells.

A row is one head of one query. All sums are in float32, for any input type. Without a GPU the kernels run in
Triton's interpreter, if TRITON_INTERPRET=1 is set before Triton is imported. The tests do this.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, no_type_check

import triton
import triton.language as tl
from torch import Tensor

TILE = 1024
"""Numbers in a tile: eight per thread."""
MAX_POINTS, PLACE = 16, 4
"""Maximum number of points in a tile; the numbers that a place (a point of a row) counts as at least, because
it needs more registers than a number that is read there."""


class TileShape(NamedTuple):
    """The size of a program's tile. All entries are powers of two."""

    rows: int
    points: int
    channels: int


def tile_shape(points: int, channels: int, numbers: int = TILE) -> TileShape:
    """Return the tile for rows of given size: it has all channels, some points and some rows."""
    # All channels in a tile; then as many points as fit; then as many rows
    wide = int(triton.next_power_of_2(channels))
    count = min(int(triton.next_power_of_2(points)), MAX_POINTS, max(numbers // wide, 1))
    return TileShape(rows=max(numbers // max(wide, PLACE) // count, 1), points=count, channels=wide)


def launch(
    kernel: Any,
    tensors: Sequence[Tensor | None],
    sizes: Sequence[int],
    weights: Tensor,
    channels: int,
    numbers: int = TILE,
    **flags: bool,
) -> None:
    """Run a kernel over all rows.

    Args:
        tensors: first arguments of the kernel; the numbers of rows and of queries follow.
        sizes: the next arguments.
        weights: attention weights [b Q H … P].
        channels: number of channels of all heads together.
        numbers: maximum number of numbers in a tile.
    """
    (queries, heads), points = weights.shape[1:3], weights.shape[-1]
    rows, width = len(weights) * queries * heads, channels // heads
    tile = tile_shape(points, width, numbers)
    if rows:
        # One program for each tile of rows
        kernel[(triton.cdiv(rows, tile.rows),)](
            *tensors,
            rows,
            queries,
            *sizes,
            HEADS=heads,
            POINTS=points,
            WIDTH=width,
            ROWS=tile.rows,
            P=tile.points,
            W=tile.channels,
            **flags,
        )


@triton.jit
@no_type_check
def rows_of_program(row_count, ROWS: tl.constexpr, HEADS: tl.constexpr):
    """Return the rows of a program, whether they exist, their queries and their heads."""
    # 64-bit, because offsets are multiples of the row
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    return row, row < row_count, row // HEADS, row % HEADS


@triton.jit
@no_type_check
def neighbours(x, size):
    """Return the two cells beside a coordinate, as `vectors.neighbours`. Integers are cell centres."""
    x = tl.where(x > -2.0, x, -2.0)  # NaN becomes -2 too
    x = tl.where(x < size, x, size * 1.0)
    floor = tl.floor(x)
    part = x - floor
    low = floor.to(tl.int32)
    high = low + 1
    has_low = (low >= 0) & (low < size)
    has_high = (high >= 0) & (high < size)
    # Indices are clamped to stay in memory; the weights outside are zero
    return (
        tl.minimum(tl.maximum(low, 0), size - 1),
        tl.minimum(tl.maximum(high, 0), size - 1),
        tl.where(has_low, 1.0 - part, 0.0),
        tl.where(has_high, part, 0.0),
        tl.where(has_low, -1.0, 0.0),
        tl.where(has_high, 1.0, 0.0),
    )


@triton.jit
@no_type_check
def read(values, address, part, c, WIDTH: tl.constexpr):
    """Return Σ part · value over the points of a tile, rows × channels. Values with part 0 are not read."""
    needed = (part != 0)[:, :, None] & (c < WIDTH)[None, None, :]
    value = tl.load(values + address[:, :, None] + c[None, None, :], mask=needed, other=0.0)
    return tl.sum(part[:, :, None] * value.to(tl.float32), axis=1)


@triton.jit
@no_type_check
def read_back(
    values,
    grad_values,
    address,
    part,
    inside,
    grad,
    c,
    WIDTH: tl.constexpr,
    TO_VALUES: tl.constexpr,
    TO_POINTS: tl.constexpr,
):
    """Propagate the gradient of rows × channels to the cells of one corner.

    It adds part · grad to `grad_values` and returns the dot product of grad and value for every point.
    """
    place = address[:, :, None] + c[None, None, :]
    dot = tl.zeros(address.shape, tl.float32)
    # The dot product is needed also where the interpolation weight is 0: its slope may not be
    if TO_POINTS:
        value = tl.load(values + place, mask=inside[:, :, None] & (c < WIDTH)[None, None, :], other=0.0)
        dot = tl.sum(value.to(tl.float32) * grad[:, None, :], axis=2)
    if TO_VALUES:
        # Cells are shared between points and programs: atomic additions
        needed = (part != 0)[:, :, None] & (c < WIDTH)[None, None, :]
        tl.atomic_add(grad_values + place, part[:, :, None] * grad[:, None, :], mask=needed, sem="relaxed")
    return dot
