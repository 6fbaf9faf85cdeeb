"""Outlines: pixels for which one ray is not enough, and the results that their additional rays can reuse."""

from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float32

from foredrive.towns.sensing.shading import MISS

CREASE_COS = 0.8
CONTRAST = 12
"""Contrast of 255 below which an edge need not be smooth."""

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")


class ShadedPixels(NamedTuple):
    """The results of the central rays of P pixels."""

    radiance: Float32[np.ndarray, "P 3"]
    normal: Float32[np.ndarray, "P 3"]
    lit: Bool[np.ndarray, "P"]
    """Whether the sun shines there."""


@_kernel
@no_type_check
def outlines(buffer, centre, rgb, shape):
    """Return which pixels [C·H·W] lie on a visible edge: of an object, of a shadow, or at a bend of a
    surface.

    Args:
        buffer: material and actor of each pixel.
        centre: `ShadedPixels`.
        rgb: [C·H·W 3] 8-bit colours.
        shape: C, H, W.
    """
    cameras, height, width = shape
    out = np.zeros(cameras * height * width, np.bool_)
    for i in range(len(out)):
        # Compare with the pixel to the right and the pixel below, within the image
        for step in (1, width):
            j = i + step
            inside = (i % width) + 1 < width if step == 1 else (i // width) % height + 1 < height
            if not inside:
                continue
            # An edge of an object or a material; else an edge of a shadow or a bend
            edge = buffer.material[i] != buffer.material[j] or buffer.actor[i] != buffer.actor[j]
            if not edge and buffer.material[i] != MISS:
                edge = centre.lit[i] != centre.lit[j] or _bends(centre.normal, i, centre.normal, j)
            # Only edges with a visible contrast need more rays
            if edge:
                for c in range(3):
                    if abs(np.int32(rgb[i, c]) - np.int32(rgb[j, c])) > CONTRAST:
                        out[i] = out[j] = True
    return out


@_kernel
@no_type_check
def same_as_centre(pixels, samples, surfaces, actor, lit, buffer, centre):
    """Return the radiance [n·samples 3] of rays that find the same as their pixel's central ray, -1 for
    others.

    Textures are filtered over the pixel already, so only rays with another result need to be shaded.

    Args:
        pixels: [n], with `samples` rays for each.
        surfaces: the `Surfaces` of the rays; `actor` and `lit` likewise.
    """
    out = np.full((len(pixels) * samples, 3), np.float32(-1.0))
    for i in range(len(out)):
        pixel = pixels[i // samples]
        # The same material, actor, light and direction of the surface give the same radiance
        same = surfaces.material[i] == buffer.material[pixel] and actor[i] == buffer.actor[pixel]
        if same and surfaces.material[i] != MISS:
            same = lit[i] == centre.lit[pixel] and not _bends(surfaces.normal, i, centre.normal, pixel)
        if same:
            for c in range(3):  # an assignment of rows takes seconds to compile
                out[i, c] = centre.radiance[pixel, c]
    return out


@_kernel
@no_type_check
def _bends(a, i, b, j):
    return a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2] < CREASE_COS
