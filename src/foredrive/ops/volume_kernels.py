"""Numba kernels of `attend_volume`: weighted sums of trilinear samples.

Queries are processed in blocks of up to 256 points, head by head.
"""

from typing import NamedTuple, no_type_check

import numpy as np

from foredrive.ops.corners import BLOCK, new_block, sample_point, sample_point_backward, set_corners
from foredrive.ops.vectors import HALF, WIDTH, ZERO, kernel, kernel_part, load, neighbours, store, zeros8


class VolumeInputs(NamedTuple):
    """Inputs of the kernels."""

    values: np.ndarray
    """Float[b Z Y X D], features."""
    points: np.ndarray
    """Float[b Q H P 3], x y z in voxel units."""
    weights: np.ndarray
    """Float[b Q H P], weights."""


class VolumeGradients(NamedTuple):
    """Gradients with respect to the result and to the inputs of the same names."""

    out: np.ndarray
    values: np.ndarray
    points: np.ndarray
    """Float[b Q slots P 3], one slot per slice."""
    weights: np.ndarray
    """Float[b Q slots P], one slot per slice."""


class ChannelSlice(NamedTuple):
    """A range of channels of one head, and the slot for the gradients of its points."""

    head: int
    first_channel: int
    last_channel: int
    slot: int


@kernel_part
@no_type_check
def _fill_block(inputs, block, item, first, last, head):
    """Fill `block` with the points of the queries first … last - 1 of a batch item."""
    points = inputs.weights.shape[3]
    for q in range(first, last):
        i = (q - first) * points
        for p in range(points):
            for axis in range(3):
                # -½ makes integers the voxel centres
                block.place[axis * BLOCK + i + p] = inputs.points[item, q, head, p, axis] - HALF
            block.weight[i + p] = inputs.weights[item, q, head, p]
    _corners(block, (last - first) * points, inputs.values.shape)


@kernel_part
@no_type_check
def _corners(block, count, shape):
    """Fill `corner` and `part` of a block."""
    place = block.place
    depth, height, width = np.int32(shape[1]), np.int32(shape[2]), np.int32(shape[3])
    channels = np.int32(shape[4])
    for i in range(count):
        x, y, z = place[i], place[BLOCK + i], place[2 * BLOCK + i]
        x0, x1, wx0, wx1, _, _ = neighbours(x, width)
        y0, y1, wy0, wy1, _, _ = neighbours(y, height)
        z0, z1, wz0, wz1, _, _ = neighbours(z, depth)
        # NaN coordinates must give NaN, although `neighbours` treats them as outside.
        w = block.weight[i] if (x == x) & (y == y) & (z == z) else np.float32(np.nan)
        # Lower plane of four corners, then the upper one; rows are starts along x
        row0, row1 = (z0 * height + y0) * width, (z0 * height + y1) * width
        set_corners(block, i, w * wz0, row0, row1, x0, x1, wy0, wy1, wx0, wx1, channels)
        row0, row1 = (z1 * height + y0) * width, (z1 * height + y1) * width
        set_corners(block, 4 * BLOCK + i, w * wz1, row0, row1, x0, x1, wy0, wy1, wx0, wx1, channels)


@kernel_part
@no_type_check
def _read(inputs, block, item, first, last, channel, zero, out):
    """Write the samples of each query of a block, in the channels from `channel` on."""
    points, channels = inputs.weights.shape[3], inputs.values.shape[4]
    queries = out.shape[1]
    # Offset of the batch item's volume, in floats
    base = item * inputs.values[0].size + channel
    for q in range(first, last):
        total = zero
        i = (q - first) * points
        for p in range(i, i + points):
            total = sample_point(inputs.values, base, block, p, 8, total, zero)
        store(out, (item * queries + q) * channels + channel, total)


@kernel
@no_type_check
def read_queries(inputs, item, first_query, last_query, out):
    """Write the samples of queries first_query … last_query - 1 to `out`, Float[b Q D].

    Requires P ≤ BLOCK.
    """
    heads = inputs.weights.shape[2]
    width = inputs.values.shape[4] // heads
    # Channels are read in vectors of WIDTH, then the rest one by one.
    whole = width - width % WIDTH
    block, step = new_block(3), BLOCK // inputs.weights.shape[3]
    for first in range(first_query, last_query, step):
        last = min(first + step, last_query)
        for head in range(heads):
            _fill_block(inputs, block, item, first, last, head)
            start = head * width
            for c in range(start, start + whole, WIDTH):
                _read(inputs, block, item, first, last, c, zeros8(), out)
            for c in range(start + whole, start + width):
                _read(inputs, block, item, first, last, c, ZERO, out)


@kernel_part
@no_type_check
def _read_back(inputs, block, item, first, last, channel, zero, grads):
    """Add the gradient of the samples to the values and to `block.dots`."""
    points, channels = inputs.weights.shape[3], inputs.values.shape[4]
    queries = grads.out.shape[1]
    base = item * inputs.values[0].size + channel
    to_points = grads.points.size + grads.weights.size > 0
    for q in range(first, last):
        grad = load(grads.out, (item * queries + q) * channels + channel, zero)
        i = (q - first) * points
        for p in range(i, i + points):
            sample_point_backward(inputs.values, base, block, p, 8, grad, zero, grads.values, to_points)


@kernel_part
@no_type_check
def _slopes(block, count, shape):
    """Convert `dots` into gradients with respect to x, y, z and weight, in the first rows of `part`."""
    place, slope = block.place, block.part
    depth, height, width = np.int32(shape[1]), np.int32(shape[2]), np.int32(shape[3])
    for i in range(count):
        _, _, wx0, wx1, dx0, dx1 = neighbours(place[i], width)
        _, _, wy0, wy1, dy0, dy1 = neighbours(place[BLOCK + i], height)
        _, _, wz0, wz1, dz0, dz1 = neighbours(place[2 * BLOCK + i], depth)
        j = 8 * i
        # Dot products of the eight corners, numbered z y x
        d000, d001, d010, d011 = block.dots[j], block.dots[j + 1], block.dots[j + 2], block.dots[j + 3]
        d100, d101, d110, d111 = block.dots[j + 4], block.dots[j + 5], block.dots[j + 6], block.dots[j + 7]
        # Interpolate along x, then y, as the forward pass does
        d00, d01, d10, d11 = (
            wx0 * d000 + wx1 * d001,
            wx0 * d010 + wx1 * d011,
            wx0 * d100 + wx1 * d101,
            wx0 * d110 + wx1 * d111,
        )
        d0, d1 = wy0 * d00 + wy1 * d01, wy0 * d10 + wy1 * d11
        # For x, the derivative replaces the first interpolation
        along_x0 = wy0 * (dx0 * d000 + dx1 * d001) + wy1 * (dx0 * d010 + dx1 * d011)
        along_x1 = wy0 * (dx0 * d100 + dx1 * d101) + wy1 * (dx0 * d110 + dx1 * d111)
        w = block.weight[i]
        # Gradients by x, y, z, and the sample itself for the weight
        slope[i] = w * (wz0 * along_x0 + wz1 * along_x1)
        slope[BLOCK + i] = w * (wz0 * (dy0 * d00 + dy1 * d01) + wz1 * (dy0 * d10 + dy1 * d11))
        slope[2 * BLOCK + i] = w * (dz0 * d0 + dz1 * d1)
        slope[3 * BLOCK + i] = wz0 * d0 + wz1 * d1


@kernel_part
@no_type_check
def _scatter_gradients(inputs, block, item, first, last, slot, grads):
    """Write the gradients of a block's points. It overwrites `block.part`."""
    points = inputs.weights.shape[3]
    slope = block.part
    _slopes(block, (last - first) * points, inputs.values.shape)
    for q in range(first, last):
        i = (q - first) * points
        for p in range(points):
            if grads.points.size > 0:
                for axis in range(3):
                    grads.points[item, q, slot, p, axis] = slope[axis * BLOCK + i + p]
            if grads.weights.size > 0:
                grads.weights[item, q, slot, p] = slope[3 * BLOCK + i + p]


@kernel
@no_type_check
def read_back(inputs, item, part, grads):
    """Add the gradients of the values for one channel slice of a batch item, and write those of its points.

    Slices use disjoint channels and slots, and batch items use disjoint volumes. So calls that differ in
    slice or item can run in parallel. Gradients that are not wanted have size 0.
    """
    width = part.last_channel - part.first_channel
    whole = part.first_channel + width - width % WIDTH
    block, step = new_block(3), BLOCK // inputs.weights.shape[3]
    queries = inputs.weights.shape[1]
    for first in range(0, queries, step):
        last = min(first + step, queries)
        _fill_block(inputs, block, item, first, last, part.head)
        block.dots[:] = 0
        # Vectors of eight channels, then single channels; all add to the same dots
        for c in range(part.first_channel, whole, WIDTH):
            _read_back(inputs, block, item, first, last, c, zeros8(), grads)
        for c in range(whole, part.last_channel):
            _read_back(inputs, block, item, first, last, c, ZERO, grads)
        if grads.points.size + grads.weights.size > 0:
            _scatter_gradients(inputs, block, item, first, last, part.slot, grads)
