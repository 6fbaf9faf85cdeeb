"""Multi-camera deformable attention: 3-D queries read image features (NeMo eq. 1)."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from foredrive.geometry.precision import full_precision
from foredrive.ops.corners import BLOCK
from foredrive.ops.lifting_kernels import LiftingGradients, LiftingInputs, lift_pairs, lift_pairs_backward
from foredrive.ops.precision import MAX_ITEM_SIZE, numba_supports, triton_supports
from foredrive.ops.threads import in_parallel

MIN_QUERIES = 64
"""Minimum number of queries per thread."""
CACHE_LINE = 16
"""Number of floats in a cache line. Threads that write to the same line slow each other down."""


def lift(
    values: Sequence[Float[Tensor, "b C _h _w D"]],
    uv: Float[Tensor, "b C Q 2"],
    visible: Bool[Tensor, "b C Q"],
    offsets: Float[Tensor, "b Q H L P 2"],
    weights: Float[Tensor, "b Q H L P"],
) -> Float[Tensor, "b Q D"]:
    """Return multi-head deformable cross-attention to L levels of image features of C cameras.

    It is Zhu et al. 2021, eq. 2, over several cameras as in BEVFormer. A query reads every camera that sees
    it, and the result is the mean over these cameras. A query that no camera sees returns 0. Head h reads
    channels [h·D/H, (h+1)·D/H) at uv·(w, h) + offset, bilinearly and zero outside the feature map.

    Args:
        values: feature maps with channels last, in any order of levels.
        uv: position of each query in each image, relative to its width and height. (0, 0) is the top left
            corner of the top left pixel, (1, 1) the bottom right corner of the bottom right pixel. It comes
            from calibration and gets no gradient. It is ignored where `visible` is False.
        visible: whether each camera sees each query.
        offsets: x y in pixels of the feature map of the level.
        weights: attention weights, already normalised over L·P.

    Returns:
        float32 (float64 for float64 input), also from half precision.

    Raises:
        ValueError: D is not a multiple of H, or the shapes do not agree.
    """
    _check(values, uv, visible, offsets, weights)
    image_size = sum(v.shape[2] * v.shape[3] for v in values) * values[0].shape[4]
    small = image_size < MAX_ITEM_SIZE
    if small and triton_supports(*values, uv, offsets, weights):
        from foredrive.ops.lifting_triton import lift_triton  # Triton may be missing

        return lift_triton(*join_levels(values), uv, visible, offsets, weights)
    points = weights.shape[3] * weights.shape[4]
    # More points than a block would not fit into the kernels' buffers
    if not (small and points <= BLOCK and numba_supports(*values, uv, offsets, weights)):
        return lift_reference(values, uv, visible, offsets, weights)
    with full_precision(*values, uv, offsets, weights) as (*values, uv, offsets, weights):
        joined, sizes = join_levels(values)
        pairs = _visible_pairs(uv, visible)
        out: Tensor = _LiftNumba.apply(joined, offsets, weights, np.array(sizes, np.int32), pairs)
        return out


def join_levels(
    values: Sequence[Float[Tensor, "b C _h _w D"]],
) -> tuple[Float[Tensor, "b C S D"], list[tuple[int, int, int]]]:
    """Concatenate the pixels of all levels. Return them with height, width and first pixel of each level."""
    sizes, start = [], 0
    for value in values:
        sizes.append((value.shape[2], value.shape[3], start))
        start += value.shape[2] * value.shape[3]
    levels = [value.flatten(2, 3) for value in values]
    return torch.cat(levels, dim=2) if len(levels) > 1 else levels[0], sizes


def lift_reference(
    values: Sequence[Float[Tensor, "b C _h _w D"]],
    uv: Float[Tensor, "b C Q 2"],
    visible: Bool[Tensor, "b C Q"],
    offsets: Float[Tensor, "b Q H L P 2"],
    weights: Float[Tensor, "b Q H L P"],
) -> Float[Tensor, "b Q D"]:
    """Compute `lift` in plain PyTorch: sample every camera for every query, then mask."""
    with full_precision(*values, uv, offsets, weights) as (*values, uv, offsets, weights):
        b, cameras, _ = visible.shape
        heads = offsets.shape[2]
        # Invisible queries read the image's middle and are masked at the end
        uv = uv.detach().masked_fill(~visible[..., None], 0.5)
        total = values[0].new_zeros(())
        for level, value in enumerate(values):
            height, width = value.shape[2:4]
            size_wh = uv.new_tensor([width, height])
            # Place in pixels of this level: the query's position plus the offsets of its heads
            place = (uv * size_wh)[:, :, None, :, None] + offsets[:, None, :, :, level].transpose(2, 3)
            # Pixels to grid_sample's range -1 … 1; the clamp keeps infinite coordinates finite
            grid = 2 * place.clamp(-uv.new_ones(2), size_wh + 1) / size_wh - 1  # [b C H Q P 2]
            maps = value.unflatten(-1, (heads, -1)).permute(0, 1, 4, 5, 2, 3)  # [b C H D/H h w]
            read = F.grid_sample(maps.flatten(0, 2), grid.flatten(0, 2), align_corners=False)
            read = read.unflatten(0, (b, cameras, heads))  # [b C H D/H Q P]
            # grid_sample does not preserve NaN coordinates
            read = read.masked_fill(place.isnan().any(-1)[:, :, :, None], torch.nan)
            # Attention-weighted sum over the points of all levels
            total = total + (read * weights[:, None, :, :, level].transpose(2, 3)[:, :, :, None]).sum(-1)
        # Mean over the cameras that see the query; 0 if there is none
        seen = total.masked_fill(~visible[:, :, None, None], 0).sum(1)  # [b H D/H Q]
        mean = seen / visible.sum(1).clamp_min(1)[:, None, None]
        return mean.permute(0, 3, 1, 2).flatten(2)


class _Pairs(NamedTuple):
    """Pairs of a query and a camera that sees it, sorted by query. See `LiftingInputs` for the fields."""

    query: np.ndarray
    image: np.ndarray
    uv: np.ndarray
    share: np.ndarray
    first: np.ndarray
    """Int64[b·Q + 1], start of the pairs of each query."""


def _visible_pairs(uv: Float[Tensor, "b C Q 2"], visible: Bool[Tensor, "b C Q"]) -> _Pairs:
    b, cameras, queries = visible.shape
    by_query = visible.transpose(1, 2)  # [b Q C]
    # nonzero is sorted by item, query, camera: the pairs of a query are adjacent
    item, query, camera = by_query.nonzero(as_tuple=True)
    count = by_query.sum(-1).flatten()
    row = item * queries + query
    first = torch.zeros(b * queries + 1, dtype=torch.int64)
    torch.cumsum(count, 0, out=first[1:])
    return _Pairs(
        query=row.numpy(),
        image=(item * cameras + camera).numpy(),
        uv=uv.detach()[item, camera, query].numpy(),
        share=(1 / count.float())[row].numpy(),
        first=first.numpy(),
    )


class _LiftNumba(torch.autograd.Function):
    """The numba path of `lift`, for float32 on the CPU."""

    @staticmethod
    def forward(
        ctx: Any,
        values: Float[Tensor, "b C S D"],
        offsets: Float[Tensor, "b Q H L P 2"],
        weights: Float[Tensor, "b Q H L P"],
        sizes: np.ndarray,
        pairs: _Pairs,
    ) -> Float[Tensor, "b Q D"]:
        values, offsets, weights = values.contiguous(), offsets.contiguous(), weights.contiguous()
        ctx.save_for_backward(values, offsets, weights)
        ctx.sizes, ctx.pairs = sizes, pairs
        b, queries = weights.shape[:2]
        inputs = _inputs(values, offsets, weights, sizes, pairs)
        out = values.new_zeros(b * queries, values.shape[-1])
        rows = out.numpy()

        # Queries own rows of the result, and pairs are sorted by query: ranges do not overlap
        def job(start: int, stop: int) -> None:
            lift_pairs(inputs, pairs.first[start], pairs.first[stop], rows)

        in_parallel(job, b * queries, grain=MIN_QUERIES)
        return out.unflatten(0, (b, queries))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_out: Tensor) -> tuple[Tensor | None, ...]:
        values, offsets, weights = ctx.saved_tensors
        wants_values, wants_offsets, wants_weights = ctx.needs_input_grad[:3]
        wants_points = wants_offsets or wants_weights
        grad_values = torch.zeros_like(values) if wants_values else values[:0]
        # Several cameras add to the same offsets and weights, so these begin at zero
        grad_offsets = torch.zeros_like(offsets) if wants_points else offsets[:0]
        grad_weights = torch.zeros_like(weights) if wants_points else weights[:0]
        inputs = _inputs(values, offsets, weights, ctx.sizes, ctx.pairs)
        grads = LiftingGradients(
            out=grad_out.contiguous().flatten(0, 1).numpy(),
            values=grad_values.flatten(0, 1).numpy(),
            offsets=grad_offsets.flatten(0, 1).numpy(),
            weights=grad_weights.flatten(0, 1).numpy(),
        )
        b, queries, heads = weights.shape[:3]
        first = ctx.pairs.first

        def job(start: int, stop: int) -> None:
            for item, head in (divmod(i, heads) for i in range(start, stop)):
                # A head has its own channels, offsets and weights, an item its own images: jobs do not clash
                lift_pairs_backward(inputs, first[item * queries], first[(item + 1) * queries], head, grads)

        # A job has enough heads that two threads do not write to one cache line of the values' gradient
        in_parallel(job, b * heads, grain=-(-CACHE_LINE // (values.shape[-1] // heads)))
        return (
            grad_values if wants_values else None,
            grad_offsets if wants_offsets else None,
            grad_weights if wants_weights else None,
            None,
            None,
        )


def _inputs(
    values: Tensor, offsets: Tensor, weights: Tensor, sizes: np.ndarray, pairs: _Pairs
) -> LiftingInputs:
    return LiftingInputs(
        values=values.detach().flatten(0, 1).numpy(),
        sizes=sizes,
        offsets=offsets.detach().flatten(0, 1).numpy(),
        weights=weights.detach().flatten(0, 1).numpy(),
        query=pairs.query,
        image=pairs.image,
        uv=pairs.uv,
        share=pairs.share,
    )


def _check(values: Sequence[Tensor], uv: Tensor, visible: Tensor, offsets: Tensor, weights: Tensor) -> None:
    """Raise `ValueError` if the shapes do not fit together, because the kernels do not check indices."""
    b, cameras, queries = visible.shape
    heads, levels, points = offsets.shape[2:5]
    channels = values[0].shape[-1] if values else 0
    fits = (
        len(values) == levels > 0
        and heads * points > 0
        and all(v.shape == (b, cameras, *v.shape[2:4], channels) and min(v.shape[2:]) > 0 for v in values)
        and uv.shape == (b, cameras, queries, 2)
        and offsets.shape == (b, queries, heads, levels, points, 2)
        and weights.shape == (b, queries, heads, levels, points)
        and channels % heads == 0
    )
    if not fits:
        shapes = {
            "values": [tuple(v.shape) for v in values],
            "uv": tuple(uv.shape),
            "visible": tuple(visible.shape),
            "offsets": tuple(offsets.shape),
            "weights": tuple(weights.shape),
        }
        raise ValueError(f"lift: shapes do not fit together (D must be a multiple of H): {shapes}")
