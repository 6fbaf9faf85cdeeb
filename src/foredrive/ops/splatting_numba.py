"""The numba path of `composite_splats` as an autograd function."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from foredrive.ops.splat_listing_kernels import (
    COLUMNS,
    PointArrays,
    SplatArrays,
    fill_tile_lists,
    find_tiles,
    pack_splats,
    sort_by_range,
)
from foredrive.ops.splat_points import TiledPoints
from foredrive.ops.splatting_back_kernels import (
    GEOMETRY_COLUMNS,
    composite_tiles_backward,
    gather_gradients,
)
from foredrive.ops.splatting_kernels import EXTRA_COLUMNS, TileLists, composite_tiles
from foredrive.ops.threads import in_parallel
from foredrive.ops.vectors import ROW

MIN_SPLATS, MIN_TILES = 4096, 8
"""Minimum numbers of splats and of tiles per thread."""


class CompositeSplats(torch.autograd.Function):
    """Compositing for float32 on the CPU.

    The arguments are those of `composite_splats`. The columns of the result are its fields. Result and
    gradients do not depend on the number of threads.
    """

    @staticmethod
    def forward(
        ctx: Any, tiled: TiledPoints, hit_range_m: Float[Tensor, "P"], by_centre: bool, *fields: Tensor
    ) -> Float[Tensor, "P D4"]:
        """Composite the splats. `fields` are those of `Splats`."""
        fields = tuple(tensor.detach().contiguous() for tensor in fields)
        splats = SplatArrays(*(tensor.numpy() for tensor in fields))
        points = _arrays(tiled, hit_range_m, by_centre)
        # Forward: list the splats of each tile, then composite tile by tile
        lists, first_slot = _list(splats, points)
        # numpy requests huge pages
        composited = np.empty((tiled.count, splats.feature.shape[1] + EXTRA_COLUMNS), np.float32)

        def job(start: int, stop: int) -> None:
            composite_tiles(start, stop, lists, points, composited)

        in_parallel(job, len(points.point), grain=MIN_TILES)
        out = torch.from_numpy(composited)
        ctx.save_for_backward(out, *fields)
        ctx.listed = lists, points, first_slot
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_out: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients of the fields of `Splats`."""
        out, *fields = ctx.saved_tensors
        lists, points, first_slot = ctx.listed
        # Columns of a pair, padded to whole rows of 16
        columns = -(-(GEOMETRY_COLUMNS + lists.feature.shape[1]) // ROW) * ROW
        pairs = np.zeros((len(lists.splat), columns), np.float32)
        composited, upstream = out.numpy(), grad_out.contiguous().numpy()

        def backward_tiles(start: int, stop: int) -> None:
            composite_tiles_backward(start, stop, lists, points, composited, upstream, pairs)

        in_parallel(backward_tiles, len(points.point), grain=MIN_TILES)
        # Sum each splat's pairs and apply the chain rule
        grads = [torch.empty_like(tensor) for tensor in fields]
        splats, to_splats = (SplatArrays(*(tensor.numpy() for tensor in some)) for some in (fields, grads))

        def gather(start: int, stop: int) -> None:
            gather_gradients(start, stop, pairs, first_slot, splats, to_splats)

        in_parallel(gather, len(splats.feature), grain=MIN_SPLATS)
        return None, None, None, *grads


def _arrays(tiled: TiledPoints, hit_range_m: Float[Tensor, "P"], by_centre: bool) -> PointArrays:
    times = tiled.rows[:, 2]
    return PointArrays(
        rows=tiled.rows.numpy(),
        block_bounds=tiled.block_bounds.numpy(),
        tile_bounds=tiled.tile_bounds.numpy(),
        point=tiled.index.int().numpy(),
        hit=hit_range_m.numpy(),
        # None instead of False: numba compiles a kernel for each type
        by_centre=by_centre or None,
        left_edge=tiled.left_edge.numpy(),
        lower_edge=tiled.lower_edge.numpy(),
        first_tile=tiled.first_tile.numpy(),
        first_s=np.float32(times.min() if tiled.count else 0),
        last_s=np.float32(times.max() if tiled.count else 0),
        period=np.float32(tiled.period),
    )


def _list(splats: SplatArrays, points: PointArrays) -> tuple[TileLists, np.ndarray]:
    """Build the lists of the tiles. Return them with the start of the pairs of each splat."""
    count = len(splats.feature)
    packed = np.empty((count, COLUMNS), np.float32)
    per_splat = np.empty(count, np.int64)
    buffers: dict[int, np.ndarray] = {}

    def job(start: int, stop: int) -> None:
        pack_splats(start, stop, splats, points.period, packed)
        # A splat touches few tiles: guess 8, and repeat with the number found
        buffer = np.empty(8 * (stop - start), np.int32)
        needed = find_tiles(start, stop, packed, points, per_splat, buffer)
        if needed > len(buffer):
            buffer = np.empty(needed, np.int32)
            find_tiles(start, stop, packed, points, per_splat, buffer)
        buffers[start] = buffer[:needed]

    in_parallel(job, count, grain=MIN_SPLATS)
    # By splat: each thread found a range of splats
    tile_of = np.concatenate([np.empty(0, np.int32), *(buffers[start] for start in sorted(buffers))])
    first_slot = np.concatenate([np.zeros(1, np.int64), per_splat.cumsum()])
    order = np.empty(count, np.int32)
    sort_by_range(packed, order)
    first = np.zeros(len(points.point) + 2, np.int64)
    splat, slot = np.empty_like(tile_of), np.empty_like(tile_of)
    fill_tile_lists(order, first_slot, tile_of, first, splat, slot)
    return TileLists(packed, splats.feature, splat, slot, first), first_slot
