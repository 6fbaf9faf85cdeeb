"""The CUDA path of `foredrive.ops.lifting`: Triton kernels that read only visible cameras.

A program handles a few rows (a row is one head of one query). It loops over levels and cameras, skips the
cameras that see none of its queries, and reads rows × points × channels at a time. Never run on a card, but
in Triton's interpreter (`docs/how-to/other-tools.md`).
"""

from collections.abc import Sequence
from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Bool, Float, Int32
from torch import Tensor
from torch.autograd.function import once_differentiable

from foredrive.ops.tiles import launch, neighbours, read, read_back, rows_of_program


def lift_triton(
    values: Float[Tensor, "b C S D"],
    sizes: Sequence[tuple[int, int, int]],
    uv: Float[Tensor, "b C Q 2"],
    visible: Bool[Tensor, "b C Q"],
    offsets: Float[Tensor, "b Q H L P 2"],
    weights: Float[Tensor, "b Q H L P"],
) -> Float[Tensor, "b Q D"]:
    """Compute `lift` on a GPU. Half precision is read as it is and summed in float32.

    The gradient of the values is summed by atomics, so its last bits differ from run to run.

    Args:
        values, sizes: feature maps as `lifting.join_levels` returns them.
        uv, visible, offsets, weights: as for `lift`.
    """
    places = uv.detach().float().contiguous()
    # Visibility divided by the number of cameras that see the query: mean and mask in one factor
    share = visible / visible.sum(1, keepdim=True).clamp_min(1)
    out: Tensor = _LiftTriton.apply(
        values, offsets, weights, places, share, torch.tensor(sizes, dtype=torch.int32, device=uv.device)
    )
    return out


class _LiftTriton(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        values: Float[Tensor, "b C S D"],
        offsets: Float[Tensor, "b Q H L P 2"],
        weights: Float[Tensor, "b Q H L P"],
        uv: Float[Tensor, "b C Q 2"],
        share: Float[Tensor, "b C Q"],
        sizes: Int32[Tensor, "L 3"],
    ) -> Float[Tensor, "b Q D"]:
        inputs = [x.contiguous() for x in (values, offsets, weights, uv, share, sizes)]
        ctx.save_for_backward(*inputs)
        out = torch.zeros(*weights.shape[:2], values.shape[-1], device=values.device)
        _launch(_lift_rows, inputs, [out])
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_out: Tensor) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        values, offsets, weights = inputs[:3]
        wants_values, wants_offsets, wants_weights = ctx.needs_input_grad[:3]
        wants_points = wants_offsets or wants_weights
        # Atomic additions need float32, also for values in half precision
        grad_values = torch.zeros_like(values, dtype=torch.float32) if wants_values else None
        grad_offsets = torch.zeros_like(offsets) if wants_points else None
        grad_weights = torch.zeros_like(weights) if wants_points else None
        _launch(
            _lift_rows_back,
            inputs,
            [grad_out.float().contiguous(), grad_values, grad_offsets, grad_weights],
            TO_VALUES=wants_values,
            TO_POINTS=wants_points,
        )
        return (
            None if grad_values is None else grad_values.to(values.dtype),
            grad_offsets if wants_offsets else None,
            grad_weights if wants_weights else None,
            None,
            None,
            None,
        )


def _launch(kernel: Any, inputs: Sequence[Tensor], outputs: Sequence[Tensor | None], **flags: bool) -> None:
    values, _, weights, uv, _, _ = inputs
    if values.numel():
        sizes = (uv.shape[1], values.shape[2], weights.shape[3])
        launch(kernel, [*inputs, *outputs], sizes, weights, values.shape[-1], **flags)


@triton.jit
@no_type_check
def _points(offsets, weights, place, inside):
    """Load offsets and weights of rows × points."""
    dx = tl.load(offsets + 2 * place, mask=inside, other=0.0).to(tl.float32)
    dy = tl.load(offsets + 2 * place + 1, mask=inside, other=0.0).to(tl.float32)
    return dx, dy, tl.load(weights + place, mask=inside, other=0.0).to(tl.float32)


@triton.jit
@no_type_check
def _camera(share, query, queries, camera, cameras, exists):
    """Return the rows' images of a camera, their pairs of query and camera, and the shares of the pairs."""
    # Image index of the batch item's camera, then the index of the pair into [b C Q]
    image = query // queries * cameras + camera
    pair = image * queries + query % queries
    return image, pair, tl.load(share + pair, mask=exists, other=0.0)


@triton.jit
@no_type_check
def _places(uv, pair, seen, dx, dy, height, width):
    """Return the coordinates of rows × points in the feature map of a level. Integers are pixel centres."""
    u = tl.load(uv + 2 * pair, mask=seen, other=0.0)
    v = tl.load(uv + 2 * pair + 1, mask=seen, other=0.0)
    return (u * width - 0.5)[:, None] + dx, (v * height - 0.5)[:, None] + dy


@triton.jit
@no_type_check
def _lift_rows(
    values,  # b·C S D
    offsets,  # b·Q H L P 2
    weights,  # b·Q H L P
    uv,  # b C Q 2
    share,  # b C Q, 1 / number of cameras that see the query, 0 where this camera does not see it
    sizes,  # L 3: height, width and first pixel
    out,  # b·Q D
    row_count,
    queries,
    cameras,
    pixels,
    levels,
    HEADS: tl.constexpr,
    POINTS: tl.constexpr,
    WIDTH: tl.constexpr,
    ROWS: tl.constexpr,
    P: tl.constexpr,
    W: tl.constexpr,
):
    CHANNELS: tl.constexpr = HEADS * WIDTH
    row, exists, query, head = rows_of_program(row_count, ROWS, HEADS)
    c = tl.arange(0, W)
    total = tl.zeros([ROWS, W], tl.float32)
    # Loops over levels, tiles of points, and cameras; offsets and weights are loaded once for all cameras
    for level in range(0, levels):
        height, width = tl.load(sizes + 3 * level), tl.load(sizes + 3 * level + 1)
        start = tl.load(sizes + 3 * level + 2)
        for first in range(0, POINTS, P):
            p = first + tl.arange(0, P)
            inside = exists[:, None] & (p < POINTS)[None, :]
            # Flat index into [b·Q H L P]
            place = ((row * levels + level) * POINTS)[:, None] + p[None, :]
            dx, dy, weight = _points(offsets, weights, place, inside)
            for camera in range(0, cameras):
                image, pair, part = _camera(share, query, queries, camera, cameras, exists)
                # Skip the camera if it sees none of the program's queries.
                if tl.max(part, axis=0) > 0:
                    seen = inside & (part > 0)[:, None]
                    x, y = _places(uv, pair, part > 0, dx, dy, height, width)
                    x0, x1, wx0, wx1, _, _ = neighbours(x, width)
                    y0, y1, wy0, wy1, _, _ = neighbours(y, height)
                    # NaN coordinates must give NaN.
                    w = tl.where((x == x) & (y == y), weight * part[:, None], float("nan"))
                    w = tl.where(seen, w, 0.0)
                    # First channel of the head at the level's first pixel
                    base = ((image * pixels + start) * CHANNELS + head * WIDTH)[:, None]
                    # Bits 0 and 1 of the corner select the right and the lower pixel
                    for corner in tl.static_range(4):
                        cx, wx = (x1, wx1) if corner % 2 else (x0, wx0)
                        cy, wy = (y1, wy1) if corner // 2 else (y0, wy0)
                        total += read(
                            values, base + (cy * width + cx).to(tl.int64) * CHANNELS, w * wy * wx, c, WIDTH
                        )
    to = (query * CHANNELS + head * WIDTH)[:, None] + c[None, :]
    tl.store(out + to, total, mask=exists[:, None] & (c < WIDTH)[None, :])


@triton.jit
@no_type_check
def _lift_rows_back(
    values,
    offsets,
    weights,
    uv,
    share,
    sizes,
    grad_out,  # b·Q D
    grad_values,
    grad_offsets,
    grad_weights,
    row_count,
    queries,
    cameras,
    pixels,
    levels,
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
    c = tl.arange(0, W)
    to = (query * CHANNELS + head * WIDTH)[:, None] + c[None, :]
    # The gradient of a row, for all levels and cameras
    grad = tl.load(grad_out + to, mask=exists[:, None] & (c < WIDTH)[None, :], other=0.0)
    for level in range(0, levels):
        height, width = tl.load(sizes + 3 * level), tl.load(sizes + 3 * level + 1)
        start = tl.load(sizes + 3 * level + 2)
        for first in range(0, POINTS, P):
            p = first + tl.arange(0, P)
            inside = exists[:, None] & (p < POINTS)[None, :]
            place = ((row * levels + level) * POINTS)[:, None] + p[None, :]
            dx, dy, weight = _points(offsets, weights, place, inside)
            to_x, to_y = tl.zeros([ROWS, P], tl.float32), tl.zeros([ROWS, P], tl.float32)
            to_weight = tl.zeros([ROWS, P], tl.float32)
            for camera in range(0, cameras):
                image, pair, part = _camera(share, query, queries, camera, cameras, exists)
                # Skip the camera if it sees none of the program's queries.
                if tl.max(part, axis=0) > 0:
                    seen = inside & (part > 0)[:, None]
                    x, y = _places(uv, pair, part > 0, dx, dy, height, width)
                    x0, x1, wx0, wx1, sx0, sx1 = neighbours(x, width)
                    y0, y1, wy0, wy1, sy0, sy1 = neighbours(y, height)
                    w = tl.where((x == x) & (y == y), weight, float("nan"))
                    w = tl.where(seen, w, 0.0)
                    base = ((image * pixels + start) * CHANNELS + head * WIDTH)[:, None]
                    # The camera's share is in the gradient here, and not in the weights
                    g = grad * part[:, None]
                    # `dot` is the dot product of the corner's value and the gradient.
                    for corner in tl.static_range(4):
                        cx, wx, sx = (x1, wx1, sx1) if corner % 2 else (x0, wx0, sx0)
                        cy, wy, sy = (y1, wy1, sy1) if corner // 2 else (y0, wy0, sy0)
                        cell = base + (cy * width + cx).to(tl.int64) * CHANNELS
                        dot = read_back(
                            values, grad_values, cell, w * wy * wx, seen, g, c, WIDTH, TO_VALUES, TO_POINTS
                        )
                        # Product rule: the derivative by x or y replaces that axis' interpolation weight
                        to_x += w * wy * sx * dot
                        to_y += w * sy * wx * dot
                        to_weight += wy * wx * dot
            # A row owns its offsets and weights, so a plain store suffices
            if TO_POINTS:
                tl.store(grad_offsets + 2 * place, to_x, mask=inside)
                tl.store(grad_offsets + 2 * place + 1, to_y, mask=inside)
                tl.store(grad_weights + place, to_weight, mask=inside)
