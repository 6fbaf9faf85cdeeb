"""Light of street lamps and vehicles: the lamps near a place, and their light on a point."""

import math
from collections.abc import Sequence
from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Float, Float32, Float64, Int32

from foredrive.data.log_writer import EGO_VEHICLE
from foredrive.scene import Category
from foredrive.scene.actors import ActorState

UNIT_LUX = 65_000.0
"""Illuminance under which a white diffuse surface has radiance 1, lx."""
STREET, HEAD, TAIL = 0, 1, 2
STREET_CD = 3200.0
"""Intensity of a street lamp, cd: constant from straight down to the cut-off."""
STREET_RGB, HEAD_RGB, TAIL_RGB = (1.0, 0.80, 0.55), (1.0, 0.94, 0.84), (1.0, 0.06, 0.03)
HEAD_CD = 40_000.0
"""Maximum intensity of a pair of dipped headlights, cd (UN Regulation 112 requires 10 to 44 klx·m² each)."""
TAIL_CD = 20.0
DIPPED_RAD = math.radians(1.2)
HEAD_SPREAD_RAD, HEAD_DEPTH_RAD = math.radians(23.0), math.radians(3.6)
ABOVE_CUT_OFF = 0.012
REACH_M = (26.0, 70.0, 9.0)
"""Range of lamps by kind, m. Beyond it their light is negligible."""
CELL_M, CELLS = 10.0, 40
"""Cell size (m) and number of cells per side of the grid around the vehicle in which lamps are looked up."""
LIT_CATEGORIES = (Category.CAR, Category.TRUCK, Category.BUS, Category.MOTORCYCLE)


class LampArrays(NamedTuple):
    """K lamps and, for each cell of a grid, the lamps whose light reaches it."""

    xyz: Float32[np.ndarray, "K 3"]
    heading: Float32[np.ndarray, "K 2"]
    """Unit direction of a headlight or tail light."""
    rgb: Float32[np.ndarray, "K 3"]
    """Intensity divided by `UNIT_LUX`, m²."""
    kind: Int32[np.ndarray, "K"]
    origin_xy: Float64[np.ndarray, "2"]
    first: Int32[np.ndarray, "cells+1"]
    """Index in `lamp_index` at which the lamps of each cell start."""
    lamp_index: Int32[np.ndarray, "n"]


_kernel = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)


def gather_lamps(
    street_xyz: Float[np.ndarray, "S 3"],
    actors: Sequence[ActorState],
    T_world_ego: Float64[np.ndarray, "4 4"],
) -> LampArrays:
    """Gather the lamps near the vehicle: street lamps, lamps of other vehicles, and its own."""
    centre = T_world_ego[:2, 3]
    origin = centre - 0.5 * CELL_M * CELLS
    # Lamps beyond the grid can still reach into it
    close = (np.abs(street_xyz[:, :2] - centre) < 0.5 * CELL_M * CELLS + REACH_M[STREET]).all(1)
    lamps: list[tuple[Sequence[float], Sequence[float], int]] = [
        (xyz, (0.0, 0.0), STREET) for xyz in street_xyz[close].tolist()
    ]
    ahead, length = T_world_ego[:3, 0], EGO_VEHICLE.length
    # The vehicle's own lamps: middle of its body, 0.65 m above the road
    middle = T_world_ego[:3, 3] + EGO_VEHICLE.rear_axle_to_center_longitudinal * ahead
    middle = middle + 0.65 * T_world_ego[:3, 2]
    lamps += _pair(middle, float(np.arctan2(ahead[1], ahead[0])), length)
    for actor in actors:
        if actor.category in LIT_CATEGORIES:
            height = -0.5 * actor.size_lwh[2] + min(0.5 * actor.size_lwh[2], 0.75)
            middle = actor.centre_m + np.array([0.0, 0.0, height])
            lamps += _pair(middle, actor.yaw, float(actor.size_lwh[0]))
    xyz = np.array([lamp[0] for lamp in lamps], dtype=np.float32)
    heading = np.array([lamp[1] for lamp in lamps], dtype=np.float32)
    kind = np.array([lamp[2] for lamp in lamps], dtype=np.int32)
    # Intensities relative to `UNIT_LUX`, so that irradiance is in units of the radiance scale
    power = np.array([STREET_CD, HEAD_CD, TAIL_CD])[:, None] * [STREET_RGB, HEAD_RGB, TAIL_RGB] / UNIT_LUX
    first, near = _into_cells(xyz, kind, heading, origin, np.array(REACH_M))
    return LampArrays(xyz, heading, power[kind].astype(np.float32), kind, origin, first, near)


def _pair(
    middle: Float[np.ndarray, "3"], yaw: float, length: float
) -> list[tuple[Sequence[float], Sequence[float], int]]:
    """Return the head and tail lights of a vehicle, each pair as one lamp."""
    heading = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    front, rear = middle + 0.52 * length * heading, middle - 0.52 * length * heading
    return [
        (front.tolist(), heading[:2].tolist(), HEAD),
        (rear.tolist(), (-heading[:2]).tolist(), TAIL),
    ]


@_kernel
@no_type_check
def _into_cells(xyz, kind, heading, origin, reach_m):
    """Return lists of the lamps that reach each cell.

    Headlights and tail lights reach only cells ahead of them.
    """
    counts = np.zeros(CELLS * CELLS + 1, np.int32)
    near = np.empty(0, np.int32)
    half = 0.7072 * CELL_M
    # Two passes over the same loops: count the entries of each cell, then write them
    for fill in range(2):
        for k in range(len(xyz)):
            r = reach_m[kind[k]]
            x, y = xyz[k, 0] - origin[0], xyz[k, 1] - origin[1]
            for row in range(max(int((y - r) // CELL_M), 0), min(int((y + r) // CELL_M) + 1, CELLS)):
                for column in range(max(int((x - r) // CELL_M), 0), min(int((x + r) // CELL_M) + 1, CELLS)):
                    cx, cy = (column + 0.5) * CELL_M - x, (row + 0.5) * CELL_M - y
                    # Lamp's reach against the circle around the cell
                    if cx * cx + cy * cy > (r + half) ** 2:
                        continue
                    if kind[k] != STREET:
                        # Vehicle lamps light a sector of ±45° ahead of them
                        along = cx * heading[k, 0] + cy * heading[k, 1]
                        aside = abs(cx * heading[k, 1] - cy * heading[k, 0])
                        if along < -half or aside > along + 2.0 * half:
                            continue
                    cell = row * CELLS + column
                    if fill:
                        near[counts[cell]] = k
                        counts[cell] += 1
                    else:
                        counts[cell + 1] += 1
        if not fill:
            # Prefix sums: the start of each cell's list
            counts = np.cumsum(counts).astype(np.int32)
            near = np.empty(counts[-1], np.int32)
    first = np.empty_like(counts)  # filling moved the start of each cell to its end
    first[0] = 0
    first[1:] = counts[:-1]
    return first, near


@_kernel
@no_type_check
def relative_intensity(kind, hx, hy, lx, ly, lz):
    """Return the share of a lamp's intensity that it emits along the unit vector (lx, ly, lz)."""
    if kind == STREET:  # cut off at 78° from straight down
        return min(max(5.0 * (-lz - 0.2), 0.0), 1.0)
    ahead = lx * hx + ly * hy
    if ahead <= 0.05:
        return 0.0
    if kind == TAIL:
        return ahead
    # Angles from the beam's axis, in units of its spread; the cut-off lies below the horizon
    aside = math.atan2(lx * hy - ly * hx, ahead) / HEAD_SPREAD_RAD
    up = (math.asin(min(max(lz, -1.0), 1.0)) + DIPPED_RAD) / HEAD_DEPTH_RAD
    # a soft edge, and stray light above it
    high = max(math.exp(-((up * 6.0) ** 2)), ABOVE_CUT_OFF) if up > 0.0 else math.exp(up * 0.9)
    return high * math.exp(-aside * aside)


@_kernel
@no_type_check
def lamp_light(lamps, x, y, z, nx, ny, nz, dx, dy, dz, shine, out):
    """Compute the light of lamps at a point.

    Args:
        lamps: `LampArrays`.
        x, y, z: the point, m.
        nx, ny, nz: its unit normal.
        dx, dy, dz: the unit viewing direction.
        shine: exponent of the mirrored highlight (Blinn-Phong); 0 for none.
        out: [6] receives the irradiance as the radiance of a white surface, then the radiance of the
            highlight as for a perfect mirror.
    """
    for c in range(6):
        out[c] = 0.0
    # Cell of the point; beyond the grid there is no lamp light
    column, row = (x - lamps.origin_xy[0]) // CELL_M, (y - lamps.origin_xy[1]) // CELL_M
    if not (0 <= column < CELLS and 0 <= row < CELLS):
        return
    cell = int(row) * CELLS + int(column)
    for item in range(lamps.first[cell], lamps.first[cell + 1]):
        k = lamps.lamp_index[item]
        lx, ly, lz = x - lamps.xyz[k, 0], y - lamps.xyz[k, 1], z - lamps.xyz[k, 2]
        # The smallest distance is limited, so that surfaces at a lamp are not infinitely bright
        square = max(lx * lx + ly * ly + lz * lz, 0.05)
        scale = 1.0 / math.sqrt(square)
        lx, ly, lz = lx * scale, ly * scale, lz * scale
        # Lambert: cosine between normal and direction to the lamp, and 1 / r²
        facing = -(nx * lx + ny * ly + nz * lz)
        if facing <= 0.0:
            continue
        sent = (
            relative_intensity(lamps.kind[k], lamps.heading[k, 0], lamps.heading[k, 1], lx, ly, lz) / square
        )
        if shine > 0.0:
            # Blinn-Phong: half vector between light and viewer, with an energy-preserving scale
            hx, hy, hz = -lx - dx, -ly - dy, -lz - dz
            length = math.sqrt(hx * hx + hy * hy + hz * hz)
            middle = max((nx * hx + ny * hy + nz * hz) / max(length, 1e-6), 0.0)
            lobe = (shine + 8.0) / 8.0 * middle**shine
            for c in range(3):
                out[3 + c] += lamps.rgb[k, c] * sent * lobe
        for c in range(3):
            out[c] += lamps.rgb[k, c] * sent * facing


NO_LAMPS = LampArrays(
    np.zeros((0, 3), np.float32),
    np.zeros((0, 2), np.float32),
    np.zeros((0, 3), np.float32),
    np.zeros(0, np.int32),
    np.zeros(2),
    np.zeros(CELLS * CELLS + 1, np.int32),
    np.zeros(0, np.int32),
)
