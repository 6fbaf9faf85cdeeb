"""Beams of lamps in fog: light that droplets scatter once on its way to the viewer."""

import math
from typing import no_type_check

import numba
import numpy as np

from foredrive.towns.sensing.lamps import DIPPED_RAD, HEAD, relative_intensity

ASYMMETRY = 0.54
"""Asymmetry of the phase function (Henyey & Greenstein, Astrophysical Journal 93, 1941). With this value the
fog's backscatter agrees with that for lidars, `air.BACKSCATTER_RATIO`."""
MAX_LATERAL_M = np.array([16.0, 25.0, 3.0], dtype=np.float32)
"""Distance from a lamp beyond which a ray shows nothing of its beam, by kind of lamp, m. Fog reduces it."""
SPREAD_M = np.array([0.25, 0.8, 0.8], dtype=np.float32)
"""Half the width of a lamp, by kind of lamp, m. The lamps of a vehicle represent a pair."""
STEPS = np.array([5, 8, 3])
"""Steps along a ray, by kind of lamp. Above the cut-off of headlights there are `STRAY_STEPS`."""
STRAY_STEPS = 3
EDGE_SLOPE = 0.7 * DIPPED_RAD
"""Slope of the cut-off of headlights."""
MAX_OPTICAL_DEPTH = 3.0
"""Optical depth beyond which nothing is visible."""

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)


@_kernel
@no_type_check
def phase(cosine):
    """Return the phase function: the share of scattered light per solid angle, 1/sr, at a deflection
    angle."""
    # Henyey-Greenstein: (1 - g²) / (4π (1 + g² - 2 g cos θ)^(3/2))
    square = 1.0 + ASYMMETRY * ASYMMETRY - 2.0 * ASYMMETRY * cosine
    return (1.0 - ASYMMETRY * ASYMMETRY) / (4.0 * math.pi * square * math.sqrt(square))


@_kernel
@no_type_check
def _visible_lamps(lamps, extinction_per_m, origin):
    """Return the indices of the lamps whose light can be visible for rays from about there."""
    index = np.empty(len(lamps.xyz), np.int64)
    count = 0
    for k in range(len(lamps.xyz) if len(origin) > 0 else 0):
        # Only the distance seen from above counts, from the first ray's origin
        x, y = lamps.xyz[k, 0] - origin[0, 0], lamps.xyz[k, 1] - origin[0, 1]
        if math.hypot(x, y) < MAX_OPTICAL_DEPTH / extinction_per_m + MAX_LATERAL_M[lamps.kind[k]]:
            index[count] = k
            count += 1
    return index[:count]


@_kernel
@no_type_check
def add_beams(lamps, extinction_per_m, t, origin, direction, is_known, radiance):
    """Add to `radiance` [N 3] the light of lamps that the air scatters along rays.

    Args:
        lamps: `LampArrays`.
        extinction_per_m: extinction of visible light, 1/m.
        t: [N] distances at which the rays end, m.
        origin: [N 3] starts of the rays, within metres of one another.
        direction: [N 3] unit directions of the rays.
        is_known: [N 3] not negative for rays that do not change; or [0 3].
    """
    seen = _visible_lamps(lamps, extinction_per_m, origin)
    for i in range(len(t)):
        if len(is_known) > 0 and is_known[i, 0] >= 0.0:
            continue
        end = min(t[i], MAX_OPTICAL_DEPTH / extinction_per_m)
        dx, dy, dz = direction[i, 0], direction[i, 1], direction[i, 2]
        for k in seen:
            px, py, pz = lamps.xyz[k, 0], lamps.xyz[k, 1], lamps.xyz[k, 2]
            px, py, pz = px - origin[i, 0], py - origin[i, 1], pz - origin[i, 2]
            # Point of the ray nearest to the lamp: its distance along the
            # ray, and its squared distance from the lamp
            along, lateral_m = px * dx + py * dy + pz * dz, MAX_LATERAL_M[lamps.kind[k]]
            near = px * px + py * py + pz * pz - along * along
            # Skip lamps that the ray passes at too great a distance
            if near > lateral_m * lateral_m or along > end + lateral_m or along < -lateral_m:
                continue
            # Fog narrows the visible beam with its distance from the viewer
            lateral_m *= math.exp(-extinction_per_m * max(along, 0.0))
            if near > lateral_m * lateral_m:
                continue
            sent = _scattered(lamps, k, extinction_per_m, px, py, pz, dx, dy, dz, along, near, end)
            # Fade out towards the limit, so that it is not visible as an edge
            sent *= 1.0 - near / (lateral_m * lateral_m)
            for c in range(3):
                radiance[i, c] += lamps.rgb[k, c] * sent


@_kernel
@no_type_check
def _scattered(lamps, k, extinction_per_m, px, py, pz, dx, dy, dz, along, near, end):
    """Return the light of the k-th lamp that a ray collects, as the radiance of a white surface.

    The lamp is at (px, py, pz) from the ray's origin. The point of the ray nearest to the lamp is at distance
    `along` on the ray, and `near` is its squared distance from the lamp. Equal angles seen from the lamp
    contain equal shares of its light (Kulla & Fajardo, Importance sampling techniques for path tracing in
    participating media, 2012). Most light of a headlight is just below its cut-off.
    """
    hx, hy, kind = lamps.heading[k, 0], lamps.heading[k, 1], lamps.kind[k]
    # Equi-angular sampling: s = along + aside · tan φ, with φ from start to stop
    aside = math.sqrt(near + SPREAD_M[kind] ** 2)
    start, stop = math.atan(-along / aside), math.atan((end - along) / aside)
    edge = start
    if kind == HEAD and dz < -1e-3:
        # Where the ray crosses the lamp's cut-off: iterate, because the cut-off falls with distance
        s = pz / dz
        for _ in range(2):
            below = EDGE_SLOPE * abs((s * dx - px) * hx + (s * dy - py) * hy)
            s = (pz - below) / dz
        edge = min(max(math.atan((s - along) / aside), start), stop)
    total = 0.0
    for part in range(2):
        # First the part above the cut-off, then the part below it
        first, last = (start, edge) if part == 0 else (edge, stop)
        if last <= first:
            continue
        steps = STRAY_STEPS if last == edge else STEPS[kind]
        for n in range(steps):
            u = (n + 0.5) / steps
            weight = 1.0
            if edge > start and part == 1:  # more of the steps near the cut-off
                # u² puts more steps near the cut-off; its derivative 2 u is the weight
                weight, u = 2.0 * u, u * u
            s = along + aside * math.tan(first + u * (last - first))
            lx, ly, lz = s * dx - px, s * dy - py, s * dz - pz
            # Unit vector from the lamp to the sample; the small number avoids a division by zero
            r = math.sqrt(lx * lx + ly * ly + lz * lz) + 1e-3
            lx, ly, lz = lx / r, ly / r, lz / r
            sent = relative_intensity(kind, hx, hy, lx, ly, lz)
            if sent > 0.0:
                # Deflection from the lamp's light to the direction towards the eye
                towards_eye = -(lx * dx + ly * dy + lz * dz)
                # Attenuation on the way from the lamp and on the way to the eye
                sent *= phase(towards_eye) * math.exp(-extinction_per_m * (s + r))
                total += weight * sent * (last - first) / steps
    return math.pi * extinction_per_m * total / aside
