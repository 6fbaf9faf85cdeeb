"""Lidar returns from surfaces and from the air in front of them."""

import math
from typing import no_type_check

import numba
import numpy as np

from foredrive.towns.place.materials import Texture
from foredrive.towns.sensing.patterns import TEXTURE_WORDS
from foredrive.towns.sensing.textures import PAINT_REFLECTIVITY, texture
from foredrive.towns.sensing.wet import LEVEL_COS, is_paved, water_film

MISS = -1
GLASS_LOSS = 0.8
"""Share of a lidar pulse that a window transmits or mirrors away."""
LIDAR_REFERENCE_M = 45.0
"""Distance, m, at which half of the pulses are lost for 2 % reflectivity at perpendicular incidence."""
LIDAR_THRESHOLD = 0.02
INTENSITY_OF_WHITE = 100.0 / 255.0
RETROREFLECTED = 0.3
"""Independence of painted lines, which contain glass beads, from the angle of incidence, 0 to 1."""
FOLIAGE_DEPTH_M = 0.25
WET_LIDAR_LOSS, FILM_LIDAR_LOSS = 0.35, 0.75
"""Share of the dry surface's echo that is lost: on a soaked surface, and below a film of water."""
MIN_CLUTTER_M, CLUTTER_DEPTH_M = 1.2, 9.0
"""Range of clutter, m. Closer, the laser does not overlap with the detector's field of view. Further away,
clutter is too weak."""
DROP_MMPH = 150.0
"""Scale of the rain rate R, mm/h. The share of pulses that hit a drop large enough to be measured is
1 - exp(-R / `DROP_MMPH`)."""

_FOLIAGE = int(Texture.FOLIAGE)
_kernel = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)


@_kernel
@no_type_check
def lidar_returns(materials, surfaces, t, max_range_m, chance, air):
    """Compute which beams return, their ranges and their intensities.

    The echo of a surface of reflectivity ρ at an angle of incidence θ is proportional to ρ cos θ exp(-2 α r)
    / r², where α is the extinction of the air, 1/m. The echo is lost with a probability that rises as it
    falls to the detector's threshold. A film of water mirrors most of the pulse away from level ground.

    Args:
        materials: `MaterialArrays`.
        surfaces: `Surfaces` that the beams hit.
        t: [N] distances of the hits, m.
        max_range_m: maximum range, m.
        chance: [N 2] uniform random numbers: for the loss, and for the depth within foliage.
        air: `AirArrays`.

    Returns:
        range [N] m, up to the surface if a beam was lost; returned [N]; intensity [N] in 0..1, calibrated as
        by the makers of real lidars. It is the reflectance, in percent of 255, of a white matt surface that
        materials equally bright at perpendicular incidence. Only retroreflective surfaces exceed 100/255.
    """
    count = len(t)
    range_m = np.empty(count, np.float32)
    returned = np.zeros(count, np.bool_)
    intensity = np.zeros(count, np.float32)
    colour = np.empty(TEXTURE_WORDS, np.float32)
    for i in range(count):
        material = surfaces.material[i]
        range_m[i] = max_range_m
        if material == MISS or t[i] > max_range_m:
            continue
        # The material at the hit, filtered over the beam's footprint
        texture(materials, material, surfaces.xyz, surfaces.uvw, surfaces.extent, i, colour)
        glass, paint, cosine = colour[3], colour[4], surfaces.cosine[i]
        # Paint with glass beads is brighter; windows transmit or mirror most of the pulse
        reflectivity = materials.reflectivity[material] * (1.0 - paint) + PAINT_REFLECTIVITY * paint
        reflectivity *= 1.0 - GLASS_LOSS * glass
        # Wet surfaces return less, and level ones below water almost nothing
        if air.wetness > 0.0:
            level = abs(surfaces.normal[i, 2]) > LEVEL_COS and is_paved(materials.surface[material])
            film = 0.0
            if level:
                film = water_film(air.wetness, materials.surface[material], surfaces.xyz, surfaces.extent, i)
            reflectivity *= (1.0 - WET_LIDAR_LOSS * air.wetness) * (1.0 - FILM_LIDAR_LOSS * film)
        # The range is known whether the beam returns or not
        range_m[i] = t[i]
        dimmed = math.exp(-2.0 * air.lidar_extinction_per_m * t[i])
        # Relative to the echo that is lost half of the time
        echo = reflectivity * cosine * dimmed * (LIDAR_REFERENCE_M / max(t[i], 1.0)) ** 2
        if chance[i, 0] < echo / (echo + LIDAR_THRESHOLD):
            returned[i] = True
            # Retroreflectors return the same at all angles; the intensity has no cosine for them
            back = 1.0 if materials.reflectivity[material] > 1.0 else RETROREFLECTED * paint
            facing = cosine + (1.0 - cosine) * back
            intensity[i] = min(INTENSITY_OF_WHITE * reflectivity * facing * dimmed, 1.0)
            if materials.texture[material] == _FOLIAGE:
                range_m[i] += FOLIAGE_DEPTH_M * chance[i, 1]
    return range_m, returned, intensity


@_kernel
@no_type_check
def air_returns(air, chance, pulse_m, max_range_m, range_m, returned, intensity):
    """Replace returns by echoes of fog and rain in front of the surface if those are stronger.

    For a pulse of length 2 ΔR, the air at range r acts like a surface of reflectivity π β ΔR, where β is the
    air's backscatter (the lidar equation for an extended target). Fog gives a continuous echo with
    fluctuating strength. In rain the echo is concentrated in the few pulses that hit a large drop.

    Args:
        air: `AirArrays`.
        chance: [N 4] uniform random numbers.
        pulse_m: ΔR, m.
        max_range_m: maximum range, m.
        range_m: [N] range of the surface, changed in place; `returned` and `intensity` likewise.

    Returns:
        [N] whether each beam returns from the air.
    """
    count = len(range_m)
    from_air = np.zeros(count, np.bool_)
    if air.backscatter_per_m_sr <= 0.0:
        return from_air
    # In rain the whole backscatter is concentrated on the pulses that hit a large drop
    share = 1.0 - math.exp(-air.rain_mmph / DROP_MMPH) if air.rain_mmph > 0.0 else 1.0
    reflectivity = math.pi * air.backscatter_per_m_sr * pulse_m / share
    for i in range(count):
        if chance[i, 0] > share:
            continue
        # Near ranges are more frequent
        r = MIN_CLUTTER_M + CLUTTER_DEPTH_M * chance[i, 1] ** 2
        if r >= min(range_m[i], max_range_m):
            continue
        power = reflectivity * math.exp(-2.0 * air.lidar_extinction_per_m * r)
        # Exponential fluctuation of the strength (speckle)
        power *= -math.log(max(chance[i, 2], 1e-6))
        echo = power * (LIDAR_REFERENCE_M / r) ** 2
        if chance[i, 3] > echo / (echo + LIDAR_THRESHOLD):
            continue
        # The lidar reports the stronger of both echoes
        of_surface = intensity[i] / INTENSITY_OF_WHITE * (LIDAR_REFERENCE_M / max(range_m[i], 1.0)) ** 2
        if returned[i] and of_surface > echo:
            continue
        from_air[i] = returned[i] = True
        range_m[i], intensity[i] = r, min(INTENSITY_OF_WHITE * power, 1.0)
    return from_air
