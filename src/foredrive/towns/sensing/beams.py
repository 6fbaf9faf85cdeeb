"""Beams of lamps in fog: light that droplets scatter once, on its way to the eye."""

import math
from typing import no_type_check

import numba
import numpy as np

from foredrive.towns.sensing.lamps import DIPPED_RAD, HEAD, beam

ASYMMETRY = 0.54
"""Of the phase function (Henyey & Greenstein, Astrophysical Journal 93, 1941): with it fog sends
straight back what lidars see of it, `air.BACKSCATTER_RATIO`."""
ASIDE_M = np.array([16.0, 25.0, 3.0], dtype=np.float32)
"""Of the kinds of lamps: rays that pass one further away show nothing of it; less where fog dims it."""
SPREAD_M = np.array([0.25, 0.8, 0.8], dtype=np.float32)
"""Half the width of the kinds of lamps: those of a vehicle stand for a pair."""
STEPS = np.array([5, 8, 3])
"""Along a ray; above the cut-off of headlights there are `STRAY_STEPS`."""
STRAY_STEPS = 3
EDGE_SLOPE = 0.7 * DIPPED_RAD
"""Of where headlights are cut off."""
DEPTHS = 3.0
"""Nothing is seen beyond as many optical depths."""

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)


@_kernel
@no_type_check
def phase(cosine):
    """Share of scattered light that goes on at this angle from where it was going, 1/sr."""
    square = 1.0 + ASYMMETRY * ASYMMETRY - 2.0 * ASYMMETRY * cosine
    return (1.0 - ASYMMETRY * ASYMMETRY) / (4.0 * math.pi * square * math.sqrt(square))


@_kernel
@no_type_check
def _within_sight(lamps, extinction_per_m, origin):
    """Indices of the lamps that rays from about there can see anything of."""
    index = np.empty(len(lamps.xyz), np.int64)
    count = 0
    for k in range(len(lamps.xyz) if len(origin) > 0 else 0):
        x, y = lamps.xyz[k, 0] - origin[0, 0], lamps.xyz[k, 1] - origin[0, 1]
        if math.hypot(x, y) < DEPTHS / extinction_per_m + ASIDE_M[lamps.kind[k]]:
            index[count] = k
            count += 1
    return index[:count]


@_kernel
@no_type_check
def add_beams(lamps, extinction_per_m, t, origin, direction, known, radiance):
    """Add to radiance [N 3] what lamps send along rays by way of the air.

    Args:
        lamps: `LampArrays`.
        t: [N] where rays end, m.
        origin: [N 3] where they start: within metres of one another.
        known: [N 3] not negative for rays to be left as they are; or [0 3].
    """
    seen = _within_sight(lamps, extinction_per_m, origin)
    for i in range(len(t)):
        if len(known) > 0 and known[i, 0] >= 0.0:
            continue
        end = min(t[i], DEPTHS / extinction_per_m)
        dx, dy, dz = direction[i, 0], direction[i, 1], direction[i, 2]
        for k in seen:
            px, py, pz = lamps.xyz[k, 0], lamps.xyz[k, 1], lamps.xyz[k, 2]
            px, py, pz = px - origin[i, 0], py - origin[i, 1], pz - origin[i, 2]
            along, aside_m = px * dx + py * dy + pz * dz, ASIDE_M[lamps.kind[k]]
            near = px * px + py * py + pz * pz - along * along
            if near > aside_m * aside_m or along > end + aside_m or along < -aside_m:
                continue
            aside_m *= math.exp(-extinction_per_m * max(along, 0.0))
            if near > aside_m * aside_m:
                continue
            sent = _scattered(lamps, k, extinction_per_m, px, py, pz, dx, dy, dz, along, near, end)
            sent *= 1.0 - near / (aside_m * aside_m)
            for c in range(3):
                radiance[i, c] += lamps.rgb[k, c] * sent


@_kernel
@no_type_check
def _scattered(lamps, k, extinction_per_m, px, py, pz, dx, dy, dz, along, near, end):
    """What a ray gathers of the k-th lamp at (px, py, pz) from the eye, as the radiance of a white surface.

    Its point nearest to the lamp lies `along` it, at the square root of `near`. Equal angles seen from the
    lamp hold equal shares of its light (Kulla & Fajardo, Importance sampling techniques for path tracing in
    participating media, 2012); most of a headlight's falls just below its cut-off.
    """
    hx, hy, kind = lamps.heading[k, 0], lamps.heading[k, 1], lamps.kind[k]
    aside = math.sqrt(near + SPREAD_M[kind] ** 2)
    start, stop = math.atan(-along / aside), math.atan((end - along) / aside)
    edge = start
    if kind == HEAD and dz < -1e-3:
        s = pz / dz
        for _ in range(2):
            below = EDGE_SLOPE * abs((s * dx - px) * hx + (s * dy - py) * hy)
            s = (pz - below) / dz
        edge = min(max(math.atan((s - along) / aside), start), stop)
    total = 0.0
    for part in range(2):
        first, last = (start, edge) if part == 0 else (edge, stop)
        if last <= first:
            continue
        steps = STRAY_STEPS if last == edge else STEPS[kind]
        for n in range(steps):
            u = (n + 0.5) / steps
            weight = 1.0
            if edge > start and part == 1:  # more of the steps near the cut-off
                weight, u = 2.0 * u, u * u
            s = along + aside * math.tan(first + u * (last - first))
            lx, ly, lz = s * dx - px, s * dy - py, s * dz - pz
            r = math.sqrt(lx * lx + ly * ly + lz * lz) + 1e-3
            lx, ly, lz = lx / r, ly / r, lz / r
            sent = beam(kind, hx, hy, lx, ly, lz)
            if sent > 0.0:
                towards_eye = -(lx * dx + ly * dy + lz * dz)
                sent *= phase(towards_eye) * math.exp(-extinction_per_m * (s + r))
                total += weight * sent * (last - first) / steps
    return math.pi * extinction_per_m * total / aside
