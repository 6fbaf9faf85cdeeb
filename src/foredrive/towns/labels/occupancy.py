"""Exact occupancy: every voxel that contains matter, visible or not, with its class and its motion."""

import itertools
from collections.abc import Sequence
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float64, Int

from foredrive.data.modalities import FullOccupancy
from foredrive.errors import InputError
from foredrive.scene import VoxelSpec
from foredrive.scene.actors import ActorState
from foredrive.towns.place.materials import Surface
from foredrive.towns.sensing.actor_shapes import Shape, unit_to_world
from foredrive.towns.sensing.columns import COLUMN_M, TownColumns

FINEST_VOXEL_M = COLUMN_M * 2**0.5
"""Minimum voxel size, m. A column of a rotated grid must not lie between the town's columns."""

_PRIORITY = {
    Surface.TERRAIN: 1,
    Surface.ROAD: 2,
    Surface.SIDEWALK: 3,
    Surface.VEGETATION: 4,
    Surface.STRUCTURE: 5,
    Surface.BUILDING: 6,
    Surface.POLE: 7,
    Surface.SIGN: 8,
    Surface.SIGNAL: 9,
}
"""Priority of surfaces. A voxel with several surfaces gets the one with the highest priority."""
_CODE_OF_SURFACE = np.array([_PRIORITY.get(surface, 0) for surface in Surface], dtype=np.int16)
_SURFACE_OF_CODE = np.array([0, *sorted(_PRIORITY, key=lambda surface: _PRIORITY[surface])])
_FIRST_ACTOR = len(_SURFACE_OF_CODE)


def full_occupancy(
    town: TownColumns,
    actors: Sequence[tuple[ActorState, Shape]],
    T_world_ego: Float64[np.ndarray, "4 4"],
    spec: VoxelSpec,
) -> FullOccupancy:
    """Compute the occupied voxels of a grid in the ego frame.

    The category of static matter is -1 minus its `Surface`. Parked cars are among the actors.

    Raises:
        InputError: the voxels are finer than the sampling of the town.
    """
    if spec.voxel_m < FINEST_VOXEL_M:
        raise InputError(f"the voxels of a town must be at least {FINEST_VOXEL_M:.2f} m, got {spec.voxel_m}")
    # Voxel indices from world coordinates: scale, shift, and the inverse ego pose
    T_index_ego = np.diag([1 / spec.voxel_m] * 3 + [1.0])
    T_index_ego[:3, 3] = -np.array(spec.lower_m) / spec.voxel_m
    T_index_world = T_index_ego @ np.linalg.inv(T_world_ego)
    grid = np.zeros(spec.shape_zyx, dtype=np.int16)
    # Corners of the grid in the world decide which tiles are needed
    ends = zip(spec.lower_m, spec.upper_m, strict=True)
    corners = np.array([(*corner, 1.0) for corner in itertools.product(*ends)])
    yaw = float(np.arctan2(T_world_ego[1, 0], T_world_ego[0, 0]))
    for tile in town.tiles_around((corners @ T_world_ego.T)[:, :2], yaw):
        # Static matter first, then actors, whose codes are higher and so win
        _fill(*tile, _CODE_OF_SURFACE, T_index_world, grid)
    for number, (actor, shape) in enumerate(actors):
        code = np.full(len(Surface), _FIRST_ACTOR + number, dtype=np.int16)
        # Shapes are in the unit box: scaled by their own affine map
        _fill(*shape.solid, code, T_index_world @ unit_to_world(actor), grid)
    return _collect(grid, [actor for actor, _ in actors], T_world_ego, spec)


def _collect(
    grid: Int[np.ndarray, "Z Y X"],
    actors: list[ActorState],
    T_world_ego: Float64[np.ndarray, "4 4"],
    spec: VoxelSpec,
) -> FullOccupancy:
    """Convert the codes of the grid to categories and velocities."""
    kind = np.array([*(-1 - _SURFACE_OF_CODE), *(int(actor.category) for actor in actors)])
    still = np.zeros((_FIRST_ACTOR, 3))
    velocity_world = np.concatenate([still, *(actor.velocity_mps[None] for actor in actors)])
    # Velocities over ground, in the axes of the ego frame
    velocity = (velocity_world @ T_world_ego[:3, :3]).astype(np.float32)
    flat = np.flatnonzero(grid)
    code = grid.ravel()[flat]
    return FullOccupancy(
        spec=spec,
        index_zyx=np.stack(np.unravel_index(flat, spec.shape_zyx), axis=-1),
        category=kind[code],
        velocity_mps=velocity[code],
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _fill(x, y, low, high, surface, code_of_surface, T, grid):
    """Mark the voxels that vertical intervals pass through. The highest code wins.

    T maps to indices. An interval is nearly vertical in the grid: it passes through at most two voxels of a
    layer.
    """
    depth, height, width = grid.shape
    for i in range(len(x)):
        rest = T[2, 0] * x[i] + T[2, 1] * y[i] + T[2, 3]  # the grid's layers are nearly level: cut to them
        bottom, top = max(low[i], -rest / T[2, 2]), min(high[i], (depth - rest) / T[2, 2])
        code = code_of_surface[surface[i]]
        if bottom > top or code == 0:
            continue
        # Horizontal index at the lower and the upper end
        ahead = T[0, 0] * x[i] + T[0, 1] * y[i] + T[0, 3]
        aside = T[1, 0] * x[i] + T[1, 1] * y[i] + T[1, 3]
        a, b = int(np.floor(ahead + T[0, 2] * bottom)), int(np.floor(aside + T[1, 2] * bottom))
        a1, b1 = int(np.floor(ahead + T[0, 2] * top)), int(np.floor(aside + T[1, 2] * top))
        # Both ends beside the grid on the same side
        if max(a, a1) < 0 or min(a, a1) >= width or max(b, b1) < 0 or min(b, b1) >= height:
            continue
        # Layers between the ends
        first, last = int(np.floor(T[2, 2] * bottom + rest)), int(np.floor(T[2, 2] * top + rest))
        if a == a1 and b == b1:  # vertical in the grid, as nearly all are
            for c in range(max(first, 0), min(last, depth - 1) + 1):
                if code > grid[c, b, a]:
                    grid[c, b, a] = code
            continue
        for c in range(max(first, 0), min(last, depth - 1) + 1):
            # A slanted interval: mark the voxels at both ends of its part in each layer
            for z in (max(bottom, (c - rest) / T[2, 2]), min(top, (c + 1 - rest) / T[2, 2])):
                a, b = int(np.floor(ahead + T[0, 2] * z)), int(np.floor(aside + T[1, 2] * z))
                if 0 <= a < width and 0 <= b < height and code > grid[c, b, a]:
                    grid[c, b, a] = code
