"""Patterns of which procedural textures consist, filtered over the footprint of a pixel.

There are bands, whose share of the footprint has a closed form, and value noise. The noise fades out as the
footprint grows, so that distant surfaces do not flicker.
"""

import math
from typing import no_type_check

import numba
import numpy as np

TEXTURED = 6
TEXTURE_WORDS = TEXTURED + 4
"""Number of elements of the array that a texture writes."""

_TABLE_BITS = 12
_TABLE_MASK = (1 << _TABLE_BITS) - 1
_NOISE = np.random.default_rng(20).random(1 << _TABLE_BITS).astype(np.float32)
"""Random numbers to which lattice points are hashed."""

_OPTIONS = {"error_model": "numpy", "fastmath": True, "forceinline": True}
kernel_part = numba.njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **_OPTIONS)
"""Decorator of functions that only kernels call, inlined. They compile faster; Python cannot call them."""
_kernel = numba.njit(cache=True, nogil=True, **_OPTIONS)
# With signatures: otherwise numba compiles a version for each constant that is passed as seed
_kernel_of_points = numba.njit("float32(int64, int64, int64)", cache=True, nogil=True, **_OPTIONS)
_kernel_of_footprints = numba.njit(
    [f"float64({x}, {x}, {x}, int64)" for x in ("float64", "float32")], cache=True, nogil=True, **_OPTIONS
)


@_kernel_of_points
@no_type_check
def lattice(ix: int, iy: int, seed: int) -> float:
    """Return a random number in 0..1 for a lattice point."""
    # Integer hash of the lattice point; the table is a power of two
    h = ix * 73856093 ^ iy * 19349663 ^ seed * 83492791
    h ^= (h >> 15) & 0x1FFFF
    h *= 668265263
    return _NOISE[(h >> 13) & _TABLE_MASK]


@_kernel_of_footprints
@no_type_check
def noise(x: float, y: float, footprint: float, seed: int) -> float:
    """Return value noise of wavelength 1 in -1..1, or 0 where the footprint (in the unit of x) blurs it
    away."""
    fade = 1.0 - footprint
    if fade <= 0.0:
        return 0.0
    fx, fy = math.floor(x), math.floor(y)
    ix, iy = int(fx), int(fy)
    tx, ty = x - fx, y - fy
    # Smoothstep weights: no visible lattice in the derivative
    tx, ty = tx * tx * (3.0 - 2.0 * tx), ty * ty * (3.0 - 2.0 * ty)
    # Bilinear interpolation of the four lattice values
    a = lattice(ix, iy, seed) * (1.0 - tx) + lattice(ix + 1, iy, seed) * tx
    b = lattice(ix, iy + 1, seed) * (1.0 - tx) + lattice(ix + 1, iy + 1, seed) * tx
    return fade * (2.0 * (a * (1.0 - ty) + b * ty) - 1.0)


@_kernel
@no_type_check
def band(x: float, low: float, high: float, footprint: float) -> float:
    """Return the share of the footprint around x that lies between low and high."""
    # The small number keeps the width of a point footprint positive
    half = 0.5 * footprint + 1e-4
    return max(0.0, min(high, x + half) - max(low, x - half)) / (2.0 * half)


@_kernel
@no_type_check
def bands(x: float, period: float, width: float, footprint: float) -> float:
    """Return the share of the footprint around x that lies in [k·period, k·period + width] for any k."""
    half = 0.5 * footprint + 1e-4
    a, b = x - half, x + half
    ka, kb = math.floor(a / period), math.floor(b / period)
    # Whole periods between the ends, plus the parts at either end
    inside = (kb - ka) * width + min(b - kb * period, width) - min(a - ka * period, width)
    return inside / (2.0 * half)
