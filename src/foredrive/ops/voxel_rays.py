"""The first occupied voxel on a ray: a numba kernel, and a plain NumPy reference beside it.

Both step from voxel border to voxel border as the renderer of RayIoU does (MCG-NJU/SparseOcc, lib/dvr/dvr.cu;
Amanatides and Woo, A Fast Voxel Traversal Algorithm for Ray Tracing, 1987): the same order at edges and
corners, the same sums in double precision. `data.beam_casting` marks all voxels on a beam instead.

`no_type_check` keeps the tests' shape checks out of the code that numba compiles.
"""

from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from foredrive.ops.threads import in_parallel

MIN_RAYS = 1024
"""Minimum number of rays per thread."""


class RayEnds(NamedTuple):
    """The voxel in which each ray ends, and the distance at which the ray leaves this voxel.

    A ray that meets nothing occupied ends in the last voxel on its way. One that passes beside the grid has
    voxel -1 and distance -1.
    """

    voxel: Int64[ndarray, "N"]
    """Flat index into Z Y X."""
    distance: Float64[ndarray, "N"]
    """From the ray's origin, in voxels."""


def first_hits(
    origin: Float64[ndarray, "N 3"], direction: Float64[ndarray, "N 3"], occupied_zyx: Bool[ndarray, "Z Y X"]
) -> RayEnds:
    """Return where rays end in a grid.

    Args:
        origin: in voxels from the grid's lower corner, x y z, finite. It may lie outside the grid. The ray
            starts in the voxel of the origin rounded towards zero, as in the public renderer.
        direction: unit vectors, x y z.
        occupied_zyx: the voxels that stop a ray.
    """
    voxel, distance = np.empty(len(origin), np.int64), np.empty(len(origin))
    origin, direction = np.ascontiguousarray(origin), np.ascontiguousarray(direction)
    occupied_zyx = np.ascontiguousarray(occupied_zyx)

    def job(start: int, stop: int) -> None:
        _first_hits(origin, direction, occupied_zyx, start, stop, voxel, distance)

    in_parallel(job, len(origin), grain=MIN_RAYS)
    return RayEnds(voxel, distance)


@numba.njit(cache=True, nogil=True, error_model="numpy")
# origin and direction Float64[N 3] in voxels, occupied_zyx Bool[Z Y X], voxel Int64[N], distance Float64[N]
@no_type_check
def _first_hits(origin, direction, occupied_zyx, start, stop, voxel, distance):
    nz, ny, nx = occupied_zyx.shape
    occupied = occupied_zyx.reshape(-1)
    for ray in range(start, stop):
        # Per axis: cell, step, distance of the next border, distance between borders
        x, step_x, next_x, delta_x = _begin(origin[ray, 0], direction[ray, 0])
        y, step_y, next_y, delta_y = _begin(origin[ray, 1], direction[ray, 1])
        z, step_z, next_z, delta_z = _begin(origin[ray, 2], direction[ray, 2])
        end, end_distance = -1, -1.0
        while True:
            inside = 0 <= x < nx and 0 <= y < ny and 0 <= z < nz
            # Outside: go on only while the ray may still enter the grid
            if not inside and (
                end >= 0 or _leaves(x, step_x, nx) or _leaves(y, step_y, ny) or _leaves(z, step_z, nz)
            ):
                break
            # The last voxel inside is the end unless an occupied one comes first
            if inside:
                end = (z * ny + y) * nx + x
            # Cross the nearest border. The order of the tests decides ties as in the public renderer
            if next_x < next_y and next_x < next_z:
                border = next_x
                x += step_x
                next_x += delta_x
            elif next_y < next_z and next_y <= next_x:
                border = next_y
                y += step_y
                next_y += delta_y
            else:
                border = next_z
                z += step_z
                next_z += delta_z
            # The distance at which the ray leaves the voxel that it was in
            if inside:
                end_distance = border
                if occupied[end]:
                    break
        voxel[ray], distance[ray] = end, end_distance


@numba.njit(inline="always", error_model="numpy")
@no_type_check
def _begin(o, d):
    """Return, for one axis: cell of the origin, step, distance to the next border, distance of borders."""
    # int rounds towards zero, as in the public renderer
    cell = int(o)
    if d > 0.0:
        return cell, 1, (cell + 1 - o) / d, 1.0 / d
    if d < 0.0:
        return cell, -1, (cell - o) / d, -1.0 / d
    # A ray parallel to the axis never crosses its borders
    return cell, 1, np.inf, np.inf


@numba.njit(inline="always")
@no_type_check
def _leaves(cell, step, size):
    """Return whether a ray is outside on one axis and goes further away."""
    return (cell < 0 and step < 0) or (cell >= size and step > 0)


def first_hits_reference(
    origin: Float64[ndarray, "N 3"], direction: Float64[ndarray, "N 3"], occupied_zyx: Bool[ndarray, "Z Y X"]
) -> RayEnds:
    """Return the same as `first_hits`: all rays take each step together."""
    size = np.array(occupied_zyx.shape[::-1])
    cell = np.trunc(origin).astype(np.int64)
    step = np.where(direction >= 0, 1, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Distance of the next border: the upper one for positive steps, else the lower one
        following = np.where(direction != 0, (cell + (step > 0) - origin) / direction, np.inf)
        delta = np.where(direction != 0, step / direction, np.inf)
    voxel, distance = np.full(len(origin), -1), np.full(len(origin), -1.0)
    active = np.arange(len(origin))
    while len(active):
        inside = ((cell >= 0) & (cell < size)).all(axis=1)
        away = (((cell < 0) & (step < 0)) | ((cell >= size) & (step > 0))).any(axis=1)
        # Drop the rays that have left the grid or can no longer enter it
        going = inside | ((voxel[active] < 0) & ~away)
        active, inside = active[going], inside[going]
        cell, step, following, delta = (part[going] for part in (cell, step, following, delta))

        x, y, z = following.T
        # The nearest border, with the same order of tests as in the kernel
        axis = np.where((x < y) & (x < z), 0, np.where((y < z) & (y <= x), 1, 2))
        rows = np.arange(len(active))
        border = following[rows, axis]
        # Record the voxel that each ray is in, and where it leaves it
        entered = cell[inside]
        voxel[active[inside]] = np.ravel_multi_index(tuple(entered.T[::-1]), occupied_zyx.shape)
        distance[active[inside]] = border[inside]
        stopped = np.zeros(len(active), np.bool_)
        stopped[inside] = occupied_zyx[entered[:, 2], entered[:, 1], entered[:, 0]]
        # Step across the border
        cell[rows, axis] += step[rows, axis]
        following[rows, axis] += delta[rows, axis]

        # Rays in an occupied voxel are done; their result is already written
        active = active[~stopped]
        cell, step, following, delta = (part[~stopped] for part in (cell, step, following, delta))
    return RayEnds(voxel, distance)
