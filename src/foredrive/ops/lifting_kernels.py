"""Numba kernels of `foredrive.ops.lifting`: sampling of all levels for visible pairs, and its gradients.

A pair is a query and a camera that sees it. Pairs are processed in blocks of up to 256 points, head by head
and, within a block, level by level.
"""

from typing import NamedTuple, no_type_check

import numpy as np

from foredrive.ops.corners import BLOCK, Block, new_block, sample_point, sample_point_backward, set_corners
from foredrive.ops.vectors import HALF, WIDTH, ZERO, kernel, kernel_part, load, neighbours, store, zeros8


class LiftingInputs(NamedTuple):
    """Inputs of the kernels. Pairs are sorted by query."""

    values: np.ndarray
    """Float[b·C S D], pixels of all levels one after the other."""
    sizes: np.ndarray
    """Int32[L 3], height, width and first pixel of each level."""
    offsets: np.ndarray
    """Float[b·Q H L P 2], sampling offsets in pixels."""
    weights: np.ndarray
    """Float[b·Q H L P], attention weights."""
    query: np.ndarray
    """Int64[pairs], index into b·Q."""
    image: np.ndarray
    """Int64[pairs], index into b·C."""
    uv: np.ndarray
    """Float[pairs 2], position in the image relative to its size."""
    share: np.ndarray
    """Float[pairs], 1 / number of cameras that see the query."""


class LiftingGradients(NamedTuple):
    """Gradients with respect to the result and to the inputs of the same names."""

    out: np.ndarray
    values: np.ndarray
    offsets: np.ndarray
    weights: np.ndarray


@kernel_part
@no_type_check
def _level(block, start):
    """Return the views of the buffers from the first point of a level on."""
    place, weight = block.place[start:], block.weight[start:]
    return Block(place, weight, block.corner[start:], block.part[start:], block.dots[4 * start :])


@kernel_part
@no_type_check
def _fill_block(inputs, block, first, last, head):
    """Fill `block` with the points of pairs first … last - 1, sorted by level, then by pair."""
    levels, points = inputs.weights.shape[2:]
    count = (last - first) * points
    # Points are sorted by level, then pair: so each level's corners are found in one loop
    for pair in range(first, last):
        q, share = inputs.query[pair], inputs.share[pair]
        for level in range(levels):
            # Position of the query in pixels of the level; -½ makes integers the pixel centres
            u = inputs.uv[pair, 0] * np.float32(inputs.sizes[level, 1]) - HALF
            v = inputs.uv[pair, 1] * np.float32(inputs.sizes[level, 0]) - HALF
            i = level * count + (pair - first) * points
            for p in range(points):
                block.place[i + p] = u + inputs.offsets[q, head, level, p, 0]
                block.place[BLOCK + i + p] = v + inputs.offsets[q, head, level, p, 1]
                # The weight includes the share of the camera in the mean
                block.weight[i + p] = inputs.weights[q, head, level, p] * share
    for level in range(levels):
        _corners(_level(block, level * count), count, inputs.sizes[level], np.int32(inputs.values.shape[2]))


@kernel_part
@no_type_check
def _corners(block, count, size, channels):
    """Fill `corner` and `part` for one level."""
    height, width, start = size
    for i in range(count):
        # Bilinear neighbours within the level; `start` is the level's first pixel
        x, y = block.place[i], block.place[BLOCK + i]
        x0, x1, wx0, wx1, _, _ = neighbours(x, width)
        y0, y1, wy0, wy1, _, _ = neighbours(y, height)
        # NaN coordinates must give NaN, although `neighbours` treats them as outside.
        w = block.weight[i] if (x == x) & (y == y) else np.float32(np.nan)
        set_corners(block, i, w, start + y0 * width, start + y1 * width, x0, x1, wy0, wy1, wx0, wx1, channels)


@kernel_part
@no_type_check
def _read(inputs, block, first, last, channel, zero, out):
    """Add the samples of each pair of a block to `out`, in the channels from `channel` on."""
    levels, points = inputs.weights.shape[2:]
    pixels, channels = inputs.values.shape[1:]
    for pair in range(first, last):
        # Offset of the camera's image and of the query's result, in floats
        base = inputs.image[pair] * pixels * channels + channel
        place = inputs.query[pair] * channels + channel
        total = load(out, place, zero)
        for level in range(levels):
            i = (level * (last - first) + pair - first) * points
            for p in range(i, i + points):
                total = sample_point(inputs.values, base, block, p, 4, total, zero)
        store(out, place, total)


@kernel
@no_type_check
def lift_pairs(inputs, first_pair, last_pair, out):
    """Add the samples of pairs first_pair … last_pair - 1 to `out`, Float[b·Q D]. Requires L·P ≤ BLOCK."""
    heads, width = inputs.weights.shape[1], inputs.values.shape[2] // inputs.weights.shape[1]
    # Channels are read in vectors of WIDTH, then the rest one by one.
    whole = width - width % WIDTH
    block, step = new_block(2), BLOCK // (inputs.weights.shape[2] * inputs.weights.shape[3])
    for first in range(first_pair, last_pair, step):
        # Blocks have whole pairs, all levels and points of one head
        last = min(first + step, last_pair)
        for head in range(heads):
            _fill_block(inputs, block, first, last, head)
            start = head * width
            for c in range(start, start + whole, WIDTH):
                _read(inputs, block, first, last, c, zeros8(), out)
            for c in range(start + whole, start + width):
                _read(inputs, block, first, last, c, ZERO, out)


@kernel_part
@no_type_check
def _read_back(inputs, block, first, last, channel, zero, grads):
    """Add the gradient of the samples to the values and to `block.dots`."""
    levels, points = inputs.weights.shape[2:]
    pixels, channels = inputs.values.shape[1:]
    # The gradient of a pair's result is that of its query; the camera's share is in the weights
    for pair in range(first, last):
        base = inputs.image[pair] * pixels * channels + channel
        grad = load(grads.out, inputs.query[pair] * channels + channel, zero)
        for level in range(levels):
            i = (level * (last - first) + pair - first) * points
            for p in range(i, i + points):
                sample_point_backward(
                    inputs.values, base, block, p, 4, grad, zero, grads.values, grads.weights.size > 0
                )


@kernel_part
@no_type_check
def _slopes(block, count, size):
    """Convert `dots` into gradients with respect to x, y and weight, in the first rows of `part`."""
    height, width, _ = size
    dots, slope = block.dots, block.part
    for i in range(count):
        _, _, wx0, wx1, dx0, dx1 = neighbours(block.place[i], width)
        _, _, wy0, wy1, dy0, dy1 = neighbours(block.place[BLOCK + i], height)
        # Dot products of the four corners, row by row of pixels: d00 d01 / d10 d11
        d00, d01, d10, d11 = dots[4 * i], dots[4 * i + 1], dots[4 * i + 2], dots[4 * i + 3]
        w = block.weight[i]
        # Derivatives of the bilinear weights by x and y, and the sample itself for the weight
        slope[i] = w * (wy0 * (dx0 * d00 + dx1 * d01) + wy1 * (dx0 * d10 + dx1 * d11))
        slope[BLOCK + i] = w * (wx0 * (dy0 * d00 + dy1 * d10) + wx1 * (dy0 * d01 + dy1 * d11))
        slope[2 * BLOCK + i] = wy0 * (wx0 * d00 + wx1 * d01) + wy1 * (wx0 * d10 + wx1 * d11)


@kernel_part
@no_type_check
def _scatter_gradients(inputs, block, first, last, head, grads):
    """Add the gradients of a block's points to those of their queries. It overwrites `block.part`."""
    levels, points = inputs.weights.shape[2:]
    count = (last - first) * points
    for level in range(levels):
        _slopes(_level(block, level * count), count, inputs.sizes[level])
    # A query has one pair for each camera, so its gradients add up
    for pair in range(first, last):
        q, share = inputs.query[pair], inputs.share[pair]
        for level in range(levels):
            i = level * count + (pair - first) * points
            for p in range(points):
                grads.offsets[q, head, level, p, 0] += block.part[i + p]
                grads.offsets[q, head, level, p, 1] += block.part[BLOCK + i + p]
                grads.weights[q, head, level, p] += block.part[2 * BLOCK + i + p] * share


@kernel
@no_type_check
def lift_pairs_backward(inputs, first_pair, last_pair, head, grads):
    """Add the gradients of one head for the pairs first_pair … last_pair - 1.

    Heads use disjoint channels of the values and disjoint offsets and weights. Batch items use disjoint
    images. So calls that differ in head or item can run in parallel. Gradients that are not wanted
    have size 0 (offsets and weights: both or none).
    """
    width = inputs.values.shape[2] // inputs.weights.shape[1]
    start = head * width
    whole = width - width % WIDTH
    block, step = new_block(2), BLOCK // (inputs.weights.shape[2] * inputs.weights.shape[3])
    for first in range(first_pair, last_pair, step):
        last = min(first + step, last_pair)
        _fill_block(inputs, block, first, last, head)
        block.dots[:] = 0
        for c in range(start, start + whole, WIDTH):
            _read_back(inputs, block, first, last, c, zeros8(), grads)
        for c in range(start + whole, start + width):
            _read_back(inputs, block, first, last, c, ZERO, grads)
        if grads.weights.size > 0:
            _scatter_gradients(inputs, block, first, last, head, grads)
