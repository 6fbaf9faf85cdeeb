"""The numba path of `composite_splats` as an autograd function."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from foredrive.ops.splat_listing_kernels import (
    COLUMNS,
    Raw,
    Tiles,
    front_to_back,
    hand_out,
    list_tiles,
    pack_splats,
)
from foredrive.ops.splat_points import TiledPoints
from foredrive.ops.splatting_back_kernels import SUMS, Gradients, composite_back, gather_gradients
from foredrive.ops.splatting_kernels import EXTRA, Places, Scene, composite_tiles
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
        ctx: Any,
        points: TiledPoints,
        hit_range_m: Float[Tensor, "P"],
        feature: Float[Tensor, "N D"],
        *where: Tensor,
    ) -> Float[Tensor, "P D4"]:
        """Composite the splats. `where` holds the other fields of `Splats`, in the order of `Raw`."""
        feature, *where = (tensor.detach().contiguous() for tensor in (feature, *where))  # type: ignore[assignment]
        raw = Raw(*(tensor.numpy() for tensor in where))
        places = Places(
            points.rows.numpy(),
            points.block_bounds.numpy(),
            points.tile_bounds.numpy(),
            points.index.int().numpy(),
            hit_range_m.numpy(),
            np.float32(points.period),
        )
        scene, first_slot = _list(raw, feature.numpy(), points)
        seen = np.empty((points.count, feature.shape[1] + EXTRA), np.float32)  # numpy requests huge pages

        def job(start: int, stop: int) -> None:
            composite_tiles(start, stop, scene, places, seen)

        in_parallel(job, len(points.index), grain=MIN_TILES)
        out = torch.from_numpy(seen)
        ctx.save_for_backward(out, feature, *where)
        ctx.found = scene, places, first_slot
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_out: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients of the fields of `Splats`."""
        out, feature, *where = ctx.saved_tensors
        scene, places, first_slot = ctx.found
        columns = -(-(SUMS + feature.shape[1]) // ROW) * ROW
        pairs = np.zeros((len(scene.splat), columns), np.float32)
        seen, upstream = out.numpy(), grad_out.contiguous().numpy()

        def look(start: int, stop: int) -> None:
            composite_back(start, stop, scene, places, seen, upstream, pairs)

        in_parallel(look, len(places.point), grain=MIN_TILES)
        raw = Raw(*(tensor.numpy() for tensor in where))
        to_where, to_feature = [torch.empty_like(tensor) for tensor in where], torch.empty_like(feature)
        grads = Gradients(*(tensor.numpy() for tensor in (*to_where, to_feature)))

        def gather(start: int, stop: int) -> None:
            gather_gradients(start, stop, pairs, first_slot, raw, grads)

        in_parallel(gather, len(feature), grain=MIN_SPLATS)
        return None, None, to_feature, *to_where


def _list(raw: Raw, feature: np.ndarray, points: TiledPoints) -> tuple[Scene, np.ndarray]:
    """Build the lists of the tiles. Return them with the start of the pairs of each splat."""
    count = len(feature)
    packed = np.empty((count, COLUMNS), np.float32)
    per_splat = np.empty(count, np.int64)
    times = points.rows[:, 2]
    tiles = Tiles(
        points.tile_bounds.numpy(),
        points.left_edge.numpy(),
        points.lower_edge.numpy(),
        points.first_tile.numpy(),
        np.float32(times.min() if points.count else 0),
        np.float32(times.max() if points.count else 0),
        np.float32(points.period),
    )
    found: dict[int, np.ndarray] = {}

    def job(start: int, stop: int) -> None:
        pack_splats(start, stop, raw, tiles.period, packed)
        room = np.empty(8 * (stop - start), np.int32)
        needed = list_tiles(start, stop, packed, tiles, per_splat, room)
        if needed > len(room):
            room = np.empty(needed, np.int32)
            list_tiles(start, stop, packed, tiles, per_splat, room)
        found[start] = room[:needed]

    in_parallel(job, count, grain=MIN_SPLATS)
    tile_of = np.concatenate([np.empty(0, np.int32), *(found[start] for start in sorted(found))])
    first_slot = np.concatenate([np.zeros(1, np.int64), per_splat.cumsum()])
    order = np.empty(count, np.int32)
    front_to_back(packed, order)
    first = np.zeros(len(points.index) + 2, np.int64)
    splat, slot = np.empty_like(tile_of), np.empty_like(tile_of)
    hand_out(order, first_slot, tile_of, first, splat, slot)
    return Scene(packed, feature, splat, slot, first), first_slot
