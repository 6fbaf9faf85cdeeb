"""Echoes of a lidar: from the rays of a beam's footprint to the one echo that the lidar reports."""

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float32, Int64

Echoes = tuple[Float32[np.ndarray, "_"], Bool[np.ndarray, "_"], Float32[np.ndarray, "_"]]
"""Range (m), whether the beam returned, and intensity."""

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")


@_kernel
@no_type_check
def group_echoes(t, pulse_m):
    """Group the rays of each beam into echoes: rays that end within a pulse's depth make one echo.

    Args:
        t: [B n] distances at which the rays of B beams end, m; infinite where they hit nothing.
        pulse_m: depth of a pulse, m.

    Returns:
        group [B n], numbered by range; share [B n] of the beam's rays that belong to a ray's echo.
    """
    beams, n = t.shape
    group, share = np.empty((beams, n), np.int64), np.empty((beams, n), np.float32)
    for b in range(beams):
        order = np.argsort(t[b])
        number, start = 0, 0
        # Sorted by range, an echo grows while the rays lie within one pulse from its first
        for k in range(n + 1):
            if k < n and (k == start or t[b, order[k]] - t[b, order[start]] <= pulse_m):
                group[b, order[k]] = number
                continue
            # Close the echo: each of its rays gets the share of the beam that it stands for
            for j in range(start, k):
                share[b, order[j]] = (k - start) / n
            if k < n:
                number, start = number + 1, k
                group[b, order[k]] = number
    return group, share


def footprint_chance(
    chance: Float32[np.ndarray, "B K"], share: Float32[np.ndarray, "B n"]
) -> Float32[np.ndarray, "R K"]:
    """Convert the random numbers of whole beams to those of the R = B · n rays of their footprints.

    The first number decides the loss. A beam with an echo e is lost if its number c is above e / (e + T). An
    echo s · e is lost by the same c with odds c / (1 - c) that are 1/s times as high.
    """
    of_rays = np.repeat(chance, share.shape[1], axis=0)
    c = of_rays[:, 0]
    of_rays[:, 0] = c / (c + share.ravel() * (1.0 - c))
    return of_rays


@_kernel
@no_type_check
def _pick(group, range_m, returned, intensity, last, out_range, out_returned, out_intensity, out_ray):
    beams, n = group.shape
    for b in range(beams):
        # Energy of each echo: sum of intensity over r²; groups are
        # numbered by range, so the last wins for `last`
        best, picked = -1.0, -1
        for g in range(n):
            energy = 0.0
            for k in range(n):
                if group[b, k] == g and returned[b, k]:
                    energy += intensity[b, k] / max(range_m[b, k], 1.0) ** 2
            if energy > 0.0 and (last or energy > best):
                best, picked = energy, g
        out_returned[b] = picked >= 0
        # Without an echo take the nearest ray; else the weighted mean range and the strongest ray
        total, weighted, ray = 0.0, 0.0, 0
        for k in range(n):
            if picked < 0:
                if range_m[b, k] < range_m[b, ray]:
                    ray = k
            elif group[b, k] == picked and returned[b, k]:
                if total == 0.0 or intensity[b, k] > intensity[b, ray]:
                    ray = k
                total += intensity[b, k]
                weighted += intensity[b, k] * range_m[b, k]
        out_range[b] = range_m[b, ray] if picked < 0 else weighted / total
        out_intensity[b] = total / n
        out_ray[b] = ray


def pick_echo(
    group: Int64[np.ndarray, "B n"], of_rays: Echoes, last: bool
) -> tuple[Echoes, Int64[np.ndarray, "B"]]:
    """Return the strongest or the last echo of each beam.

    Ranges within an echo are averaged with the intensity as weight. This gives the points between an edge and
    a surface close behind it that real lidars measure. The intensity is that of the part of the footprint
    that returned.

    Args:
        group: groups from `group_echoes`.
        of_rays: echoes of the R = B · n rays, with those of a beam next to each other.
        last: take the last echo instead of the strongest.

    Returns:
        The echoes of the beams, with the range of the nearest ray where nothing returned; and for each beam
        the index of the ray (of R) that contributed most.
    """
    beams, n = group.shape
    echo = (np.empty(beams, np.float32), np.empty(beams, np.bool_), np.empty(beams, np.float32))
    ray = np.empty(beams, np.int64)
    range_m, returned, intensity = (column.reshape(beams, n) for column in of_rays)
    _pick(group, range_m, returned, intensity, last, *echo, ray)
    return echo, np.arange(beams) * n + ray
