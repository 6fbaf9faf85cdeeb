"""Lift-splat (Philion & Fidler 2020): image features to a plane by a distribution over depth."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from foredrive.geometry.projection import pixel_centres, pixels_to_rays
from foredrive.geometry.se3 import transform_points
from foredrive.scene import CameraRig, VoxelSpec


@dataclass(frozen=True)
class LiftSplatConfig:
    """Depth range of a `LiftSplatEncoder` (4 to 45 m in steps of 1 m in the paper)."""

    near_m: float
    """First depth, m."""
    far_m: float
    """Depths are less than this, m."""
    step_m: float
    """Distance between depths, m."""
    norm_groups: int = 4
    """Groups of the group normalisation."""
    kind: Literal["lift_splat"] = "lift_splat"


class LiftSplatEncoder(nn.Module):
    """An encoder that places each feature at every depth along its ray, weighted by depth probability.

    The contributions to each cell of the plane are summed.

    Args:
        config: depths.
        spec: grid whose plane and range of heights are filled.
        channels: D of the image features.
        plane_channels: C of the plane.
        levels: number of image feature levels; only the finest is read.
    """

    depths_m: Tensor

    def __init__(
        self, config: LiftSplatConfig, spec: VoxelSpec, *, channels: int, plane_channels: int, levels: int
    ) -> None:
        super().__init__()
        self.spec, self.plane_channels = spec, plane_channels
        depths_m = torch.arange(config.near_m, config.far_m, config.step_m)
        self.register_buffer("depths_m", depths_m, persistent=False)
        # One linear layer gives depth logits and context features at every image position
        self.depth_and_context = nn.Linear(channels, len(self.depths_m) + plane_channels)
        self.out = nn.Sequential(
            nn.Conv2d(plane_channels, plane_channels, 3, padding=1),
            nn.GroupNorm(config.norm_groups, plane_channels),
            nn.ReLU(),
            nn.Conv2d(plane_channels, plane_channels, 1),
        )

    def forward(
        self,
        features: Sequence[Float[Tensor, "b C _h _w D"]],
        rig: CameraRig,
        image_valid: Bool[Tensor, "b C"],
    ) -> Float[Tensor, "b _W Y X"]:
        """Encode image features as a plane."""
        finest = features[0]
        sizes = [len(self.depths_m), self.plane_channels]
        depth, context = self.depth_and_context(finest).float().split(sizes, dim=-1)
        # The depth distribution of an invalid image is zero everywhere, so it adds nothing to the plane
        depth = depth.softmax(-1) * image_valid[:, :, None, None, None]
        cell, inside = self.cells(rig, (finest.shape[2], finest.shape[3]))
        plane = splat(depth.flatten(1, 3), context.flatten(1, 3), cell, inside, self.spec.shape_zyx[1:])
        return self.out(plane)

    def cells(
        self, rig: CameraRig, feature_hw: tuple[int, int]
    ) -> tuple[Int[Tensor, "b P"], Bool[Tensor, "b P"]]:
        """Return the cell (y · X + x) of each depth of each feature, and whether it is in the grid."""
        points = self.points_m(rig, feature_hw)
        lower = points.new_tensor(self.spec.lower_m)
        index = ((points - lower) / self.spec.voxel_m).floor().long()
        shape_xyz = torch.tensor(self.spec.shape_zyx[::-1], device=points.device)
        inside = ((index >= 0) & (index < shape_xyz)).all(-1)
        # Points of all heights share the cell of their column; the
        # height only decides whether they are inside
        cell = index[..., 1] * self.spec.shape_zyx[2] + index[..., 0]
        return cell, inside

    def points_m(self, rig: CameraRig, feature_hw: tuple[int, int]) -> Float[Tensor, "b P 3"]:
        """Return ego coordinates (m) of each depth of each feature: cameras, rows, columns, depths."""
        h, w = feature_hw
        # Centres of feature cells in pixels of the full image
        scale = rig.K.new_tensor([rig.size_hw[1] / w, rig.size_hw[0] / h])
        uv = pixel_centres((h, w)).to(rig.K).flatten(0, 1) * scale
        b, c = rig.K.shape[:2]
        rays = pixels_to_rays(uv.expand(b, c, -1, 2), rig.K, rig.dist)
        rays = rays / rays[..., 2:]  # normalised by depth, not by range
        # One point per depth on each ray, in the camera frame; depth is z of the camera, not the distance
        in_camera = rays[..., None, :] * self.depths_m[:, None]
        return transform_points(rig.T_ego_cam, in_camera.flatten(2, 3)).flatten(1, 2)


def splat(
    share: Float[Tensor, "b N K"],
    feature: Float[Tensor, "b N W"],
    cell: Int[Tensor, "b P"],
    inside: Bool[Tensor, "b P"],
    size_yx: tuple[int, int],
) -> Float[Tensor, "b W Y X"]:
    """Sum the contributions to each cell of a plane. Nothing is computed for points outside.

    Args:
        share: weight of each of N features at each of K depths.
        cell: index y · X + x of each of the P = N·K points; any value where not `inside`.
    """
    b, count, width = len(share), size_yx[0] * size_yx[1], feature.shape[-1]
    # Feature of each inside point: K consecutive points belong to one feature
    source = inside.flatten().nonzero()[:, 0] // share.shape[-1]
    values = share.flatten(1)[inside][:, None] * feature.flatten(0, 1)[source]
    # Offset of each batch element, so that one index_add serves the whole batch
    first = torch.arange(b, device=cell.device)[:, None] * count
    plane = values.new_zeros(b * count, width).index_add(0, (first + cell)[inside], values)
    return plane.view(b, *size_yx, width).permute(0, 3, 1, 2)
