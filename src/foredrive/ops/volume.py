"""Interpolation in volumes, and warping of volumes (NeMo eq. 7-8).

Coordinates in volumes are in voxel units, in the order x y z. Voxel i spans [i, i + 1), and its centre is at
i + 0.5.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.precision import full_precision
from foredrive.geometry.se3 import transform_points
from foredrive.ops.attention3d import attend_volume
from foredrive.ops.precision import numba_supports, triton_supports


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
        # Voxel units to grid_sample's range -1 … 1; beyond one voxel outside all is zero
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
    """Move a volume by a flow on its own grid, then by a rigid motion, in one gather (NeMo eq. 7-8).

    out[z] = volume[y + f(y)] with y = `T_src_dst` z, at every voxel centre z of the result. The given volume
    and the flow are in the frame src (now), the result is in the frame dst (the future). It is zero at places
    outside of the given volume.

    Args:
        volume: grid in the frame src. No copy is made if it is channels-last in memory.
        flow: f, metres along x y z of src: the content at y came from y + f(y). It is zero outside the grid.
        T_src_dst: maps points of dst to src.
        lower_m, voxel_m: lower corner (x y z) and voxel size of the grid, equal in both frames.
    """
    with full_precision(volume, flow, T_src_dst) as (volume, flow, T_src_dst):
        # y of every result voxel, in voxels of src
        points = source_points(T_src_dst, volume.shape[2:], lower_m, voxel_m)
        # y + f(y): where the content at y came from
        points = points + read_grid(flow, points).permute(0, 2, 3, 4, 1) / voxel_m
        return read_grid(volume, points)


def compose_flows(
    last: Float[Tensor, "b 3 Z Y X"], before: Float[Tensor, "b 3 Z Y X"], voxel_m: float
) -> Float[Tensor, "b 3 Z Y X"]:
    """Return the flow of two motions on one grid: y ↦ last(y) + before(y + last(y)), m."""
    with full_precision(last, before) as (last, before):
        # First back along the last motion, then along the one before
        points = _centres(last) + last.permute(0, 2, 3, 4, 1) / voxel_m
        return last + read_grid(before, points)


def read_grid(
    volume: Float[Tensor, "b D Z Y X"], points: Float[Tensor, "b Z Y X 3"]
) -> Float[Tensor, "b D Z Y X"]:
    """Return the volume interpolated at one point (x y z in voxel units) for each voxel of a grid."""
    read = sample_volume(volume.permute(0, 2, 3, 4, 1), points.flatten(1, 3))
    return read.unflatten(1, points.shape[1:4]).permute(0, 4, 1, 2, 3)


def source_points(
    T_src_dst: Float[Tensor, "b 4 4"],
    shape_zyx: Sequence[int],
    lower_m: tuple[float, float, float],
    voxel_m: float,
) -> Float[Tensor, "b Z Y X 3"]:
    """Return the positions (voxel units of src) of the voxel centres of an equal grid in the frame dst."""
    # Voxel centres of dst in metres, moved to src, back to voxel units of src
    centres = _centres(T_src_dst.new_empty(1, 1, *shape_zyx))
    lower = T_src_dst.new_tensor(lower_m)
    centres_m = (centres * voxel_m + lower).flatten(0, 2)
    source_m = transform_points(T_src_dst, centres_m.expand(len(T_src_dst), -1, -1))
    return ((source_m - lower) / voxel_m).unflatten(1, centres.shape[:3])


def _centres(grid: Float[Tensor, "b D Z Y X"]) -> Float[Tensor, "Z Y X 3"]:
    axes = [torch.arange(n, dtype=grid.dtype, device=grid.device) + 0.5 for n in grid.shape[2:]]
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    return torch.stack([x, y, z], dim=-1)
