"""Procedural textures, filtered over the footprint of a pixel so that what is far away does not sparkle.

Every pattern is made of bands whose share of the footprint is known in closed form, and of value noise that
fades out as the footprint outgrows it. Compiled by numba, called once for each hit.
"""

import math
from typing import no_type_check

import numba
import numpy as np

from foredrive.towns.looks import LinePattern, Texture

_TABLE_BITS = 12
_TABLE_MASK = (1 << _TABLE_BITS) - 1
_NOISE = np.random.default_rng(20).random(1 << _TABLE_BITS).astype(np.float32)
"""Random numbers that lattice points are hashed to."""

DASH_PERIOD_M, DASH_M = 9.0, 3.0
DOUBLE_LINE_GAP_M = 0.12
WHITE_PAINT, YELLOW_PAINT = (0.72, 0.72, 0.70), (0.66, 0.42, 0.04)
PAINT_REFLECTIVITY = 0.75
GLASS_RGB = (0.045, 0.06, 0.075)

_ROAD, _SLABS, _GRASS = int(Texture.ROAD), int(Texture.SLABS), int(Texture.GRASS)
_FACADE, _TILES, _FOLIAGE = int(Texture.FACADE), int(Texture.TILES), int(Texture.FOLIAGE)
_STRIPES, _GLASS = int(Texture.STRIPES), int(Texture.GLASS)
_LINE_NONE, _LINE_BROKEN = int(LinePattern.NONE), int(LinePattern.BROKEN)
_LINE_DOUBLE, _LINE_DOUBLE_BROKEN = int(LinePattern.DOUBLE_SOLID), int(LinePattern.DOUBLE_BROKEN)

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)


@_kernel
@no_type_check
def lattice(ix: int, iy: int, seed: int) -> float:
    """A random number in 0..1 for a lattice point."""
    h = ix * 73856093 ^ iy * 19349663 ^ seed * 83492791
    h ^= (h >> 15) & 0x1FFFF
    h *= 668265263
    return _NOISE[(h >> 13) & _TABLE_MASK]


@_kernel
@no_type_check
def noise(x: float, y: float, footprint: float, seed: int) -> float:
    """Value noise of wavelength 1 in -1..1, 0 where the footprint (same unit as x) blurs it away."""
    fade = 1.0 - footprint
    if fade <= 0.0:
        return 0.0
    fx, fy = math.floor(x), math.floor(y)
    ix, iy = int(fx), int(fy)
    tx, ty = x - fx, y - fy
    tx, ty = tx * tx * (3.0 - 2.0 * tx), ty * ty * (3.0 - 2.0 * ty)
    a = lattice(ix, iy, seed) * (1.0 - tx) + lattice(ix + 1, iy, seed) * tx
    b = lattice(ix, iy + 1, seed) * (1.0 - tx) + lattice(ix + 1, iy + 1, seed) * tx
    return fade * (2.0 * (a * (1.0 - ty) + b * ty) - 1.0)


@_kernel
@no_type_check
def band(x: float, low: float, high: float, footprint: float) -> float:
    """Share of the footprint about x that lies between low and high."""
    half = 0.5 * footprint + 1e-4
    return max(0.0, min(high, x + half) - max(low, x - half)) / (2.0 * half)


@_kernel
@no_type_check
def bands(x: float, period: float, width: float, footprint: float) -> float:
    """Share of the footprint about x that lies in [k·period, k·period + width] for any k."""
    half = 0.5 * footprint + 1e-4
    a, b = x - half, x + half
    ka, kb = math.floor(a / period), math.floor(b / period)
    inside = (kb - ka) * width + min(b - kb * period, width) - min(a - ka * period, width)
    return inside / (2.0 * half)


@_kernel
@no_type_check
def _line(distance: float, along: float, du: float, dw: float, pattern: int, width: float) -> float:
    """Share of the footprint that is painted, at a distance from the border it follows."""
    if pattern == _LINE_NONE:
        return 0.0
    if pattern >= _LINE_DOUBLE:
        low = 0.5 * DOUBLE_LINE_GAP_M
        share = band(distance, low, low + width, du)
    else:
        share = band(distance, -1.0, 0.5 * width, du)
    if pattern in (_LINE_BROKEN, _LINE_DOUBLE_BROKEN):
        share *= bands(along, DASH_PERIOD_M, DASH_M, dw)
    return share


@_kernel
@no_type_check
def _road(p, xyz, uvw, size, duvw):
    """Asphalt: grain, wear along the wheel tracks, patches, lines."""
    x, y = xyz[0], xyz[1]
    shade = (
        1.0 + 0.10 * noise(x / 11.0, y / 11.0, size / 11.0, 1) + 0.08 * noise(x / 2.3, y / 2.3, size / 2.3, 2)
    )
    shade += 0.10 * noise(x * 4.0, y * 4.0, size * 4.0, 3)
    if lattice(math.floor(x / 9.0), math.floor(y / 6.0), 4) > 0.9:
        shade *= 0.82
    width = uvw[0] + uvw[1]
    if 2.5 < width < 5.0:
        track = abs(abs(0.5 * (uvw[0] - uvw[1])) - 0.85)
        shade *= 1.0 - 0.10 * math.exp(-8.0 * track * track)
    r = g = b = shade
    paint = 0.0
    for side in range(2):
        pattern = int(p[3 * side])
        share = _line(uvw[side], uvw[2], duvw[side], duvw[2], pattern, p[3 * side + 2])
        share *= 0.92 + 0.08 * noise(x * 3.0, y * 3.0, size * 3.0, 5)
        if share > paint:
            paint = share
            yellow = p[3 * side + 1] > 0.5
    if paint > 0.0:
        colour = YELLOW_PAINT if yellow else WHITE_PAINT
        return r, g, b, paint, colour[0], colour[1], colour[2]
    return r, g, b, 0.0, 0.0, 0.0, 0.0


@_kernel
@no_type_check
def _windows(p, uvw, duvw):
    """Shares of a façade's footprint that are glass and frame, and the number of the window."""
    length = uvw[0] + uvw[2]
    usable = length - 0.8
    if usable < 0.7 * p[1]:
        return 0.0, 0.0, 0
    count = max(1.0, math.floor(usable / p[1] + 0.3))
    bay = usable / count
    x, v = uvw[0] - 0.4, uvw[1]
    column = min(max(math.floor(x / bay), 0.0), count - 1.0)
    x_in = x - column * bay
    wide, high = p[2] * bay, p[3] * p[0]
    if v < p[4]:
        row, y_in = 0.0, v
        door = lattice(int(column), int(length * 10.0), 11) > 0.72
        low = 0.05 if door else 0.55
        wide, high = (1.3 if door else max(wide, 0.72 * bay)), p[4] - 0.75 - low
    else:
        row = math.floor((v - p[4]) / p[0]) + 1.0
        y_in = v - p[4] - (row - 1.0) * p[0]
        low = 0.5 * (p[0] - high) + 0.12
    if 0.5 * (duvw[0] + duvw[2]) > bay or duvw[1] > p[0]:  # whole windows blur together
        share = p[2] * p[3]
        return 0.85 * share, 0.15 * share, 0
    left = 0.5 * (bay - wide)
    pane = band(x_in, left, left + wide, duvw[0]) * band(y_in, low, low + high, duvw[1])
    rim = 0.07
    glass = band(x_in, left + rim, left + wide - rim, duvw[0])
    glass *= band(y_in, low + rim, low + high - rim, duvw[1])
    glass -= glass * band(x_in, left + 0.5 * wide - 0.03, left + 0.5 * wide + 0.03, duvw[0])
    return glass, pane - glass, int(row * 131.0 + column)


@_kernel
@no_type_check
def _facade(p, xyz, uvw, duvw, seed):
    """Wall, frames and panes: tint of the wall, then share of glass, share of frame, brightness behind."""
    u, v = uvw[0] + 0.37 * xyz[0] - 0.37 * xyz[1], uvw[1]
    wall = (
        1.0
        + 0.07 * noise(u / 3.0, v / 3.0, duvw[0] / 3.0, 6)
        + 0.05 * noise(u * 2.0, v * 2.0, duvw[0] * 2.0, 7)
    )
    wall *= 0.86 + 0.14 * min(1.0, v / 1.2)
    if p[5] > 0.5:
        course = math.floor(v / 0.15)
        mortar = bands(v, 0.15, 0.02, duvw[1])
        mortar += (1.0 - mortar) * bands(uvw[0] + 0.15 * (course % 2.0), 0.3, 0.02, duvw[0])
        fade = max(0.0, 1.0 - duvw[0] / 0.4)
        brick = lattice(math.floor((uvw[0] + 0.15 * (course % 2.0)) / 0.3), int(course), 8) - 0.5
        wall *= 1.0 + 0.35 * (mortar - 0.19) * fade + 0.3 * brick * fade
    ledge = band(v, p[4] - 0.12, p[4] + 0.12, duvw[1])
    wall *= 1.0 + 0.25 * ledge
    glass, frame, number = _windows(p, uvw, duvw)
    return wall, glass, frame, lattice(number, seed, 9)


@_kernel
@no_type_check
def texture(kind, p, albedo, xyz, uvw, size, duvw, seed, out):
    """Evaluate a look at a hit.

    Args:
        kind, p, albedo: of the look.
        xyz, uvw: position and texture coordinates of the hit.
        size: width of the pixel's footprint on the surface, m.
        duvw: its extent in texture coordinates.
        seed: tells things of the same look apart.
        out: filled with red, green, blue (linear), share of glass, share of paint.
    """
    x, y, z = xyz[0], xyz[1], xyz[2]
    r = g = b = 1.0
    glass = paint = 0.0
    out[0], out[1], out[2] = albedo[0], albedo[1], albedo[2]
    if kind == _ROAD:
        r, g, b, paint, pr, pg, pb = _road(p, xyz, uvw, size, duvw)
        out[0] = albedo[0] * r * (1.0 - paint) + pr * paint
        out[1] = albedo[1] * g * (1.0 - paint) + pg * paint
        out[2] = albedo[2] * b * (1.0 - paint) + pb * paint
        r = g = b = 1.0
    elif kind == _FACADE:
        r, glass, frame, inside = _facade(p, xyz, uvw, duvw, seed)
        wall = 1.0 - glass - frame
        light = 0.25 + 1.5 * inside if inside > 0.75 else 1.0
        for c in range(3):
            out[c] = albedo[c] * r * wall + 0.5 * frame + GLASS_RGB[c] * light * glass
        r = 1.0
    elif kind == _GRASS:
        wide = noise(x / 23.0, y / 23.0, size / 23.0, 21)
        fine = noise(x * 1.7, y * 1.7, size * 1.7, 22) + 0.6 * noise(x * 6.0, y * 6.0, size * 6.0, 23)
        dry = 0.5 + 0.5 * noise(x / 5.0, y / 5.0, size / 5.0, 24) + 0.3 * wide
        shade = 1.0 + 0.16 * fine + 0.12 * wide
        r, g, b = shade * (0.8 + 0.5 * dry), shade * (0.95 + 0.12 * dry), shade * (0.8 + 0.3 * dry)
    elif kind == _SLABS:
        joint = bands(x, p[0], 0.025, size) + bands(y, p[0], 0.025, size)
        slab = lattice(math.floor(x / p[0]), math.floor(y / p[0]), 31) - 0.5
        fade = max(0.0, 1.0 - size / p[0])
        r = 1.0 - 0.35 * min(joint, 1.0) + 0.14 * slab * fade
        r += 0.06 * noise(x / 4.0, y / 4.0, size / 4.0, 32)
        g = b = r
    elif kind == _FOLIAGE:
        leaf = noise((x + 0.7 * z) * 3.2, (y - 0.7 * z) * 3.2, size * 3.2, 41)
        clump = noise((x - z) * 1.1, (y + z) * 1.1, size * 1.1, 42)
        r = 1.0 + 0.35 * leaf + 0.25 * clump
        g, b = r, r * (1.0 - 0.1 * leaf)
        r *= 1.0 + 0.1 * clump
    elif kind == _STRIPES:
        share = bands(uvw[0] - 0.25, p[0], p[1], duvw[0])
        worn = 0.9 + 0.1 * noise(x * 2.0, y * 2.0, size * 2.0, 51)
        paint = share * worn
        for c in range(3):
            out[c] = 0.075 * (1.0 - paint) + albedo[c] * paint
    elif kind == _TILES:
        row = math.floor(uvw[1] / 0.33)
        r = 1.0 + 0.2 * (lattice(math.floor(uvw[0] / 0.25 + 0.5 * row), int(row), 61) - 0.5)
        r *= 1.0 - 0.3 * bands(uvw[1], 0.33, 0.05, duvw[1])
        g = b = r
    elif kind == _GLASS:
        glass = 1.0
    elif p[0] > 0.0:  # PLAIN
        r = 1.0 + p[0] * (
            0.08 * noise(x / 1.3, (y + z) / 1.3, size / 1.3, 71)
            + 0.06 * noise(x * 3.0 + z, y * 3.0, size * 3.0, 72)
        )
        g = b = r
    out[0] *= r
    out[1] *= g
    out[2] *= b
    out[3] = glass
    out[4] = paint
