"""The CUDA path of `attend_volume`: Triton kernels for sums of trilinear samples.

A program handles a few rows (a row is one head of one query) and reads rows × points × channels at a time.
Never run on a card, but in Triton's interpreter (`docs/how-to/other-tools.md`).
"""

from collections.abc import Sequence
from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from foredrive.ops.tiles import TILE, launch, neighbours, read, read_back, rows_of_program


def attend_volume_triton(
    values: Float[Tensor, "b Z Y X D"],
    points: Float[Tensor, "b Q H P 3"],
    weights: Float[Tensor, "b Q H P"],
) -> Float[Tensor, "b Q D"]:
    """Compute `attend_volume` on a GPU. Half precision is read as it is and summed in float32.

    The gradient of the values is summed by atomics, so its last bits differ from run to run.
    """
    out: Tensor = _AttendVolume.apply(values, points, weights)
    return out


class _AttendVolume(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        values: Float[Tensor, "b Z Y X D"],
        points: Float[Tensor, "b Q H P 3"],
        weights: Float[Tensor, "b Q H P"],
    ) -> Float[Tensor, "b Q D"]:
        inputs = [x.contiguous() for x in (values, points, weights)]
        ctx.save_for_backward(*inputs)
        # Float32 output for every input type
        out = torch.empty(*weights.shape[:2], values.shape[-1], device=values.device)
        _launch(_attend_rows, inputs, [out])
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_out: Tensor) -> tuple[Tensor | None, ...]:
        values, points, weights = ctx.saved_tensors
        wants_values, wants_points, wants_weights = ctx.needs_input_grad
        to_points = wants_points or wants_weights
        # Atomic additions need float32, also for values in half precision
        grad_values = torch.zeros_like(values, dtype=torch.float32) if wants_values else None
        grad_points = torch.empty_like(points) if to_points else None
        grad_weights = torch.empty_like(weights) if to_points else None
        _launch(
            _attend_rows_back,
            [values, points, weights],
            [grad_out.float().contiguous(), grad_values, grad_points, grad_weights],
            TO_VALUES=wants_values,
            TO_POINTS=to_points,
        )
        return (
            None if grad_values is None else grad_values.to(values.dtype),
            grad_points if wants_points else None,
            grad_weights if wants_weights else None,
        )


def _launch(kernel: Any, inputs: Sequence[Tensor], outputs: Sequence[Tensor | None], **flags: bool) -> None:
    values, _, weights = inputs
    # Eight corners with their slopes take many registers: of a larger tile, some would be spilled
    numbers = TILE // 2 if kernel is _attend_rows_back else TILE
    launch(kernel, [*inputs, *outputs], values.shape[1:4], weights, values.shape[-1], numbers, **flags)


@triton.jit
@no_type_check
def _places(points, weights, place, inside):
    """Load coordinates (integers are voxel centres) and weights of rows × points."""
    x = tl.load(points + 3 * place, mask=inside, other=0.0).to(tl.float32) - 0.5
    y = tl.load(points + 3 * place + 1, mask=inside, other=0.0).to(tl.float32) - 0.5
    z = tl.load(points + 3 * place + 2, mask=inside, other=0.0).to(tl.float32) - 0.5
    weight = tl.load(weights + place, mask=inside, other=0.0).to(tl.float32)
    # NaN coordinates must give NaN.
    weight = tl.where((x == x) & (y == y) & (z == z), weight, float("nan"))
    return x, y, z, tl.where(inside, weight, 0.0)


@triton.jit
@no_type_check
def _attend_rows(
    values,  # b Z Y X D
    points,  # b·Q H P 3
    weights,  # b·Q H P
    out,  # b·Q D
    row_count,
    queries,
    depth,
    height,
    width,
    HEADS: tl.constexpr,
    POINTS: tl.constexpr,
    WIDTH: tl.constexpr,
    ROWS: tl.constexpr,
    P: tl.constexpr,
    W: tl.constexpr,
):
    CHANNELS: tl.constexpr = HEADS * WIDTH
    row, exists, query, head = rows_of_program(row_count, ROWS, HEADS)
    # First channel of the head in the batch item's volume
    base = (query // queries * depth * height * width * CHANNELS + head * WIDTH)[:, None]
    c = tl.arange(0, W)
    total = tl.zeros([ROWS, W], tl.float32)
    for first in range(0, POINTS, P):
        p = first + tl.arange(0, P)
        inside = exists[:, None] & (p < POINTS)[None, :]
        x, y, z, w = _places(points, weights, (row * POINTS)[:, None] + p[None, :], inside)
        x0, x1, wx0, wx1, _, _ = neighbours(x, width)
        y0, y1, wy0, wy1, _, _ = neighbours(y, height)
        z0, z1, wz0, wz1, _, _ = neighbours(z, depth)
        # Bits 0, 1 and 2 of the corner select the upper voxel along x, y and z
        for corner in tl.static_range(8):
            cx, wx = (x1, wx1) if corner % 2 else (x0, wx0)
            cy, wy = (y1, wy1) if corner // 2 % 2 else (y0, wy0)
            cz, wz = (z1, wz1) if corner // 4 else (z0, wz0)
            # 64-bit before it counts channels: a volume may have more than 2³¹ numbers
            voxel = ((cz * height + cy) * width + cx).to(tl.int64)
            total += read(values, base + voxel * CHANNELS, w * wz * wy * wx, c, WIDTH)
    to = (query * CHANNELS + head * WIDTH)[:, None] + c[None, :]
    tl.store(out + to, total, mask=exists[:, None] & (c < WIDTH)[None, :])


@triton.jit
@no_type_check
def _attend_rows_back(
    values,
    points,
    weights,
    grad_out,  # b·Q D
    grad_values,
    grad_points,
    grad_weights,
    row_count,
    queries,
    depth,
    height,
    width,
    HEADS: tl.constexpr,
    POINTS: tl.constexpr,
    WIDTH: tl.constexpr,
    ROWS: tl.constexpr,
    P: tl.constexpr,
    W: tl.constexpr,
    TO_VALUES: tl.constexpr,
    TO_POINTS: tl.constexpr,
):
    CHANNELS: tl.constexpr = HEADS * WIDTH
    row, exists, query, head = rows_of_program(row_count, ROWS, HEADS)
    base = (query // queries * depth * height * width * CHANNELS + head * WIDTH)[:, None]
    c = tl.arange(0, W)
    to = (query * CHANNELS + head * WIDTH)[:, None] + c[None, :]
    grad = tl.load(grad_out + to, mask=exists[:, None] & (c < WIDTH)[None, :], other=0.0)
    # Tiles of points: a row may have more points than a tile
    for first in range(0, POINTS, P):
        p = first + tl.arange(0, P)
        inside = exists[:, None] & (p < POINTS)[None, :]
        place = (row * POINTS)[:, None] + p[None, :]
        x, y, z, w = _places(points, weights, place, inside)
        x0, x1, wx0, wx1, sx0, sx1 = neighbours(x, width)
        y0, y1, wy0, wy1, sy0, sy1 = neighbours(y, height)
        z0, z1, wz0, wz1, sz0, sz1 = neighbours(z, depth)
        to_x, to_y = tl.zeros([ROWS, P], tl.float32), tl.zeros([ROWS, P], tl.float32)
        to_z, to_weight = tl.zeros([ROWS, P], tl.float32), tl.zeros([ROWS, P], tl.float32)
        # `dot` is the dot product of the corner's value and the gradient.
        for corner in tl.static_range(8):
            cx, wx, sx = (x1, wx1, sx1) if corner % 2 else (x0, wx0, sx0)
            cy, wy, sy = (y1, wy1, sy1) if corner // 2 % 2 else (y0, wy0, sy0)
            cz, wz, sz = (z1, wz1, sz1) if corner // 4 else (z0, wz0, sz0)
            at_corner = base + ((cz * height + cy) * width + cx).to(tl.int64) * CHANNELS
            part = wz * wy * wx
            dot = read_back(
                values, grad_values, at_corner, w * part, inside, grad, c, WIDTH, TO_VALUES, TO_POINTS
            )
            # Product rule: the derivative replaces one axis' interpolation weight
            to_x += w * wz * wy * sx * dot
            to_y += w * wz * sy * wx * dot
            to_z += w * sz * wy * wx * dot
            to_weight += part * dot
        # A row owns its points and weights, so a plain store suffices
        if TO_POINTS:
            tl.store(grad_points + 3 * place, to_x, mask=inside)
            tl.store(grad_points + 3 * place + 1, to_y, mask=inside)
            tl.store(grad_points + 3 * place + 2, to_z, mask=inside)
            tl.store(grad_weights + place, to_weight, mask=inside)
