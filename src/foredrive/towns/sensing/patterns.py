"""Procedural textures, filtered over the footprint of a pixel so that what is far away does not sparkle.

Every pattern is made of bands whose share of the footprint is known in closed form, and of value noise that
fades out as the footprint outgrows it. Compiled by numba, called once for each hit.
"""

import math
from typing import no_type_check

import numba
import numpy as np

from foredrive.towns.place.looks import GroundFloor, LinePattern, Texture, WallKind, WindowKind

_TABLE_BITS = 12
_TABLE_MASK = (1 << _TABLE_BITS) - 1
_NOISE = np.random.default_rng(20).random(1 << _TABLE_BITS).astype(np.float32)
"""Random numbers that lattice points are hashed to."""

DASH_PERIOD_M, DASH_M = 9.0, 3.0
DOUBLE_LINE_GAP_M = 0.12
WHITE_PAINT, YELLOW_PAINT = (0.72, 0.72, 0.70), (0.66, 0.42, 0.04)
PAINT_REFLECTIVITY = 0.75
GLASS_RGB = (0.045, 0.06, 0.075)
ASPHALT = 0.10
"""Linear reflectance between the stripes of a crosswalk."""

ACCENT_RGB = np.array(
    [
        (0.10, 0.02, 0.02),
        (0.02, 0.05, 0.14),
        (0.02, 0.07, 0.04),
        (0.14, 0.08, 0.04),
        (0.45, 0.44, 0.42),
        (0.05, 0.05, 0.055),
        (0.40, 0.16, 0.02),
        (0.08, 0.20, 0.22),
        (0.16, 0.04, 0.12),
        (0.30, 0.32, 0.16),
        (0.03, 0.035, 0.05),
    ],
    dtype=np.float32,
)
"""Linear reflectance of doors, shutters and shop signs."""
KERB_STONE_M = 0.16
TEXTURED = 6
TEXTURE_WORDS = TEXTURED + 4
"""Of the array that a texture is written to."""

_ROAD, _SLABS, _GRASS = int(Texture.ROAD), int(Texture.SLABS), int(Texture.GRASS)
_FACADE, _TILES, _FOLIAGE = int(Texture.FACADE), int(Texture.TILES), int(Texture.FOLIAGE)
_STRIPES, _GLASS = int(Texture.STRIPES), int(Texture.GLASS)
_BRICK, _STONE = int(WallKind.BRICK), int(WallKind.STONE)
_SHEET, _BOARDS = int(WallKind.SHEET), int(WallKind.BOARDS)
_CASEMENT, _TALL, _RIBBON = int(WindowKind.CASEMENT), int(WindowKind.TALL), int(WindowKind.RIBBON)
_CURTAIN, _SHUTTERED = int(WindowKind.CURTAIN), int(WindowKind.SHUTTERED)
_GRID, _SLIT = int(WindowKind.GRID), int(WindowKind.SLIT)
_SHOPS, _GATES = int(GroundFloor.SHOPS), int(GroundFloor.GATES)
_LINE_NONE, _LINE_BROKEN = int(LinePattern.NONE), int(LinePattern.BROKEN)
_LINE_DOUBLE, _LINE_DOUBLE_BROKEN = int(LinePattern.DOUBLE_SOLID), int(LinePattern.DOUBLE_BROKEN)

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)


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
def _road(p, look, x, y, uvw, extent, i, out):
    """Asphalt: grain, wear along the wheel tracks, patches, lines."""
    size = extent[i, 3]
    shade = 1.0 + 0.10 * noise(x / 11.0, y / 11.0, size / 11.0, 1)
    shade += 0.08 * noise(x / 2.3, y / 2.3, size / 2.3, 2) + 0.10 * noise(x * 4.0, y * 4.0, size * 4.0, 3)
    if lattice(math.floor(x / 9.0), math.floor(y / 6.0), 4) > 0.9:
        shade *= 0.9
    left, right = uvw[i, 0], uvw[i, 1]
    if 2.5 < left + right < 5.0:
        track = abs(abs(0.5 * (left - right)) - 0.85)
        shade *= 1.0 - 0.10 * math.exp(-8.0 * track * track)
    paint, yellow = 0.0, False
    for side in range(2):
        pattern = int(p[look, 3 * side])
        if pattern != _LINE_NONE:
            share = _line(
                uvw[i, side], uvw[i, 2], extent[i, side], extent[i, 2], pattern, p[look, 3 * side + 2]
            )
            if share > paint:
                paint = share
                yellow = p[look, 3 * side + 1] > 0.5
    if paint > 0.0:
        paint *= 0.92 + 0.08 * noise(x * 3.0, y * 3.0, size * 3.0, 5)
    colour = YELLOW_PAINT if yellow else WHITE_PAINT
    for c in range(3):
        out[c] = out[c] * shade * (1.0 - paint) + colour[c] * paint
    out[4] = paint


@_kernel
@no_type_check
def _ground_floor(p, look, x_in, y, bay, column, span, du, dv, out):
    """Openings below the first storey; `_openings` says what is written to out."""
    ground, kind = p[look, 4], int(p[look, 7])
    pick = lattice(int(column), int(span * 10.0), 11)
    if kind == _GATES:
        high = min(4.2, ground - 2.2)
        gate = band(x_in, 0.14 * bay, 0.86 * bay, du) * band(y, 0.0, high, dv) if pick > 0.4 else 0.0
        out[2] = gate * (1.0 - 0.3 * bands(y, 0.25, 0.05, dv))
        top = band(y, ground - 1.6, ground - 0.7, dv) * (1.0 - bands(x_in, 1.2, 0.08, du))
        out[0] = top * (1.0 - gate)
        return
    if kind == _SHOPS:
        fascia = band(y, ground - 0.95, ground - 0.3, dv)
        letters = band(y, ground - 0.77, ground - 0.48, dv) * band(x_in, 0.2 * bay, 0.8 * bay, du)
        letters *= 1.0 - bands(x_in, 0.27, 0.09, du)
        letters *= 1.0 if pick > 0.35 else 0.0
        out[2], out[1] = fascia * (1.0 - letters), letters
        low = 0.05 if pick > 0.7 else 0.5
        left, rim = 0.05 * bay, 0.06
        pane = band(x_in, left, bay - left, du) * band(y, low, ground - 1.1, dv)
        glass = band(x_in, left + rim, bay - left - rim, du) * band(y, low + rim, ground - 1.1 - rim, dv)
        glass *= 1.0 - band(x_in, 0.5 * bay - 0.03, 0.5 * bay + 0.03, du)
        out[0], out[1] = glass, out[1] + pane - glass
        return
    if pick > 0.72:
        x = x_in - 0.5 * bay
        door = band(x, -0.55, 0.55, du) * band(y, 0.05, 2.15, dv)
        out[0] = band(x, -0.5, 0.5, du) * band(y, 2.2, 2.55, dv)
        out[2] = door * (1.0 - 0.35 * bands(y - 0.2, 0.6, 0.06, dv))
        out[1] = band(x, -0.65, 0.65, du) * band(y, 0.0, 2.65, dv) - door - out[0]
        return
    wide, low, rim = p[look, 2] * bay, 0.85, 0.07
    left, high = 0.5 * (bay - wide), max(ground - 1.5, 0.8)
    pane = band(x_in, left, left + wide, du) * band(y, low, low + high, dv)
    glass = band(x_in, left + rim, left + wide - rim, du) * band(y, low + rim, low + high - rim, dv)
    glass *= 1.0 - band(x_in, 0.5 * bay - 0.03, 0.5 * bay + 0.03, du)
    out[0], out[1] = glass, pane - glass


@_kernel
@no_type_check
def _openings(p, look, u, v, w, du, dv, out):
    """What fills a façade's footprint besides its wall.

    Args:
        out: [4] filled with the shares of glass, of frames, of what has the accent colour, and the brightness
            of the glass below its lintel.

    Returns:
        The number of the window.
    """
    storey, nominal_bay, wide_share, high_share = p[look, 0], p[look, 1], p[look, 2], p[look, 3]
    ground, kind = p[look, 4], int(p[look, 6])
    out[0] = out[1] = out[2] = 0.0
    out[3] = 1.0
    usable = u + w - 0.8
    if usable < 0.7 * nominal_bay:
        return 0
    if du > nominal_bay or dv > storey:  # whole windows blur together
        share = wide_share * high_share
        out[0], out[1] = 0.85 * share, 0.15 * share
        return 0
    count = max(1.0, math.floor(usable / nominal_bay + 0.3))
    bay = usable / count
    x = u - 0.4
    column = min(max(math.floor(x / bay), 0.0), count - 1.0)
    x_in = x - column * bay
    if x < 0.0 or w < 0.4:  # the corners stay wall
        return 0
    if v < ground:
        _ground_floor(p, look, x_in, v, bay, column, u + w, du, dv, out)
        return int(column)
    row = math.floor((v - ground) / storey) + 1.0
    y = v - ground - (row - 1.0) * storey
    wide, high = wide_share * bay, high_share * storey
    low = 0.5 * (storey - high) + 0.12
    if kind in (_RIBBON, _CURTAIN):
        wide = bay
    elif kind == _TALL:
        low, high = 0.12, storey - 0.75
    left, rim = 0.5 * (bay - wide), 0.06
    if kind == _SLIT:
        wide = 0.24 * bay
        left = 0.18 * bay if x_in < 0.5 * bay else 0.58 * bay
    pane = band(x_in, left, left + wide, du) * band(y, low, low + high, dv)
    glass = band(x_in, left + rim, left + wide - rim, du) * band(y, low + rim, low + high - rim, dv)
    if kind == _GRID:
        glass *= (1.0 - bands(x_in - left, 0.42, 0.05, du)) * (1.0 - bands(y - low, 0.5, 0.05, dv))
    elif kind != _SLIT and kind != _CURTAIN:
        glass *= 1.0 - band(x_in, 0.5 * bay - 0.03, 0.5 * bay + 0.03, du)
    frame = pane - glass
    if kind in (_CASEMENT, _SHUTTERED, _GRID):
        frame += band(x_in, left - 0.1, left + wide + 0.1, du) * band(y, low - 0.09, low, dv)
    if kind == _SHUTTERED:
        leaf = 0.45 * wide
        shutter = band(x_in, left - leaf, left, du) + band(x_in, left + wide, left + wide + leaf, du)
        out[2] = shutter * band(y, low, low + high, dv) * (1.0 - 0.3 * bands(y, 0.12, 0.04, dv))
    elif kind == _TALL:
        rail = band(x_in, left - 0.1, left + wide + 0.1, du) * band(y, 0.12, 1.05, dv)
        rail *= bands(x_in, 0.14, 0.03, du) + band(y, 1.0, 1.05, dv)
        glass, frame, out[2] = glass * (1.0 - min(rail, 1.0)), frame * (1.0 - min(rail, 1.0)), min(rail, 1.0)
    out[0], out[1] = glass, frame
    out[3] = 1.0 - 0.7 * band(y, low + high - 0.24, low + high, dv)
    return int(row * 131.0 + column)


@_kernel
@no_type_check
def _wall(p, look, u, v, du, dv):
    """Brightness of what a façade is made of: joints, single bricks and slabs, ribs."""
    kind = int(p[look, 5])
    if kind == _BRICK and du < 0.4:
        course = math.floor(v / 0.15)
        shifted = u + 0.15 * (course % 2)
        mortar = bands(v, 0.15, 0.02, dv)
        mortar += (1.0 - mortar) * bands(shifted, 0.3, 0.02, du)
        brick = lattice(math.floor(shifted / 0.3), course, 8) - 0.5
        return 1.0 + (0.35 * (mortar - 0.19) + 0.3 * brick) * (1.0 - du / 0.4)
    if kind == _STONE and du < 2.0:
        joint = min(bands(v, 0.75, 0.03, dv) + bands(u, 1.5, 0.03, du), 1.0)
        slab = lattice(math.floor(u / 1.5), math.floor(v / 0.75), 12) - 0.5
        return 1.0 - 0.4 * joint + 0.12 * slab * (1.0 - du / 2.0)
    if kind == _SHEET:
        return 1.06 - 0.22 * bands(u, 0.33, 0.14, du) - 0.15 * bands(u, 6.0, 0.08, du)
    if kind == _BOARDS and dv < 0.5:
        board = lattice(math.floor(v / 0.2), 3, 13) - 0.5
        return 1.04 - 0.45 * bands(v, 0.2, 0.03, dv) + 0.16 * board * (1.0 - 2.0 * dv)
    return 1.0


@_kernel
@no_type_check
def _facade(p, look, x, y, uvw, extent, i, out):
    """Walls with windows, doors, shop fronts, a plinth and a ledge above the ground floor."""
    u, v, w = uvw[i, 0], uvw[i, 1], uvw[i, 2]
    du, dv = extent[i, 0], extent[i, 1]
    a = u + 0.37 * (x - y)
    tint = 1.0 + 0.07 * noise(a / 3.0, v / 3.0, du / 3.0, 6) + 0.05 * noise(a * 2.0, v * 2.0, du * 2.0, 7)
    tint += 0.05 * noise(a * 1.2, v / 6.0, du * 1.2, 14)  # streaks that the rain leaves
    tint *= 0.84 + 0.16 * min(1.0, v / 1.2)
    tint *= _wall(p, look, u, v, du, dv)
    if int(p[look, 7]) != _GATES:
        tint *= 1.0 + 0.25 * band(v, p[look, 4] - 0.12, p[look, 4] + 0.12, dv)
        tint *= 1.0 - 0.22 * band(v, -2.0, 0.45, dv)
    part = out[TEXTURED:]
    number = _openings(p, look, u, v, w, du, dv, part)
    glass, frame, accent = part[0], part[1], part[2]
    behind = lattice(number, look, 9)
    bright = (0.25 + 1.5 * behind if behind > 0.75 else 1.0) * part[3]
    row = int(p[look, 8])
    wood = 0.55 if row % 3 else 0.07
    rest = tint * max(0.0, 1.0 - glass - frame - accent)
    for c in range(3):
        out[c] = out[c] * rest + wood * frame + GLASS_RGB[c] * bright * glass + ACCENT_RGB[row, c] * accent
    out[3] = glass
    out[5] = behind if number > 0 else 0.0


@_kernel
@no_type_check
def _tint(kind, p, look, xyz, uvw, extent, i):
    """Factors on red, green and blue of the simpler textures."""
    x, y, z, size = xyz[i, 0], xyz[i, 1], xyz[i, 2], extent[i, 3]
    if kind == _GRASS:
        wide = noise(x / 23.0, y / 23.0, size / 23.0, 21)
        fine = noise(x * 1.7, y * 1.7, size * 1.7, 22) + 0.6 * noise(x * 6.0, y * 6.0, size * 6.0, 23)
        dry = 0.5 + 0.5 * noise(x / 5.0, y / 5.0, size / 5.0, 24) + 0.3 * wide
        shade = 1.0 + 0.16 * fine + 0.12 * wide
        return shade * (0.8 + 0.5 * dry), shade * (0.95 + 0.12 * dry), shade * (0.8 + 0.3 * dry)
    if kind == _SLABS:
        edge = p[look, 0]
        joint = bands(x, edge, 0.025, size) + bands(y, edge, 0.025, size)
        slab = lattice(math.floor(x / edge), math.floor(y / edge), 31) - 0.5
        shade = 1.0 - 0.35 * min(joint, 1.0) + 0.14 * slab * max(0.0, 1.0 - size / edge)
        u, v = uvw[i, 0], uvw[i, 1]
        stone = max(band(u, -1.0, KERB_STONE_M, extent[i, 0]), band(v, -1.0, KERB_STONE_M, extent[i, 1]))
        seam = bands(uvw[i, 2], 1.0, 0.03, extent[i, 2])
        shade = shade * (1.0 - stone) + (1.12 - 0.5 * seam) * stone
        shade += 0.06 * noise(x / 4.0, y / 4.0, size / 4.0, 32)
        return shade, shade, shade
    if kind == _FOLIAGE:
        leaf = noise((x + 0.7 * z) * 3.2, (y - 0.7 * z) * 3.2, size * 3.2, 41)
        clump = noise((x - z) * 1.1, (y + z) * 1.1, size * 1.1, 42)
        shade = 0.95 + 0.42 * leaf + 0.38 * clump
        return shade * (1.0 + 0.1 * clump), shade, shade * (1.0 - 0.1 * leaf)
    if kind == _TILES:
        row = math.floor(uvw[i, 1] / 0.33)
        shade = 1.0 + 0.2 * (lattice(math.floor(uvw[i, 0] / 0.25 + 0.5 * row), row, 61) - 0.5)
        shade *= 1.0 - 0.3 * bands(uvw[i, 1], 0.33, 0.05, extent[i, 1])
        return shade, shade, shade
    mottling = p[look, 0]
    if mottling > 0.0:
        shade = 1.0 + 0.08 * mottling * noise(x / 1.3, (y + z) / 1.3, size / 1.3, 71)
        shade += 0.06 * mottling * noise(x * 3.0 + z, y * 3.0, size * 3.0, 72)
        return shade, shade, shade
    return 1.0, 1.0, 1.0


@_kernel
@no_type_check
def texture(looks, look, xyz, uvw, extent, i, out):
    """Evaluate a look at the i-th of many hits.

    Args:
        looks: `LookArrays`.
        xyz: [N 3] positions, m.
        uvw: [N 3] texture coordinates.
        extent: [N 4] extent of a pixel's footprint in the texture coordinates, and on the surface, m.
        out: [`TEXTURE_WORDS`]; the first six are filled with red, green, blue (linear), share of glass, share
            of paint, and a random number in 0..1 that the window has to itself, 0 where there is none or too
            many. The others are room to work in.
    """
    kind, p = looks.texture[look], looks.params
    x, y = xyz[i, 0], xyz[i, 1]
    for c in range(3):
        out[c] = looks.albedo[look, c]
    out[3] = out[4] = out[5] = 0.0
    if kind == _ROAD:
        _road(p, look, x, y, uvw, extent, i, out)
    elif kind == _FACADE:
        _facade(p, look, x, y, uvw, extent, i, out)
    elif kind == _STRIPES:
        share = bands(uvw[i, 0] - 0.25, p[look, 0], p[look, 1], extent[i, 0])
        paint = share * (0.9 + 0.1 * noise(x * 2.0, y * 2.0, extent[i, 3] * 2.0, 51))
        for c in range(3):
            out[c] = ASPHALT * (1.0 - paint) + out[c] * paint
        out[4] = paint
    else:
        if kind == _GLASS:
            out[3] = 1.0
        r, g, b = _tint(kind, p, look, xyz, uvw, extent, i)
        out[0] *= r
        out[1] *= g
        out[2] *= b
