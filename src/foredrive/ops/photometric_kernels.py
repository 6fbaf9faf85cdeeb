"""Numba kernels of `photometric_loss`: the loss and its gradient in four passes over rows.

Images have mirrored borders: place p outside [0, n) is place -p or 2 (n - 1) - p. The window is separable:
`local_means` filters along rows, `compare` along columns, and the adjoints follow in reverse. Each filter is
a weighted sum of rows of numbers, see `_add_rows`.
"""

from typing import NamedTuple, no_type_check

import numpy as np

from foredrive.ops.vectors import (
    ONE,
    ROW,
    ZERO,
    broadcast,
    inlined_part,
    kernel,
    kernel_part,
    load_row,
    store,
)

TWO = np.float32(2)
MOMENTS, SLOPES = 5, 3
"""Filtered numbers: of a, b, a², b² and ab; derivatives of SSIM by the means of a, a² and ab."""


class ImagePair(NamedTuple):
    """Two images and the window, and what the passes leave for each other. P is W, rounded up to `ROW`."""

    a: np.ndarray
    """Float[C H W], the rendered image."""
    b: np.ndarray
    """Float[C H W], the real one."""
    window: np.ndarray
    """Float[K], normalised weights, K odd."""
    moments: np.ndarray
    """Float[C 5 H P], filtered along rows by `local_means`."""
    slopes: np.ndarray
    """Float[C 3 H P], of SSIM by local means, from `compare`."""
    similarity: np.ndarray
    """Float64[C H], sums of SSIM over rows."""
    difference: np.ndarray
    """Float64[C H], sums of |a - b| over rows."""


def padded(width: int) -> int:
    """Return the width of rows that are a whole number of vectors."""
    return -(-width // ROW) * ROW


@kernel_part
@no_type_check
def _mirrored(place, count):
    if place < 0:
        return -place
    return 2 * (count - 1) - place if place >= count else place


@inlined_part
@no_type_check
def _add_rows(values, starts, weights, taps, out, first, width):
    """Set out[first + x] to the sum over k of weights[k] · values[starts[k] + x], in whole vectors.

    Args:
        values, out: contiguous arrays, with flat indices.
        starts: Int[>= taps].
        weights: Float[>= taps].
    """
    for x in range(0, width, ROW):
        total = broadcast(ZERO)
        for k in range(taps):
            total = total + load_row(values, starts[k] + x) * broadcast(weights[k])
        store(out, first + x, total)


@kernel
@no_type_check
def local_means(pair, start, stop):
    """Filter a, b, a², b² and ab along the rows start … stop - 1 of all channels, one after the other."""
    height, width, across = pair.a.shape[1], pair.a.shape[2], pair.moments.shape[3]
    taps = len(pair.window)
    half = taps // 2
    longer = across + 2 * half
    row, starts = np.zeros((MOMENTS, longer), np.float32), np.empty(taps, np.int64)
    for line in range(start, stop):
        channel, y = line // height, line % height
        for p in range(width + 2 * half):
            x = _mirrored(p - half, width)
            a, b = pair.a[channel, y, x], pair.b[channel, y, x]
            row[0, p], row[1, p], row[2, p], row[3, p], row[4, p] = a, b, a * a, b * b, a * b
        for moment in range(MOMENTS):
            for k in range(taps):
                starts[k] = moment * longer + k
            place = ((channel * MOMENTS + moment) * height + y) * across
            _add_rows(row, starts, pair.window, taps, pair.moments, place, across)


@kernel
@no_type_check
def compare(pair, c1, c2, start, stop):
    """Compute SSIM of rows from `moments`, its sum, and its derivatives by the local means."""
    height, width, across = pair.a.shape[1], pair.a.shape[2], pair.moments.shape[3]
    taps = len(pair.window)
    local, starts = np.empty((MOMENTS, across), np.float32), np.empty(taps, np.int64)
    ssim, apart = np.empty(across, np.float32), np.empty(width, np.float32)
    for line in range(start, stop):
        channel, y = line // height, line % height
        # The window along the column
        for moment in range(MOMENTS):
            for k in range(taps):
                read = _mirrored(y + k - taps // 2, height)
                starts[k] = ((channel * MOMENTS + moment) * height + read) * across
            _add_rows(pair.moments, starts, pair.window, taps, local, moment * across, across)
        place = (channel * SLOPES * height + y) * across
        _slopes(local, c1, c2, pair.slopes, place, height * across, ssim)
        a, b = pair.a[channel, y], pair.b[channel, y]
        for x in range(width):
            apart[x] = abs(a[x] - b[x])
        similar, different = 0.0, 0.0
        for x in range(width):
            similar += ssim[x]
            different += apart[x]
        pair.similarity[channel, y], pair.difference[channel, y] = similar, different


@inlined_part
@no_type_check
def _slopes(local, c1, c2, slopes, first, step, ssim):
    """Compute SSIM (Wang et al., 2004, eq. 13) and its derivatives by the local means of a, a² and ab.

    Args:
        first, step: flat index in `slopes` of the first derivative, and from one derivative to the next.
    """
    across = local.shape[1]
    for x in range(0, across, ROW):
        a, b = load_row(local, x), load_row(local, across + x)
        var_a, var_b = load_row(local, 2 * across + x) - a * a, load_row(local, 3 * across + x) - b * b
        cov = load_row(local, 4 * across + x) - a * b
        up_mean, up_var = TWO * a * b + c1, TWO * cov + c2
        by_mean, by_var = ONE / (a * a + b * b + c1), ONE / (var_a + var_b + c2)
        share = by_mean * by_var
        similarity = up_mean * up_var * share
        # Variances contain the mean of a too
        of_a = TWO * (b * (up_var - up_mean) * share + similarity * a * (by_var - by_mean))
        store(slopes, first + x, of_a)
        store(slopes, first + step + x, ZERO - similarity * by_var)
        store(slopes, first + 2 * step + x, TWO * up_mean * share)
        store(ssim, x, similarity)


@kernel
@no_type_check
def spread_columns(pair, start, stop):
    """Apply the adjoint of the window along columns to `slopes`, into the first of `moments`."""
    height, across = pair.a.shape[1], pair.moments.shape[3]
    taps = len(pair.window)
    half = taps // 2
    starts, weights = np.empty(3 * taps, np.int64), np.empty(3 * taps, np.float32)
    for line in range(start, stop):
        channel, y = line // height, line % height
        for slope in range(SLOPES):
            count, first = 0, (channel * SLOPES + slope) * height
            # A row is read at its own place and at its images beyond the borders
            for image in range(3):
                place = y if image == 0 else -y if image == 1 else 2 * (height - 1) - y
                if image > 0 and (0 <= place < height or place < -half or place >= height + half):
                    continue
                for k in range(taps):
                    reader = place - k + half
                    if 0 <= reader < height:
                        starts[count], weights[count] = (first + reader) * across, pair.window[k]
                        count += 1
            place = ((channel * MOMENTS + slope) * height + y) * across
            _add_rows(pair.slopes, starts, weights, count, pair.moments, place, across)


@kernel
@no_type_check
def image_gradient(pair, of_difference, of_similarity, out, start, stop):
    """Compute the gradient of rows of a: the adjoint along rows, then of a, a² and ab.

    Args:
        of_difference, of_similarity: derivatives of the loss by |a - b| and SSIM of a pixel.
        out: Float[C H W].
    """
    height, width, across = pair.a.shape[1], pair.a.shape[2], pair.moments.shape[3]
    taps = len(pair.window)
    half = taps // 2
    longer = across + -(-2 * half // ROW) * ROW
    # Zeros on both sides: each place of the longer row gathers what was read from it
    row, starts = np.zeros(longer + 2 * taps, np.float32), np.empty(taps, np.int64)
    spread = np.empty((SLOPES, longer), np.float32)
    for k in range(taps):
        starts[k] = 2 * half - k
    for line in range(start, stop):
        channel, y = line // height, line % height
        for slope in range(SLOPES):
            for x in range(width):
                row[2 * half + x] = pair.moments[channel, slope, y, x]
            _add_rows(row, starts, pair.window, taps, spread, slope * longer, longer)
            # What lies beyond the borders belongs to its mirror image
            of_slope = spread[slope]
            for p in range(half):
                of_slope[2 * half - p] += of_slope[p]
                of_slope[width - 1 + p] += of_slope[width + 2 * half - 1 - p]
        a, b, gradient = pair.a[channel, y], pair.b[channel, y], out[channel, y]
        for x in range(width):
            p = x + half
            by_ssim = spread[0, p] + TWO * a[x] * spread[1, p] + b[x] * spread[2, p]
            sign = ONE if a[x] > b[x] else -ONE if a[x] < b[x] else ZERO
            gradient[x] = of_difference * sign + of_similarity * by_ssim
