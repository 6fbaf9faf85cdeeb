"""Procedural textures: roads, ground, plants, plain objects.

The functions are compiled by numba and called once for each hit.
"""

import math
from typing import no_type_check

from foredrive.towns.place.materials import GRASS_RGB, LinePattern, Texture, srgb_to_linear
from foredrive.towns.sensing.facades import facade
from foredrive.towns.sensing.patterns import band, bands, kernel_part, lattice, noise

DASH_PERIOD_M, DASH_M = 9.0, 3.0
DOUBLE_LINE_GAP_M = 0.12
WHITE_PAINT, YELLOW_PAINT = (0.72, 0.72, 0.70), (0.66, 0.42, 0.04)
PAINT_REFLECTIVITY = 0.75
ASPHALT = 0.10
"""Linear reflectance between the stripes of a crosswalk."""
KERB_STONE_M = 0.16
TRAMLINES_M, TRACK_M, RUT_M = 18.0, 1.8, 0.4
"""Ruts of tractors in fields, m: distance between pairs, distance within a pair, and width."""
_GRASS_RGB = srgb_to_linear([GRASS_RGB])[0]

_ROAD, _SLABS, _GRASS = int(Texture.ROAD), int(Texture.SLABS), int(Texture.GRASS)
_FACADE, _TILES, _FOLIAGE = int(Texture.FACADE), int(Texture.TILES), int(Texture.FOLIAGE)
_STRIPES, _GLASS, _FIELD = int(Texture.STRIPES), int(Texture.GLASS), int(Texture.FIELD)
_LINE_NONE, _LINE_BROKEN = int(LinePattern.NONE), int(LinePattern.BROKEN)
_LINE_DOUBLE, _LINE_DOUBLE_BROKEN = int(LinePattern.DOUBLE_SOLID), int(LinePattern.DOUBLE_BROKEN)


@kernel_part
@no_type_check
def _line(distance: float, along: float, du: float, dw: float, pattern: int, width: float) -> float:
    """Return the painted share of the footprint at a distance from the border that the line follows."""
    if pattern == _LINE_NONE:
        return 0.0
    # Double lines: each lane paints the one on its own side, half a gap from the border
    if pattern >= _LINE_DOUBLE:
        low = 0.5 * DOUBLE_LINE_GAP_M
        share = band(distance, low, low + width, du)
    else:
        share = band(distance, -1.0, 0.5 * width, du)
    if pattern in (_LINE_BROKEN, _LINE_DOUBLE_BROKEN):
        share *= bands(along, DASH_PERIOD_M, DASH_M, dw)
    return share


@kernel_part
@no_type_check
def _road(p, material, x, y, uvw, extent, i, out):
    """Compute asphalt: grain, wear along the wheel tracks, patches, lines."""
    size = extent[i, 3]
    # Grain at three wavelengths, and patches of another age
    shade = 1.0 + 0.10 * noise(x / 11.0, y / 11.0, size / 11.0, 1)
    shade += 0.08 * noise(x / 2.3, y / 2.3, size / 2.3, 2) + 0.10 * noise(x * 4.0, y * 4.0, size * 4.0, 3)
    if lattice(math.floor(x / 9.0), math.floor(y / 6.0), 4) > 0.9:
        shade *= 0.9
    left, right = uvw[i, 0], uvw[i, 1]
    # Wheel tracks on pieces of the width of a lane
    if 2.5 < left + right < 5.0:
        track = abs(abs(0.5 * (left - right)) - 0.85)
        shade *= 1.0 - 0.10 * math.exp(-8.0 * track * track)
    paint, yellow = 0.0, False
    # Left and right line; the stronger one decides the colour
    for side in range(2):
        pattern = int(p[material, 3 * side])
        if pattern != _LINE_NONE:
            share = _line(
                uvw[i, side], uvw[i, 2], extent[i, side], extent[i, 2], pattern, p[material, 3 * side + 2]
            )
            if share > paint:
                paint = share
                yellow = p[material, 3 * side + 1] > 0.5
    if paint > 0.0:
        paint *= 0.92 + 0.08 * noise(x * 3.0, y * 3.0, size * 3.0, 5)
    colour = YELLOW_PAINT if yellow else WHITE_PAINT
    for c in range(3):
        out[c] = out[c] * shade * (1.0 - paint) + colour[c] * paint
    out[4] = paint


@kernel_part
@no_type_check
def _grass(x, y, size):
    """Return factors on red, green and blue of the land."""
    wide = noise(x / 23.0, y / 23.0, size / 23.0, 21)
    fine = noise(x * 1.7, y * 1.7, size * 1.7, 22) + 0.6 * noise(x * 6.0, y * 6.0, size * 6.0, 23)
    dry = 0.5 + 0.5 * noise(x / 5.0, y / 5.0, size / 5.0, 24) + 0.3 * wide
    shade = 1.0 + 0.16 * fine + 0.12 * wide
    return shade * (0.8 + 0.5 * dry), shade * (0.95 + 0.12 * dry), shade * (0.8 + 0.3 * dry)


@kernel_part
@no_type_check
def _field(p, material, x, y, uvw, extent, i, out):
    """Compute rows of crops with the ruts of tractors, and grass beyond the border."""
    u, size = uvw[i, 0], extent[i, 3]
    # Rows of plants, wavy; tractors' ruts run in pairs
    crop = bands(u + 0.06 * noise(x, y, size, 26), p[material, 0], p[material, 1], extent[i, 0])
    rut = bands(u, TRAMLINES_M, RUT_M, extent[i, 0]) + bands(u + TRACK_M, TRAMLINES_M, RUT_M, extent[i, 0])
    crop *= 1.0 - 0.8 * rut
    shade = (
        1.0
        + 0.14 * noise(x / 14.0, y / 14.0, size / 14.0, 27)
        + 0.10 * noise(x / 3.0, y / 3.0, size / 3.0, 28)
    )
    shade += 0.12 * noise(x * 3.0, y * 3.0, size * 3.0, 29)
    # The border is irregular too; beyond it there is grass
    border = uvw[i, 2] + 0.3 * noise(x / 1.5, y / 1.5, size / 1.5, 30)
    inside = band(border, 0.0, 1e6, extent[i, 2])
    grass = _grass(x, y, size)
    for c in range(3):
        tilled = shade * (out[c] * crop + p[material, 2 + c] * (1.0 - crop))
        out[c] = tilled * inside + _GRASS_RGB[c] * grass[c] * (1.0 - inside)


@kernel_part
@no_type_check
def _tint(kind, p, material, xyz, uvw, extent, i):
    """Return factors on red, green and blue of the simpler textures."""
    x, y, z, size = xyz[i, 0], xyz[i, 1], xyz[i, 2], extent[i, 3]
    if kind == _GRASS:
        return _grass(x, y, size)
    if kind == _SLABS:
        # Joints between slabs, brightness of each slab, and kerb stones along the edges
        edge = p[material, 0]
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
        # Leaves and clumps in three dimensions, by shifting the plane with the height
        leaf = noise((x + 0.7 * z) * 3.2, (y - 0.7 * z) * 3.2, size * 3.2, 41)
        clump = noise((x - z) * 1.1, (y + z) * 1.1, size * 1.1, 42)
        shade = 0.95 + 0.42 * leaf + 0.38 * clump
        return shade * (1.0 + 0.1 * clump), shade, shade * (1.0 - 0.1 * leaf)
    if kind == _TILES:
        # Rows of tiles, every second one shifted by half a tile
        row = math.floor(uvw[i, 1] / 0.33)
        shade = 1.0 + 0.2 * (lattice(math.floor(uvw[i, 0] / 0.25 + 0.5 * row), row, 61) - 0.5)
        shade *= 1.0 - 0.3 * bands(uvw[i, 1], 0.33, 0.05, extent[i, 1])
        return shade, shade, shade
    mottling = p[material, 0]
    if mottling > 0.0:
        shade = 1.0 + 0.08 * mottling * noise(x / 1.3, (y + z) / 1.3, size / 1.3, 71)
        shade += 0.06 * mottling * noise(x * 3.0 + z, y * 3.0, size * 3.0, 72)
        return shade, shade, shade
    return 1.0, 1.0, 1.0


@kernel_part
@no_type_check
def texture(materials, material, xyz, uvw, extent, i, out):
    """Evaluate a material at the i-th of many hits.

    Args:
        materials: `MaterialArrays`.
        material: number of the material.
        xyz: [N 3] positions, m.
        uvw: [N 3] texture coordinates.
        extent: [N 4] extent of a pixel's footprint in the texture coordinates, and on the surface, m.
        i: index of the hit.
        out: [`TEXTURE_WORDS`]. The first six receive red, green, blue (linear), the share of glass, the share
            of paint, and a random number in 0..1 of the window, 0 where there is none or where there are too
            many. The others are working memory.
    """
    kind, p = materials.texture[material], materials.params
    x, y = xyz[i, 0], xyz[i, 1]
    for c in range(3):
        out[c] = materials.albedo[material, c]
    out[3] = out[4] = out[5] = 0.0
    if kind == _ROAD:
        _road(p, material, x, y, uvw, extent, i, out)
    elif kind == _FIELD:
        _field(p, material, x, y, uvw, extent, i, out)
    elif kind == _FACADE:
        facade(p, material, x, y, uvw, extent, i, out)
    elif kind == _STRIPES:
        share = bands(uvw[i, 0] - 0.25, p[material, 0], p[material, 1], extent[i, 0])
        paint = share * (0.9 + 0.1 * noise(x * 2.0, y * 2.0, extent[i, 3] * 2.0, 51))
        for c in range(3):
            out[c] = ASPHALT * (1.0 - paint) + out[c] * paint
        out[4] = paint
    else:
        if kind == _GLASS:
            out[3] = 1.0
        r, g, b = _tint(kind, p, material, xyz, uvw, extent, i)
        out[0] *= r
        out[1] *= g
        out[2] *= b
