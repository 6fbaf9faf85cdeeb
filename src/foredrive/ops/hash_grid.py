"""Multi-resolution hash grids (Müller et al., "Instant neural graphics primitives", 2022).

A level divides the unit cube into cells³ and keeps a row of features for each vertex of the cells. Where a
level has more vertices than its table has rows, a hash of the vertex' coordinates gives the row. A grid may
serve several actors: then the actor's index is a fourth coordinate (Tonderski et al., "NeuRAD", 2024).
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from foredrive.geometry.precision import full_precision
from foredrive.ops.hash_grid_kernels import (
    PRIME_ACTOR,
    PRIME_Y,
    PRIME_Z,
    GridGradients,
    GridInputs,
    GridLevel,
    read_level,
    read_level_back,
)
from foredrive.ops.precision import MAX_ITEM_SIZE, numba_supports, triton_supports
from foredrive.ops.threads import in_parallel

FEATURES = (1, 2, 4, 8)
"""Numbers of features of a row for which there are kernels."""
MIN_POINTS = 4096
"""Minimum number of points per thread in the forward pass."""


class Level(NamedTuple):
    """One level of a hash grid."""

    cells: int
    """Cells along a side of the unit cube."""
    first_row: int
    """First of the level's rows in the table."""
    rows: int
    """Number of rows: of all actors' vertices if `dense`, else a power of two."""
    dense: bool
    """True if every vertex has its own row."""


def grid_levels(
    levels: int, coarsest: int, finest: int, log2_rows: int, actors: int = 1
) -> tuple[Level, ...]:
    """Return the levels of a grid, in geometric progression (Müller et al., eq. 2-3).

    Args:
        levels: number of levels.
        coarsest, finest: cells along a side of the first and of the last level.
        log2_rows: binary logarithm of the maximum number of rows of a level.
        actors: number of actors that the grid serves.
    """
    table, first = [], 0
    for i in range(levels):
        # N_l = N_min · b^l. The small number keeps floor from losing a cell by rounding
        growth = (finest / coarsest) ** (i / max(levels - 1, 1))
        cells = math.floor(coarsest * growth + 1e-6)
        # A level has one row per vertex of all actors, as far as the limit of rows allows
        vertices = actors * (cells + 1) ** 3
        rows = min(vertices, 2**log2_rows)
        table.append(Level(cells, first, rows, dense=vertices <= 2**log2_rows))
        first += rows
    return tuple(table)


def read_hash_grid(
    table: Float[Tensor, "R F"],
    points: Float[Tensor, "N 3"],
    levels: Sequence[Level],
    footprint: Float[Tensor, "N"] | None = None,
    actor: Int[Tensor, "N"] | None = None,
) -> Float[Tensor, "LF N"]:
    """Return the features at points in the unit cube, interpolated trilinearly in each level.

    A level is scaled by min(1, 1 / (2 · cells · footprint)): levels that are finer than what a sample stands
    for fade, as in NeuRAD's reference implementation. The result is differentiable in `table` and `points`.

    Args:
        table: rows of all levels. Levels other than `levels` may use other rows.
        points: positions. Those outside of the cube are moved to its surface, and NaN gives NaN.
        levels: from `grid_levels`.
        footprint: side of the volume that each point stands for, in sides of the cube. None: a point.
        actor: index of the actor of each point, for grids that serve several.

    Returns:
        Features with the points last, level by level. It is float32 (float64 for float64 input).

    Raises:
        ValueError: the table has fewer rows than the levels need.
    """
    # The kernels do not check indices, so a table that is too short must be refused here
    needed = max(level.first_row + level.rows for level in levels)
    if needed > len(table):
        raise ValueError(f"read_hash_grid: levels need {needed} rows, the table has {len(table)}")
    inputs = (table, points) if footprint is None else (table, points, footprint)
    if table.shape[1] in FEATURES and triton_supports(*inputs):
        from foredrive.ops.hash_grid_triton import read_hash_grid_triton  # Triton may be missing

        return read_hash_grid_triton(table, points, levels, footprint, actor)
    small = table.numel() < MAX_ITEM_SIZE
    if not (small and table.shape[1] in FEATURES and numba_supports(*inputs)):
        return read_hash_grid_reference(table, points, levels, footprint, actor)
    with full_precision(*inputs) as (table, points, *_):
        out: Tensor = _ReadHashGrid.apply(
            table, points, tuple(levels), None if footprint is None else footprint.detach().float(), actor
        )
        return out


def read_hash_grid_reference(
    table: Float[Tensor, "R F"],
    points: Float[Tensor, "N 3"],
    levels: Sequence[Level],
    footprint: Float[Tensor, "N"] | None = None,
    actor: Int[Tensor, "N"] | None = None,
) -> Float[Tensor, "LF N"]:
    """Compute `read_hash_grid` in plain PyTorch."""
    with full_precision(table, points) as (table, points):
        features = []
        for level in levels:
            # Position in cells, moved to the surface of the cube where it lies outside
            place = (points * level.cells).clamp(0, level.cells)
            low = place.detach().floor().clamp(0, level.cells - 1)  # clamp keeps NaN
            inside = place - low
            total = points.new_zeros(len(points), table.shape[1])
            # NaN cannot be an index: it reads row 0, and its NaN weight makes the result NaN
            cell = low.nan_to_num().long()
            for corner in range(8):
                # Bits 0, 1 and 2 of the corner tell whether it is the upper one along x, y and z
                up = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2], device=points.device)
                weight = torch.where(up > 0, inside, 1 - inside).prod(-1)
                total = total + weight[:, None] * table[level.first_row + _row(cell + up, level, actor)]
            # Fade the levels whose cells are smaller than twice the footprint
            if footprint is not None:
                total = total / (2 * level.cells * footprint.detach().to(total)).clamp_min(1)[:, None]
            features.append(total.T)
        return torch.cat(features)


def _row(vertex: Int[Tensor, "N 3"], level: Level, actor: Int[Tensor, "N"] | None) -> Int[Tensor, "N"]:
    x, y, z = vertex.unbind(-1)
    owner = torch.zeros_like(x) if actor is None else actor.long()
    if level.dense:
        # Row-major numbering of the vertices: x runs fastest, the actor slowest
        side = level.cells + 1
        return x + side * (y + side * (z + side * owner))
    # The products fit into 64 bits, and the lower bits are those of a product of 32 bits.
    return (x ^ (y * PRIME_Y) ^ (z * PRIME_Z) ^ (owner * PRIME_ACTOR)) & (level.rows - 1)


class _ReadHashGrid(torch.autograd.Function):
    """The numba path, for float32 on the CPU. Threads share the levels, so the bits do not depend on them."""

    @staticmethod
    def forward(
        ctx: Any,
        table: Float[Tensor, "R F"],
        points: Float[Tensor, "N 3"],
        levels: tuple[Level, ...],
        footprint: Float[Tensor, "N"] | None,
        actor: Int[Tensor, "N"] | None,
    ) -> Float[Tensor, "LF N"]:
        table, points = table.contiguous(), points.contiguous()
        # Arrays of size 0 stand for None, because numba compiles for fixed types
        footprint = points.new_empty(0) if footprint is None else footprint.contiguous()
        actor = torch.empty(0, dtype=torch.int32) if actor is None else actor.to(torch.int32).contiguous()
        ctx.save_for_backward(table, points, footprint, actor)
        ctx.levels = levels
        inputs = _inputs(table, points, footprint, actor)
        count, features = len(points), table.shape[1]
        out = table.new_empty(len(levels) * features, count)
        rows = out.numpy()

        def job(start: int, stop: int) -> None:
            # A range of the flat index (level, point) may cover parts of several levels
            for number in range(start // count, -(-stop // count)):
                before = number * count
                level = GridLevel(*levels[number])
                read_level(inputs, level, number, max(start - before, 0), min(stop - before, count), rows)

        in_parallel(job, len(levels) * count, grain=MIN_POINTS)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_out: Tensor) -> tuple[Tensor | None, ...]:
        table, points, footprint, actor = ctx.saved_tensors
        wants_table, wants_points = ctx.needs_input_grad[:2]
        # Gradients that are not wanted have size 0
        levels: tuple[Level, ...] = ctx.levels
        grad_table = torch.zeros_like(table) if wants_table else table[:0]
        # Each level writes its own part, so that the sum over levels has a fixed order
        grad_points = points.new_empty(len(levels) if wants_points else 0, 3, len(points))
        inputs = _inputs(table, points, footprint, actor)
        arguments = (grad_out.contiguous(), grad_table, grad_points)
        grads = GridGradients(*(tensor.numpy() for tensor in arguments))

        # One thread does all points of a level: rows of a table are never shared between threads
        def job(start: int, stop: int) -> None:
            for number in range(start, stop):
                read_level_back(inputs, GridLevel(*levels[number]), number, grads)

        in_parallel(job, len(levels))
        return (
            grad_table if wants_table else None,
            grad_points.sum(0).T if wants_points else None,
            None,
            None,
            None,
        )


def _inputs(*tensors: Tensor) -> GridInputs:
    arrays: list[np.ndarray] = [tensor.detach().numpy() for tensor in tensors]
    return GridInputs(*arrays)
