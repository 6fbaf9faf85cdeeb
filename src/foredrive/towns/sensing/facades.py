"""The texture of façades: walls, windows, doors, shop fronts.

The functions are compiled by numba and called once for each hit.
"""

import math
from typing import no_type_check

import numpy as np

from foredrive.towns.place.materials import GroundFloor, WallKind, WindowKind
from foredrive.towns.sensing.patterns import TEXTURED, band, bands, kernel_part, lattice, noise

GLASS_RGB = (0.045, 0.06, 0.075)
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

_BRICK, _STONE = int(WallKind.BRICK), int(WallKind.STONE)
_SHEET, _BOARDS = int(WallKind.SHEET), int(WallKind.BOARDS)
_CASEMENT, _TALL, _RIBBON = int(WindowKind.CASEMENT), int(WindowKind.TALL), int(WindowKind.RIBBON)
_CURTAIN, _SHUTTERED = int(WindowKind.CURTAIN), int(WindowKind.SHUTTERED)
_GRID, _SLIT = int(WindowKind.GRID), int(WindowKind.SLIT)
_SHOPS, _GATES = int(GroundFloor.SHOPS), int(GroundFloor.GATES)


@kernel_part
@no_type_check
def _ground_floor(p, material, x_in, y, bay, column, span, du, dv, out):
    """Compute the openings below the first storey. `_openings` describes what is written to `out`."""
    ground, kind = p[material, 4], int(p[material, 7])
    # One random number for each bay decides what is there
    pick = lattice(int(column), int(span * 10.0), 11)
    # A roller door with grooves, and a band of windows below the eaves
    if kind == _GATES:
        high = min(4.2, ground - 2.2)
        gate = band(x_in, 0.14 * bay, 0.86 * bay, du) * band(y, 0.0, high, dv) if pick > 0.4 else 0.0
        out[2] = gate * (1.0 - 0.3 * bands(y, 0.25, 0.05, dv))
        top = band(y, ground - 1.6, ground - 0.7, dv) * (1.0 - bands(x_in, 1.2, 0.08, du))
        out[0] = top * (1.0 - gate)
        return
    # Shop: sign with letters above, window in a frame below
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
    # Some bays have a door with a window above, in a frame; the others have windows
    if pick > 0.72:
        x = x_in - 0.5 * bay
        door = band(x, -0.55, 0.55, du) * band(y, 0.05, 2.15, dv)
        out[0] = band(x, -0.5, 0.5, du) * band(y, 2.2, 2.55, dv)
        out[2] = door * (1.0 - 0.35 * bands(y - 0.2, 0.6, 0.06, dv))
        out[1] = band(x, -0.65, 0.65, du) * band(y, 0.0, 2.65, dv) - door - out[0]
        return
    wide, low, rim = p[material, 2] * bay, 0.85, 0.07
    left, high = 0.5 * (bay - wide), max(ground - 1.5, 0.8)
    pane = band(x_in, left, left + wide, du) * band(y, low, low + high, dv)
    glass = band(x_in, left + rim, left + wide - rim, du) * band(y, low + rim, low + high - rim, dv)
    glass *= 1.0 - band(x_in, 0.5 * bay - 0.03, 0.5 * bay + 0.03, du)
    out[0], out[1] = glass, pane - glass


@kernel_part
@no_type_check
def _shutters(x, y, left, wide, low, high, du, dv):
    """Return the share of the footprint that shutters on both sides of a window fill."""
    leaf = 0.45 * wide
    share = band(x, left - leaf, left, du) + band(x, left + wide, left + wide + leaf, du)
    return share * band(y, low, low + high, dv) * (1.0 - 0.3 * bands(y, 0.12, 0.04, dv))


@kernel_part
@no_type_check
def _rail(x, y, left, wide, du, dv, out):
    """Add a rail in front of a window that reaches down to the floor."""
    # A rail of thin bars, in front of glass and frame
    rail = band(x, left - 0.1, left + wide + 0.1, du) * band(y, 0.12, 1.05, dv)
    rail = min(rail * (bands(x, 0.14, 0.03, du) + band(y, 1.0, 1.05, dv)), 1.0)
    out[0], out[1], out[2] = out[0] * (1.0 - rail), out[1] * (1.0 - rail), rail


@kernel_part
@no_type_check
def _openings(p, material, u, v, w, du, dv, out):
    """Compute the parts of a façade's footprint that are not wall.

    Args:
        out: [4] receives the shares of glass, of frames and of the accent colour, and the brightness of the
            glass below its lintel.

    Returns:
        The number of the window, 0 where there is none or where there are too many.
    """
    storey, nominal_bay = p[material, 0], p[material, 1]
    wide_share, high_share = p[material, 2], p[material, 3]
    ground, kind = p[material, 4], int(p[material, 6])
    out[0] = out[1] = out[2] = 0.0
    out[3] = 1.0
    # Width between the corners; walls that are too narrow have no windows
    usable = u + w - 0.8
    if usable < 0.7 * nominal_bay:
        return 0
    if du > nominal_bay or dv > storey:  # whole windows blur together
        share = wide_share * high_share
        out[0], out[1] = 0.85 * share, 0.15 * share
        return 0
    # The bays divide the wall evenly, as in `_Facade.centres`
    count = max(1.0, math.floor(usable / nominal_bay + 0.3))
    bay = usable / count
    x = u - 0.4
    column = min(max(math.floor(x / bay), 0.0), count - 1.0)
    x_in = x - column * bay
    if x < 0.0 or w < 0.4:  # the corners are wall
        return 0
    if v < ground:
        _ground_floor(p, material, x_in, v, bay, column, u + w, du, dv, out)
        return int(column) + 1
    # Storey above the ground floor, and the height within it
    row = math.floor((v - ground) / storey) + 1.0
    y = v - ground - (row - 1.0) * storey
    wide, high = wide_share * bay, high_share * storey
    # Windows are a little above the middle of the storey
    low = 0.5 * (storey - high) + 0.12
    if kind in (_RIBBON, _CURTAIN):
        wide = bay
    elif kind == _TALL:
        low, high = 0.12, storey - 0.75
    left, rim = 0.5 * (bay - wide), 0.06
    if kind == _SLIT:
        # Two narrow windows in each bay
        wide = 0.24 * bay
        left = 0.18 * bay if x_in < 0.5 * bay else 0.58 * bay
    pane = band(x_in, left, left + wide, du) * band(y, low, low + high, dv)
    glass = band(x_in, left + rim, left + wide - rim, du) * band(y, low + rim, low + high - rim, dv)
    # Bars between the panes; a sill below the window
    if kind == _GRID:
        glass *= (1.0 - bands(x_in - left, 0.42, 0.05, du)) * (1.0 - bands(y - low, 0.5, 0.05, dv))
    elif kind != _SLIT and kind != _CURTAIN:
        glass *= 1.0 - band(x_in, 0.5 * bay - 0.03, 0.5 * bay + 0.03, du)
    frame = pane - glass
    if kind in (_CASEMENT, _SHUTTERED, _GRID):
        frame += band(x_in, left - 0.1, left + wide + 0.1, du) * band(y, low - 0.09, low, dv)
    out[0], out[1] = glass, frame
    if kind == _SHUTTERED:
        out[2] = _shutters(x_in, y, left, wide, low, high, du, dv)
    elif kind == _TALL:
        _rail(x_in, y, left, wide, du, dv, out)
    # Shade below the lintel
    out[3] = 1.0 - 0.7 * band(y, low + high - 0.24, low + high, dv)
    return int(row * 131.0 + column)


@kernel_part
@no_type_check
def _wall(p, material, u, v, du, dv):
    """Return the brightness of a façade's material: joints, single bricks and slabs, ribs."""
    kind = int(p[material, 5])
    if kind == _BRICK and du < 0.4:
        # Every second course is shifted by half a brick
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


@kernel_part
@no_type_check
def facade(p, material, x, y, uvw, extent, i, out):
    """Compute walls with windows, doors, shop fronts, a plinth and a ledge above the ground floor."""
    u, v, w = uvw[i, 0], uvw[i, 1], uvw[i, 2]
    du, dv = extent[i, 0], extent[i, 1]
    # One coordinate along any wall, whatever its direction
    a = u + 0.37 * (x - y)
    tint = 1.0 + 0.07 * noise(a / 3.0, v / 3.0, du / 3.0, 6) + 0.05 * noise(a * 2.0, v * 2.0, du * 2.0, 7)
    tint += 0.05 * noise(a * 1.2, v / 6.0, du * 1.2, 14)  # streaks from rain
    # Walls are darker near the ground
    tint *= 0.84 + 0.16 * min(1.0, v / 1.2)
    tint *= _wall(p, material, u, v, du, dv)
    if int(p[material, 7]) != _GATES:
        tint *= 1.0 + 0.25 * band(v, p[material, 4] - 0.12, p[material, 4] + 0.12, dv)
        tint *= 1.0 - 0.22 * band(v, -2.0, 0.45, dv)
    part = out[TEXTURED:]
    number = _openings(p, material, u, v, w, du, dv, part)
    glass, frame, accent = part[0], part[1], part[2]
    # A random number for each window decides its brightness and whether it is lit
    behind = lattice(number, material, 9)
    bright = (0.25 + 1.5 * behind if behind > 0.75 else 1.0) * part[3]
    row = int(p[material, 8])
    wood = 0.55 if row % 3 else 0.07
    # What is neither glass, frame nor accent is wall
    rest = tint * max(0.0, 1.0 - glass - frame - accent)
    for c in range(3):
        out[c] = out[c] * rest + wood * frame + GLASS_RGB[c] * bright * glass + ACCENT_RGB[row, c] * accent
    out[3] = glass
    out[5] = behind if number > 0 else 0.0
