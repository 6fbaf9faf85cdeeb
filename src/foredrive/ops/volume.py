"""Interpolation in volumes, and warping of volumes (NeMo eq. 7-8).

Coordinates in volumes are in voxel units, in the order x y z. Voxel i spans [i, i + 1), and its centre is at
i + 0.5.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.se3 import transform_points
from foredrive.ops.attention3d import attend_volume
from foredrive.ops.precision import full_precision, numba_supports, triton_supports


def sample_volume(
    volume: Float[Tensor, "b Z Y X D"], points: Float[Tensor, "b N 3"]
) -> Float[Tensor, "b N D"]:
    """Sample a volume by trilinear interpolation, with zero outside.

    Args:
        volume: features with channels last.
        points: x y z in voxel units. NaN gives NaN, infinity gives 0.

    Returns:
        float32 (float64 for float64 input), also from half precision.

    Raises:
        ValueError: the batch sizes differ, or the volume has no voxels.
    """
    if len(volume) != len(points) or min(volume.shape[1:]) == 0:
        raise ValueError(f"sample_volume: cannot read {(*points.shape,)} from {(*volume.shape,)}")
    if not (numba_supports(volume, points) or triton_supports(volume, points)):
        return sample_volume_reference(volume, points)
    one = points.new_ones(()).expand(*points.shape[:2], 1, 1)
    return attend_volume(volume, points[:, :, None, None], one)  # one head with one point of weight 1


def sample_volume_reference(
    volume: Float[Tensor, "b Z Y X D"], points: Float[Tensor, "b N 3"]
) -> Float[Tensor, "b N D"]:
    """Compute `sample_volume` in plain PyTorch."""
    with full_precision(volume, points) as (volume, points):
        size_xyz = points.new_tensor(volume.shape[1:4][::-1])
        grid = 2 * points.clamp(-torch.ones_like(size_xyz), size_xyz + 1) / size_xyz - 1
        read = F.grid_sample(volume.permute(0, 4, 1, 2, 3), grid[:, None, None], align_corners=False)
        read = read[:, :, 0, 0].transpose(1, 2)
        return read.masked_fill(points.isnan().any(-1, keepdim=True), torch.nan)


def warp_volume(
    volume: Float[Tensor, "b D Z Y X"],
    flow: Float[Tensor, "b 3 Z Y X"],
    T_src_dst: Float[Tensor, "b 4 4"],
    lower_m: tuple[float, float, float],
    voxel_m: float,
) -> Float[Tensor, "b D Z Y X"]:
    """Move a volume by a flow and a rigid motion, by gathering (NeMo eq. 7-8).

    out[z] = volume[R (z + f(z)) + t] at every voxel centre z (m, ego frame) of the result. The result is in
    the frame dst (the future), the given volume in the frame src (now). Both the flow and (R, t) =
    `T_src_dst` lead from coordinates of the future frame back to those of now. The result is zero where the
    source is outside the volume.

    Args:
        volume: grid in the frame src. No copy is made if it is channels-last in memory.
        flow: f, metres along x y z of dst.
        T_src_dst: maps points of dst to src.
        lower_m, voxel_m: lower corner (x y z) and voxel size of the grid, equal in both frames.
    """
    with full_precision(volume, flow, T_src_dst) as (volume, flow, T_src_dst):
        read = sample_volume(
            volume.permute(0, 2, 3, 4, 1), places_before(flow, T_src_dst, lower_m, voxel_m).flatten(1, 3)
        )
        return read.unflatten(1, volume.shape[2:]).permute(0, 4, 1, 2, 3)


def places_before(
    flow: Float[Tensor, "b 3 Z Y X"],
    T_src_dst: Float[Tensor, "b 4 4"],
    lower_m: tuple[float, float, float],
    voxel_m: float,
) -> Float[Tensor, "b Z Y X 3"]:
    """Return the source positions of `warp_volume`: ẑ = R (z + f) + t of every voxel centre z.

    They are x y z in voxel units.
    """
    axes = [torch.arange(n, dtype=flow.dtype, device=flow.device) + 0.5 for n in flow.shape[2:]]
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    lower = flow.new_tensor(lower_m)
    target_m = torch.stack([x, y, z], dim=-1) * voxel_m + lower + flow.permute(0, 2, 3, 4, 1)
    source_m = transform_points(T_src_dst, target_m.flatten(1, 3))
    return ((source_m - lower) / voxel_m).unflatten(1, flow.shape[2:])
