"""Multi-head deformable attention in a volume."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.precision import full_precision
from foredrive.ops.corners import BLOCK
from foredrive.ops.precision import MAX_ITEM_SIZE, numba_supports, triton_supports
from foredrive.ops.volume_numba import AttendVolume, channel_slices


def attend_volume(
    values: Float[Tensor, "b Z Y X D"],
    points: Float[Tensor, "b Q H P 3"],
    weights: Float[Tensor, "b Q H P"],
) -> Float[Tensor, "b Q D"]:
    """Return multi-head deformable attention (Zhu et al. 2021, eq. 2) in 3-D.

    Head h reads channels [h·D/H, (h+1)·D/H) at its P points, trilinearly and zero outside, and returns the
    weighted sum.

    Args:
        values: features with channels last.
        points: x y z in voxel units (voxel i spans [i, i + 1)).
        weights: attention weights, already normalised over P.

    Returns:
        float32 (float64 for float64 input), also from half precision.

    Raises:
        ValueError: D is not a multiple of H, or the shapes do not agree.
    """
    b, queries, heads, per_head = weights.shape
    fits = (
        points.shape == (b, queries, heads, per_head, 3)
        and len(values) == b
        and heads * per_head > 0
        and min(values.shape[1:]) > 0
        and values.shape[-1] % heads == 0
    )
    if not fits:
        shapes = f"values {(*values.shape,)}, points {(*points.shape,)}, weights {(*weights.shape,)}"
        raise ValueError(f"attend_volume: shapes do not fit together (D must be a multiple of H): {shapes}")
    small = values[:1].numel() < MAX_ITEM_SIZE
    if small and triton_supports(values, points, weights):
        from foredrive.ops.volume_triton import attend_volume_triton  # Triton may be missing

        return attend_volume_triton(values, points, weights)
    if not (small and per_head <= BLOCK and numba_supports(values, points, weights)):
        return attend_volume_reference(values, points, weights)
    # The kernels apply: their backward pass runs in parallel over slices of the channels
    slices = channel_slices(heads, values.shape[-1])
    with full_precision(values, points, weights) as (values, points, weights):
        out: Tensor = AttendVolume.apply(values, points, weights, slices)
        return out


def attend_volume_reference(
    values: Float[Tensor, "b Z Y X D"],
    points: Float[Tensor, "b Q H P 3"],
    weights: Float[Tensor, "b Q H P"],
) -> Float[Tensor, "b Q D"]:
    """Compute `attend_volume` in plain PyTorch."""
    with full_precision(values, points, weights) as (values, points, weights):
        b, _, heads, _ = weights.shape
        size_xyz = points.new_tensor(values.shape[1:4][::-1])
        # Voxel units to grid_sample's range -1 … 1. The clamp keeps infinite coordinates finite; one voxel
        # beyond the border everything is zero, so it does not change the result
        grid = 2 * points.clamp(-torch.ones_like(size_xyz), size_xyz + 1) / size_xyz - 1
        # Split the channels by head and let each head be a batch item of its own
        maps = values.unflatten(-1, (heads, -1)).permute(0, 4, 5, 1, 2, 3)  # [b H D/H Z Y X]
        grid = grid.transpose(1, 2).flatten(0, 1)[:, None]  # [b·H 1 Q P 3]
        read = F.grid_sample(maps.flatten(0, 1), grid, align_corners=False)
        read = read[:, :, 0].unflatten(0, (b, heads))  # [b H D/H Q P]
        # grid_sample does not preserve NaN coordinates
        read = read.masked_fill(points.isnan().any(-1).transpose(1, 2)[:, :, None], torch.nan)
        # Sum over the points P, then join the channels of the heads
        total = (read * weights.transpose(1, 2)[:, :, None]).sum(-1)  # [b H D/H Q]
        return total.permute(0, 3, 1, 2).flatten(2)
