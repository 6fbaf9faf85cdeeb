"""The CUDA path of `read_hash_grid`: a program reads one level of the grid at some points.

Never run on a card, but in Triton's interpreter (`docs/how-to/other-tools.md`).
"""

from collections.abc import Sequence
from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from foredrive.ops.hash_grid_kernels import PRIME_ACTOR, PRIME_Y, PRIME_Z

POINTS = 128
"""Points of a program."""
_PRIME_Y, _PRIME_Z = tl.constexpr(PRIME_Y), tl.constexpr(PRIME_Z)
_PRIME_ACTOR = tl.constexpr(PRIME_ACTOR)


def read_hash_grid_triton(
    table: Float[Tensor, "R F"],
    points: Float[Tensor, "N 3"],
    levels: Sequence[tuple[int, int, int, bool]],
    footprint: Float[Tensor, "N"] | None = None,
    actor: Int[Tensor, "N"] | None = None,
) -> Float[Tensor, "LF N"]:
    """Compute `read_hash_grid` on a GPU. Half precision is read as it is and summed in float32.

    The gradient of the table is summed by atomics, so its last bits differ from run to run.

    Raises:
        ValueError: the number of features is not a power of two.
    """
    if (features := table.shape[1]) & (features - 1):
        raise ValueError(f"on a GPU, a level of a hash grid has 1, 2, 4 or 8 features, not {features}")
    # Row k of `shape` holds field k of all levels.
    shape = torch.tensor([tuple(int(x) for x in level) for level in levels], dtype=torch.int64).T.contiguous()
    if footprint is not None:
        footprint = footprint.detach().float().contiguous()
    if actor is not None:
        actor = actor.to(torch.int32).contiguous()
    out: Tensor = _ReadHashGrid.apply(table, points, shape.to(points.device), footprint, actor)
    return out


class _ReadHashGrid(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        table: Float[Tensor, "R F"],
        points: Float[Tensor, "N 3"],
        shape: Int[Tensor, "4 L"],
        footprint: Float[Tensor, "N"] | None,
        actor: Int[Tensor, "N"] | None,
    ) -> Float[Tensor, "LF N"]:
        table, points = table.contiguous(), points.contiguous()
        ctx.save_for_backward(table, points, shape, footprint, actor)
        # Float32 output for every input type
        out = torch.empty(shape.shape[1] * table.shape[1], len(points), device=table.device)
        _launch(_read_points, table, points, shape, footprint, actor, [out], {})
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_out: Tensor) -> tuple[Tensor | None, ...]:
        table, points, shape, footprint, actor = ctx.saved_tensors
        wants_table, wants_points = ctx.needs_input_grad[:2]
        # Atomic additions need float32, also for a table in half precision
        grad_table = torch.zeros_like(table, dtype=torch.float32) if wants_table else None
        levels = shape.shape[1]
        grad_points = (
            torch.empty(levels, 3, len(points), device=points.device, dtype=torch.float32)
            if wants_points
            else None
        )
        tensors = [grad_out.float().contiguous(), grad_table, grad_points]
        flags = {"TO_TABLE": wants_table, "TO_POINTS": wants_points}
        _launch(_read_points_back, table, points, shape, footprint, actor, tensors, flags)
        return (
            None if grad_table is None else grad_table.to(table.dtype),
            None if grad_points is None else grad_points.sum(0).T.to(points.dtype),
            None,
            None,
            None,
        )


def _launch(
    kernel: Any,
    table: Tensor,
    points: Tensor,
    shape: Tensor,
    footprint: Tensor | None,
    actor: Tensor | None,
    tensors: Sequence[Tensor | None],
    flags: dict[str, bool],
) -> None:
    if len(points):
        levels = shape.shape[1]
        # One program for each block of points and each level
        kernel[(triton.cdiv(len(points), POINTS), levels)](
            table,
            points,
            shape,
            footprint,
            actor,
            *tensors,
            len(points),
            levels,
            FEATURES=table.shape[1],
            FOOTPRINTS=footprint is not None,
            ACTORS=actor is not None,
            POINTS=POINTS,
            **flags,
        )


@triton.jit
@no_type_check
def _axis(points, point, inside, axis, cells):
    """Return a coordinate's cell, the place in it, its derivative, and NaN if it is NaN (else 0)."""
    place = tl.load(points + 3 * point + axis, mask=inside, other=0.0).to(tl.float32) * cells
    # Positions outside of the cube are clamped and have no gradient
    slope = tl.where((place >= 0) & (place <= cells), cells, 0.0)
    # NaN is carried to the result by adding it to the weight of the level
    wrong = tl.where(place == place, 0.0, float("nan"))
    place = tl.where(place > 0, place, 0.0)
    place = tl.where(place < cells, place, cells)
    # The upper face belongs to the last cell, with position 1 in it
    low = tl.floor(place)
    low = tl.where(low < cells - 1, low, cells - 1)
    return low.to(tl.int64), place - low, slope, wrong


@triton.jit
@no_type_check
def _level_weight(footprint, point, inside, cells, FOOTPRINTS: tl.constexpr):
    weight = tl.where(inside, 1.0, 0.0)
    if FOOTPRINTS:
        width = 2.0 * cells * tl.load(footprint + point, mask=inside, other=0.0)
        weight = weight / tl.where(width > 1.0, width, 1.0)
    return weight


@triton.jit
@no_type_check
def _row(x, y, z, owner, cells, rows, dense):
    side = cells + 1
    # Both numbers are computed for all points; `dense` is the same for a whole program
    direct = x + side * (y + side * (z + side * owner))
    mixed = (x ^ (y * _PRIME_Y) ^ (z * _PRIME_Z) ^ (owner * _PRIME_ACTOR)) & (rows - 1)
    return tl.where(dense != 0, direct, mixed)


@triton.jit
@no_type_check
def _owner(actor, point, inside, ACTORS: tl.constexpr):
    owner = tl.zeros(point.shape, tl.int64)
    if ACTORS:
        owner = tl.load(actor + point, mask=inside, other=0).to(tl.int64)
    return owner


@triton.jit
@no_type_check
def _read_points(
    table,  # R F
    points,  # N 3
    shape,  # 4 L
    footprint,  # N
    actor,  # N
    out,  # L·F N
    count,
    levels,
    FEATURES: tl.constexpr,
    FOOTPRINTS: tl.constexpr,
    ACTORS: tl.constexpr,
    POINTS: tl.constexpr,
):
    # 64-bit indices: the number of points times features may exceed 32 bits
    point = tl.program_id(0).to(tl.int64) * POINTS + tl.arange(0, POINTS)
    level, inside = tl.program_id(1), point < count
    cells, first = tl.load(shape + level), tl.load(shape + levels + level)
    rows, dense = tl.load(shape + 2 * levels + level), tl.load(shape + 3 * levels + level)
    # Cell and position in the cell along each axis
    x, wx, _, bad_x = _axis(points, point, inside, 0, cells)
    y, wy, _, bad_y = _axis(points, point, inside, 1, cells)
    z, wz, _, bad_z = _axis(points, point, inside, 2, cells)
    owner = _owner(actor, point, inside, ACTORS)
    scale = _level_weight(footprint, point, inside, cells, FOOTPRINTS) + bad_x + bad_y + bad_z
    f = tl.arange(0, FEATURES)
    total = tl.zeros([POINTS, FEATURES], tl.float32)
    for corner in tl.static_range(8):
        # Bits 0, 1 and 2 of the corner select the upper neighbour along x, y and z
        cx, px = (x + 1, wx) if corner % 2 else (x, 1 - wx)
        cy, py = (y + 1, wy) if corner // 2 % 2 else (y, 1 - wy)
        cz, pz = (z + 1, wz) if corner // 4 else (z, 1 - wz)
        row = first + _row(cx, cy, cz, owner, cells, rows, dense)
        place = row[:, None] * FEATURES + f[None, :]
        value = tl.load(table + place, mask=inside[:, None], other=0.0).to(tl.float32)
        total += (scale * pz * py * px)[:, None] * value
    # The result has the points last: row level · F + f, column `point`
    to = (level * FEATURES + f)[None, :].to(tl.int64) * count + point[:, None]
    tl.store(out + to, total, mask=inside[:, None])


@triton.jit
@no_type_check
def _read_points_back(
    table,
    points,
    shape,
    footprint,
    actor,
    grad_out,  # L·F N
    grad_table,  # R F
    grad_points,  # L 3 N
    count,
    levels,
    FEATURES: tl.constexpr,
    FOOTPRINTS: tl.constexpr,
    ACTORS: tl.constexpr,
    POINTS: tl.constexpr,
    TO_TABLE: tl.constexpr,
    TO_POINTS: tl.constexpr,
):
    # The same cells, weights and rows as in the forward pass, computed again
    point = tl.program_id(0).to(tl.int64) * POINTS + tl.arange(0, POINTS)
    level, inside = tl.program_id(1), point < count
    cells, first = tl.load(shape + level), tl.load(shape + levels + level)
    rows, dense = tl.load(shape + 2 * levels + level), tl.load(shape + 3 * levels + level)
    x, wx, slope_x, bad_x = _axis(points, point, inside, 0, cells)
    y, wy, slope_y, bad_y = _axis(points, point, inside, 1, cells)
    z, wz, slope_z, bad_z = _axis(points, point, inside, 2, cells)
    owner = _owner(actor, point, inside, ACTORS)
    scale = _level_weight(footprint, point, inside, cells, FOOTPRINTS) + bad_x + bad_y + bad_z
    f = tl.arange(0, FEATURES)
    source = (level * FEATURES + f)[None, :].to(tl.int64) * count + point[:, None]
    grad = tl.load(grad_out + source, mask=inside[:, None], other=0.0)
    to_x, to_y = tl.zeros([POINTS], tl.float32), tl.zeros([POINTS], tl.float32)
    to_z = tl.zeros([POINTS], tl.float32)
    for corner in tl.static_range(8):
        # s is the derivative of the interpolation weight along an axis
        cx, px, sx = (x + 1, wx, 1.0) if corner % 2 else (x, 1 - wx, -1.0)
        cy, py, sy = (y + 1, wy, 1.0) if corner // 2 % 2 else (y, 1 - wy, -1.0)
        cz, pz, sz = (z + 1, wz, 1.0) if corner // 4 else (z, 1 - wz, -1.0)
        row = first + _row(cx, cy, cz, owner, cells, rows, dense)
        place = row[:, None] * FEATURES + f[None, :]
        if TO_TABLE:
            # Points of different programs share rows, so the additions must be atomic
            part = (scale * pz * py * px)[:, None] * grad
            tl.atomic_add(grad_table + place, part, mask=inside[:, None], sem="relaxed")
        if TO_POINTS:
            value = tl.load(table + place, mask=inside[:, None], other=0.0).to(tl.float32)
            # Derivative of the trilinear weights times the dot product of row and gradient
            dot = scale * tl.sum(value * grad, axis=1)
            to_x += sx * py * pz * dot
            to_y += px * sy * pz * dot
            to_z += px * py * sz * dot
    # Each level has its own part: the caller sums over the levels
    if TO_POINTS:
        row = grad_points + level.to(tl.int64) * 3 * count + point
        tl.store(row, to_x * slope_x, mask=inside)
        tl.store(row + count, to_y * slope_y, mask=inside)
        tl.store(row + 2 * count, to_z * slope_z, mask=inside)
