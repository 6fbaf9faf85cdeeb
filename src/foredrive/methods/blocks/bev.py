"""A bird's-eye-view encoder after BEVFormer (Li et al. 2022): the planar baseline in Table 1 of NeMo."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from foredrive.methods.blocks.lifting import (
    CameraCrossAttention,
    LiftingLayer,
    NeighbourhoodAttention,
    directions_2d,
    position_code,
    project_to_cameras,
    refine,
)
from foredrive.scene import CameraRig, VoxelSpec


@dataclass(frozen=True)
class BevConfig:
    """Sizes of a `BevEncoder`."""

    width: int
    """W, the channels of a cell."""
    heads: int
    """Heads of the deformable attention to images and among cells."""
    points: int
    """Points read per head, level and height."""
    pillars: int
    """Heights read above a cell, evenly spaced over the grid."""
    layers: int
    """Rounds of refinement."""
    feed_forward: float = 2.0
    """Hidden width of the feed-forward networks, as a multiple of `width`."""
    checkpoint: bool = False
    """Keep only the input of each round for the backward pass and recompute the rest."""
    kind: Literal["bev"] = "bev"


class BevEncoder(nn.Module):
    """Learned queries of a plane, refined by attention to the cameras and then unfolded into a volume.

    The output has the shape of the volume of `LiftingEncoder`, so occupancy, motion and planning are the same
    for both. All information about height passes through W numbers per cell. Frames are encoded one by one
    (BEVFormer-S); the motion module relates them in time.

    Args:
        config: sizes.
        spec: grid of the volume.
        channels: D, of the volume and of the image features.
        levels: number of image feature levels.
    """

    place: Tensor
    pillars_m: Tensor

    def __init__(self, config: BevConfig, spec: VoxelSpec, *, channels: int, levels: int) -> None:
        super().__init__()
        self.spec, self.checkpoint = spec, config.checkpoint
        width, heads, points, pillars = config.width, config.heads, config.points, config.pillars
        height, ny, nx = spec.shape_zyx
        # Cell centres in cell units; a plane counts as a grid of height 1, whose centre is at 0.5
        y, x = torch.meshgrid(torch.arange(ny) + 0.5, torch.arange(nx) + 0.5, indexing="ij")
        place = torch.stack([x, y, torch.full_like(x, 0.5)], dim=-1).flatten(0, 1)
        self.register_buffer("place", place, persistent=False)
        # Heights of the pillar points in cells, at the centres of equal parts of the height range
        up = (torch.arange(pillars) + 0.5) * height / pillars
        # All heights of a cell lie next to each other: points are ordered [cell, height]
        pillar = torch.cat(
            [place[:, None, :2].expand(-1, pillars, -1), up[None, :, None].expand(len(place), -1, -1)], -1
        )
        pillars_m = torch.tensor(spec.lower_m) + spec.voxel_m * pillar.flatten(0, 1)
        self.register_buffer("pillars_m", pillars_m, persistent=False)
        # Only the lowest layer of voxels is needed for the code: a plane has no height of its own
        self.query = nn.Parameter(position_code(spec.centres_m(place.device)[0].flatten(0, 1), width))
        self.layers = nn.ModuleList(
            [
                LiftingLayer(
                    width,
                    NeighbourhoodAttention(width, directions_2d(heads), points),
                    CameraCrossAttention(
                        channels, width, heads=heads, levels=levels, points=points, heights=pillars
                    ),
                    config.feed_forward,
                )
                for _ in range(config.layers)
            ]
        )
        self.unfold = nn.Linear(width, height * channels)

    def forward(
        self,
        features: Sequence[Float[Tensor, "b C _h _w D"]],
        rig: CameraRig,
        image_valid: Bool[Tensor, "b C"],
    ) -> Float[Tensor, "b D Z Y X"]:
        """Encode image features as a plane and unfold it into a volume, channels-last in memory."""
        uv, visible = project_to_cameras(self.pillars_m, rig, image_valid)
        height, ny, nx = self.spec.shape_zyx
        plane = refine(
            self.layers,
            self.query[None],
            (1, ny, nx),
            self.place,
            features,
            uv,
            visible,
            recompute=self.checkpoint,
        )
        # Unfold W numbers per cell to D features at each height
        volume = self.unfold(plane).view(len(uv), ny, nx, height, -1)
        # The memory order is [b Z Y X D] (channels last), the logical order [b D Z Y X]
        return volume.permute(0, 3, 1, 2, 4).contiguous().permute(0, 4, 1, 2, 3)
