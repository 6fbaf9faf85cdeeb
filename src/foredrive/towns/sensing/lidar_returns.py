"""What comes back to a lidar: from surfaces, and from the air before them."""

import math
from typing import no_type_check

import numba
import numpy as np

from foredrive.towns.place.looks import Texture
from foredrive.towns.sensing.patterns import TEXTURE_WORDS
from foredrive.towns.sensing.textures import PAINT_REFLECTIVITY, texture
from foredrive.towns.sensing.wet import LEVEL_COS, is_paved, water_film

MISS = -1
GLASS_LOSS = 0.8
"""Share of a lidar pulse that a window lets through or mirrors away."""
LIDAR_REFERENCE_M = 45.0
"""At this distance half of the pulses from a surface of 2 % reflectivity, met head-on, are lost."""
LIDAR_THRESHOLD = 0.02
INTENSITY_OF_WHITE = 100.0 / 255.0
RETROREFLECTED = 0.3
"""How little it matters to painted lines, which hold glass beads, at what angle they are met."""
FOLIAGE_DEPTH_M = 0.25
WET_LIDAR_LOSS, FILM_LIDAR_LOSS = 0.35, 0.75
"""Of what a dry surface would send back: soaked, and below a film of water."""
NEAREST_CLUTTER_M, CLUTTER_DEPTH_M = 1.2, 9.0
"""Nearer, the laser does not overlap with what the detector sees; further, clutter is too weak."""
DROP_MMPH = 150.0
"""At e-fold of this rain rate every pulse meets a drop that is large enough to be seen by itself."""

_FOLIAGE = int(Texture.FOLIAGE)
_kernel = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)


@_kernel
@no_type_check
def lidar_returns(looks, found, t, max_range_m, chance, air):
    """Which beams return, how strongly and from where.

    The echo of a surface of reflectivity ρ met at an angle θ falls with ρ cos θ exp(-2 α r) / r² in air that
    takes α from the pulse for each metre; it is lost with a probability that rises as the echo falls to the
    detector's threshold. A film of water mirrors most of the pulse away from what is level.

    Args:
        chance: [N 2] uniform random numbers: for the loss, and for the depth within foliage.

    Returns:
        range [N] m, up to the surface where a beam was lost; returned [N]; intensity [N] in 0..1: what a
        white matt surface met head-on would have to reflect to look as bright, in percent of 255, as the
        makers of real lidars calibrate it. Only what throws light back where it came from exceeds 100/255.
    """
    count = len(t)
    range_m = np.empty(count, np.float32)
    returned = np.zeros(count, np.bool_)
    intensity = np.zeros(count, np.float32)
    colour = np.empty(TEXTURE_WORDS, np.float32)
    for i in range(count):
        look = found.look[i]
        range_m[i] = max_range_m
        if look == MISS or t[i] > max_range_m:
            continue
        texture(looks, look, found.xyz, found.uvw, found.extent, i, colour)
        glass, paint, cosine = colour[3], colour[4], found.cosine[i]
        reflectivity = looks.reflectivity[look] * (1.0 - paint) + PAINT_REFLECTIVITY * paint
        reflectivity *= 1.0 - GLASS_LOSS * glass
        if air.wetness > 0.0:
            level = abs(found.normal[i, 2]) > LEVEL_COS and is_paved(looks.surface[look])
            film = 0.0
            if level:
                film = water_film(air.wetness, looks.surface[look], found.xyz, found.extent, i)
            reflectivity *= (1.0 - WET_LIDAR_LOSS * air.wetness) * (1.0 - FILM_LIDAR_LOSS * film)
        range_m[i] = t[i]
        dimmed = math.exp(-2.0 * air.lidar_extinction_per_m * t[i])
        echo = reflectivity * cosine * dimmed * (LIDAR_REFERENCE_M / max(t[i], 1.0)) ** 2
        if chance[i, 0] < echo / (echo + LIDAR_THRESHOLD):
            returned[i] = True
            back = 1.0 if looks.reflectivity[look] > 1.0 else RETROREFLECTED * paint
            facing = cosine + (1.0 - cosine) * back
            intensity[i] = min(INTENSITY_OF_WHITE * reflectivity * facing * dimmed, 1.0)
            if looks.texture[look] == _FOLIAGE:
                range_m[i] += FOLIAGE_DEPTH_M * chance[i, 1]
    return range_m, returned, intensity


@_kernel
@no_type_check
def air_returns(air, chance, pulse_m, max_range_m, range_m, returned, intensity):
    """Replace returns by those that fog and rain send back before the surface; the stronger echo counts.

    A pulse whose length in the air is 2 ΔR meets at r what looks like a surface of reflectivity π β ΔR, with
    β the air's backscatter (the lidar equation for an extended target). Fog sends a curtain whose strength
    fluctuates; in rain that is gathered in the few pulses that meet a large drop.

    Args:
        air: `AirArrays`.
        chance: [N 4] uniform random numbers.
        pulse_m: ΔR.
        range_m: [N] and `returned`, `intensity`: of the surfaces, changed in place.

    Returns:
        [N] which beams return from the air.
    """
    count = len(range_m)
    from_air = np.zeros(count, np.bool_)
    if air.backscatter_per_m_sr <= 0.0:
        return from_air
    share = 1.0 - math.exp(-air.drops / DROP_MMPH) if air.drops > 0.0 else 1.0
    reflectivity = math.pi * air.backscatter_per_m_sr * pulse_m / share
    for i in range(count):
        if chance[i, 0] > share:
            continue
        r = NEAREST_CLUTTER_M + CLUTTER_DEPTH_M * chance[i, 1] ** 2
        if r >= min(range_m[i], max_range_m):
            continue
        there = reflectivity * math.exp(-2.0 * air.lidar_extinction_per_m * r)
        there *= -math.log(max(chance[i, 2], 1e-6))
        echo = there * (LIDAR_REFERENCE_M / r) ** 2
        if chance[i, 3] > echo / (echo + LIDAR_THRESHOLD):
            continue
        of_surface = intensity[i] / INTENSITY_OF_WHITE * (LIDAR_REFERENCE_M / max(range_m[i], 1.0)) ** 2
        if returned[i] and of_surface > echo:
            continue
        from_air[i] = returned[i] = True
        range_m[i], intensity[i] = r, min(INTENSITY_OF_WHITE * there, 1.0)
    return from_air
