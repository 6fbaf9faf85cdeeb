"""Water on the ground: where it stands and its effects on light."""

import math
from typing import no_type_check

import numba
import numpy as np

from foredrive.towns.place.materials import Surface
from foredrive.towns.sensing.patterns import noise

LEVEL_COS = 0.9
"""Minimum vertical component of the unit normal of ground on which water stands."""
WATER_MIRROR = 0.02
"""Share of light that water mirrors at perpendicular incidence (Fresnel, n = 1.33)."""
WET_DARKENING = 0.5
"""Darkening of wet porous ground: light is trapped below the film (Lekner & Dorf, Applied Optics 27,
1988)."""
WET_SHINE = 120.0
"""Sharpness of mirrored lamps, as a Blinn-Phong exponent."""
PUDDLE_M = 3.0
_DRY_DEPTH = 1.12
"""Minimum depth of a hollow that holds water on almost dry ground. The deepest hollow has 1.4."""
THIN_FILM = 0.28
RIPPLES = 0.008
MIN_MIRROR = 0.015
_ROAD, _SIDEWALK = int(Surface.ROAD), int(Surface.SIDEWALK)

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)


@_kernel
@no_type_check
def is_paved(surface):
    """Return whether water gathers on a `Surface`."""
    return surface in (_ROAD, _SIDEWALK)


@_kernel
@no_type_check
def water_film(wetness, surface, xyz, extent, i):
    """Return the share of paved ground under water at the i-th hit, 0 to 1: puddles, and a thin film between
    them.

    Walkways have no puddles because they slope and drain.
    """
    x, y, size = xyz[i, 0], xyz[i, 1], extent[i, 3]
    # A thin film everywhere, and puddles in the hollows of a noise
    film = THIN_FILM * wetness * wetness * (1.0 + 0.4 * noise(x * 2.0, y * 2.0, size * 2.0, 93))
    if surface != _ROAD:
        return 0.6 * film
    deep = noise(x / PUDDLE_M, y / PUDDLE_M, size / PUDDLE_M, 91)
    deep += 0.4 * noise(x * 0.9, y * 0.9, size * 0.9, 92)
    # Puddles grow with the wetness: the threshold falls
    puddle = min(max(5.0 * (deep - _DRY_DEPTH + 0.85 * wetness**3), 0.0), 1.0)
    return film + (1.0 - film) * puddle


@_kernel
@no_type_check
def water_mirror(cosine):
    """Return the share of light that water mirrors (Schlick's approximation of Fresnel's equations, 1994)."""
    return WATER_MIRROR + (1.0 - WATER_MIRROR) * (1.0 - cosine) ** 5


@_kernel
@no_type_check
def mirror_rays(materials, surfaces, t, direction, wetness, out_origin, out_direction):
    """Return the indices of the hits whose water mirrors enough to be followed.

    Fill out_origin and out_direction with the mirrored rays. Ripples deflect each ray slightly.
    """
    index = np.empty(len(t), np.int64)
    count = 0
    for i in range(len(t)):
        material, nz = surfaces.material[i], surfaces.normal[i, 2]
        # Only level paved ground, and only films that mirror enough
        if material < 0 or nz < LEVEL_COS or not is_paved(materials.surface[material]):
            continue
        film = water_film(wetness, materials.surface[material], surfaces.xyz, surfaces.extent, i)
        if film * water_mirror(surfaces.cosine[i]) < MIN_MIRROR:
            continue
        x, y, size = surfaces.xyz[i, 0], surfaces.xyz[i, 1], surfaces.extent[i, 3]
        # Ripples tilt the normal a little
        rx = RIPPLES * noise(x * 4.0, y * 4.0, 2.0 * size, 94)
        ry = RIPPLES * noise(x * 4.0, y * 4.0, 2.0 * size, 95)
        nx, ny = surfaces.normal[i, 0] + rx, surfaces.normal[i, 1] + ry
        scale = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx * scale, ny * scale, nz * scale
        dx, dy, dz = direction[i, 0], direction[i, 1], direction[i, 2]
        # Reflection d - 2 (d · n) n, at least slightly upwards
        along = dx * nx + dy * ny + dz * nz
        out_direction[count, 0] = dx - 2.0 * along * nx
        out_direction[count, 1] = dy - 2.0 * along * ny
        out_direction[count, 2] = max(dz - 2.0 * along * nz, 1e-3)
        out_origin[count, 0], out_origin[count, 1] = x, y
        # Start above the surface, further at a distance
        out_origin[count, 2] = surfaces.xyz[i, 2] + 0.01 + 0.02 * size
        index[count] = i
        count += 1
    return index[:count]
