"""Exact occupancy: every voxel that holds matter, seen or not, with what it is and how it moves."""

from collections.abc import Sequence
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float64, Int

from foredrive.data.modalities import FullOccupancy
from foredrive.errors import InputError
from foredrive.scene import VoxelSpec
from foredrive.towns.actors import ActorState
from foredrive.towns.place.looks import Surface
from foredrive.towns.place.props import ThinThings
from foredrive.towns.sensing.actor_shapes import Shape, unit_to_world
from foredrive.towns.sensing.columns import COLUMN_M, Intervals, TownColumns

FINEST_VOXEL_M = COLUMN_M * 2**0.5
"""A column of a turned grid must not slip between the town's columns."""
SAMPLES_PER_VOXEL = 2.0

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
"""What a voxel is that holds several things: the highest."""
_CODE = np.array([_PRIORITY.get(surface, 0) for surface in Surface])
_SURFACE_OF_CODE = np.array([0, *sorted(_PRIORITY, key=lambda surface: _PRIORITY[surface])])
_FIRST_ACTOR = 100


def full_occupancy(
    town: TownColumns,
    thin: ThinThings,
    actors: Sequence[tuple[ActorState, Shape]],
    T_world_ego: Float64[np.ndarray, "4 4"],
    spec: VoxelSpec,
) -> FullOccupancy:
    """Occupied voxels of a grid in the ego frame.

    The category of what is static is -1 minus its `Surface`. Parked cars are among the actors.

    Raises:
        InputError: voxels finer than the town is sampled.
    """
    if spec.voxel_m < FINEST_VOXEL_M:
        raise InputError(
            f"towns are sampled for voxels of {FINEST_VOXEL_M:.2f} m or more, got {spec.voxel_m}"
        )
    T_ego_world = np.linalg.inv(T_world_ego)
    grid = np.zeros(spec.shape_zyx, dtype=np.int32)
    to_index = np.diag([1 / spec.voxel_m] * 3 + [1.0])
    to_index[:3, 3] = -np.array(spec.lower_m) / spec.voxel_m
    step_m = spec.voxel_m / SAMPLES_PER_VOXEL
    corners = np.array([spec.lower_m[:2], spec.upper_m[:2]])
    middle = T_world_ego @ np.array([*corners.mean(axis=0), 0.0, 1.0])
    for tile in town.around(middle[:2], 0.5 * float(np.linalg.norm(corners[1] - corners[0]))):
        _fill_static(tile, to_index @ T_ego_world, step_m, grid)
    x, y, z = thin.xyz.T.astype(np.float32)
    _fill_static(Intervals(x, y, z, z, thin.surface), to_index @ T_ego_world, step_m, grid)
    for number, (actor, shape) in enumerate(actors):
        T = to_index @ T_ego_world @ unit_to_world(actor)
        step = step_m / float(actor.size_lwh[2])
        solid = shape.solid
        code = np.full(len(solid.x), _FIRST_ACTOR + number, dtype=np.int64)
        _fill(solid.x, solid.y, solid.low, solid.high, code, T, step, grid)
    return _collect(grid, [actor for actor, _ in actors], T_ego_world, spec)


def _fill_static(
    part: Intervals, T_index_world: Float64[np.ndarray, "4 4"], step_m: float, grid: Int[np.ndarray, "Z Y X"]
) -> None:
    _fill(part.x, part.y, part.low, part.high, _CODE[part.surface], T_index_world, step_m, grid)


def _collect(
    grid: Int[np.ndarray, "Z Y X"],
    actors: list[ActorState],
    T_ego_world: Float64[np.ndarray, "4 4"],
    spec: VoxelSpec,
) -> FullOccupancy:
    index = np.argwhere(grid > 0)
    code = grid[tuple(index.T)]
    moving = code >= _FIRST_ACTOR
    surface = _SURFACE_OF_CODE[np.where(moving, 0, code)]
    kinds = np.array([*(int(actor.category) for actor in actors), 0])
    velocity = np.array([*(actor.velocity_mps for actor in actors), np.zeros(3)]) @ T_ego_world[:3, :3].T
    who = np.where(moving, code - _FIRST_ACTOR, len(actors))
    return FullOccupancy(
        spec=spec,
        index_zyx=index,
        category=np.where(moving, kinds[who], -1 - surface),
        velocity_mps=velocity[who].astype(np.float32),
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _fill(x, y, low, high, code, T, step, grid):
    """Mark the voxels that vertical intervals run through; T leads to indices, the highest code wins."""
    depth, height, width = grid.shape
    for i in range(len(x)):
        rest = T[2, 0] * x[i] + T[2, 1] * y[i] + T[2, 3]  # the grid's layers are nearly level: cut to them
        bottom, top = max(low[i], -rest / T[2, 2]), min(high[i], (depth - rest) / T[2, 2])
        if bottom > top:
            continue
        count = int(np.ceil((top - bottom) / step)) + 1
        rise = (top - bottom) / max(count - 1, 1)
        for k in range(count):
            z = bottom + k * rise
            a = int(np.floor(T[0, 0] * x[i] + T[0, 1] * y[i] + T[0, 2] * z + T[0, 3]))
            b = int(np.floor(T[1, 0] * x[i] + T[1, 1] * y[i] + T[1, 2] * z + T[1, 3]))
            c = int(np.floor(T[2, 2] * z + rest))
            inside = 0 <= a < width and 0 <= b < height and 0 <= c < depth
            if inside and code[i] > grid[c, b, a]:
                grid[c, b, a] = code[i]
