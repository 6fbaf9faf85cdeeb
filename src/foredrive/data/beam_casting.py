"""Ray casting of lidar beams through a voxel grid (numba).

`no_type_check` keeps the tests' shape checks out of the code that numba compiles.
"""

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float64, UInt8

UNKNOWN, FREE, OCCUPIED, SEEN = 0, 1, 2, 3
"""States of a voxel. SEEN is OCCUPIED, and the first such voxel on a line of sight."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def cast_beams(
    origin: Float64[np.ndarray, "N 3"],
    end: Float64[np.ndarray, "N 3"],
    free_until: Float64[np.ndarray, "N"],
    state_zyx: UInt8[np.ndarray, "Z Y X"],
    opaque: bool = False,
) -> None:
    """Change the UNKNOWN voxels that a beam passes through to FREE.

    The traversal is exact (Amanatides and Woo, A Fast Voxel Traversal Algorithm for Ray Tracing, 1987). It
    visits every voxel whose interior the beam crosses once. It uses scalars and a flat index, because small
    arrays in the inner loop make it seven times slower.

    Args:
        origin: start of each beam, in voxels from the grid's lower corner, x y z.
        end: end of each beam, in the same coordinates.
        free_until: fraction of the way from origin to end up to which the beam is known to be free.
        state_zyx: contiguous state of the voxels, changed in place.
        opaque: end at the first voxel that is OCCUPIED, and change it to SEEN.
    """
    nz, ny, nx = state_zyx.shape
    state = state_zyx.reshape(-1)
    for beam in range(origin.shape[0]):
        ox, oy, oz = origin[beam, 0], origin[beam, 1], origin[beam, 2]
        dx, dy, dz = end[beam, 0] - ox, end[beam, 1] - oy, end[beam, 2] - oz
        # The part of the beam inside the grid, as fractions of the way from origin to end
        enter, leave = _clip(ox, dx, nx, 0.0, free_until[beam])
        enter, leave = _clip(oy, dy, ny, enter, leave)
        enter, leave = _clip(oz, dz, nz, enter, leave)
        if not enter < leave:
            continue
        x, step_x, next_x, delta_x = _start(ox, dx, nx, enter)
        y, step_y, next_y, delta_y = _start(oy, dy, ny, enter)
        z, step_z, next_z, delta_z = _start(oz, dz, nz, enter)
        cell = np.uint64((z * ny + y) * nx + x)
        while True:
            if opaque and state[cell] >= OCCUPIED:
                state[cell] = SEEN
                break
            if state[cell] == UNKNOWN:
                state[cell] = FREE
            # Step across the nearest voxel border
            if next_x <= next_y and next_x <= next_z:
                x += step_x
                if next_x >= leave or x < 0 or x >= nx:
                    break
                cell += np.uint64(step_x)
                next_x += delta_x
            elif next_y <= next_z:
                y += step_y
                if next_y >= leave or y < 0 or y >= ny:
                    break
                cell += np.uint64(step_y * nx)
                next_y += delta_y
            else:
                z += step_z
                if next_z >= leave or z < 0 or z >= nz:
                    break
                cell += np.uint64(step_z * ny * nx)
                next_z += delta_z


@numba.njit(inline="always", error_model="numpy")
@no_type_check
def _clip(o: float, d: float, size: int, enter: float, leave: float) -> tuple[float, float]:
    """Narrow the interval of a beam o + t d to the part between 0 and `size` on one axis."""
    if d == 0.0:
        return enter, (leave if 0.0 <= o < size else -1.0)
    near, far = -o / d, (size - o) / d
    return max(enter, min(near, far)), min(leave, max(near, far))


@numba.njit(inline="always", error_model="numpy")
@no_type_check
def _start(o: float, d: float, size: int, enter: float) -> tuple[int, int, float, float]:
    """Return, for one axis: cell at t = enter, step, t at the next border, and t between borders."""
    cell = min(max(int(np.floor(o + enter * d)), 0), size - 1)
    if d > 0.0:
        return cell, 1, (cell + 1 - o) / d, 1.0 / d
    if d < 0.0:
        return cell, -1, (cell - o) / d, -1.0 / d
    return cell, 0, np.inf, np.inf


@numba.njit(cache=True, nogil=True)
@no_type_check
def box_of_points(
    points: Float64[np.ndarray, "N 3"],
    centre: Float64[np.ndarray, "M 3"],
    half_lwh: Float64[np.ndarray, "M 3"],
    yaw: Float64[np.ndarray, "M"],
) -> np.ndarray:
    """Return the index of the box that contains each point, -1 for none.

    Where boxes overlap, it is the box with the nearest centre.

    Returns:
        Int64 [N].
    """
    box_index = np.full(len(points), -1, np.int64)
    nearest2 = np.full(len(points), np.inf)
    for box in range(len(centre)):
        cos, sin = np.cos(yaw[box]), np.sin(yaw[box])
        # The circle around the footprint excludes most points cheaply
        reach2 = half_lwh[box, 0] ** 2 + half_lwh[box, 1] ** 2
        for n in range(len(points)):
            x, y = points[n, 0] - centre[box, 0], points[n, 1] - centre[box, 1]
            flat2 = x * x + y * y
            if flat2 > reach2:
                continue
            z = points[n, 2] - centre[box, 2]
            if (
                abs(cos * x + sin * y) <= half_lwh[box, 0]
                and abs(cos * y - sin * x) <= half_lwh[box, 1]
                and abs(z) <= half_lwh[box, 2]
                and flat2 + z * z < nearest2[n]
            ):
                box_index[n] = box
                nearest2[n] = flat2 + z * z
    return box_index
