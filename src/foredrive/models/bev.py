"""A bird's-eye-view encoder after BEVFormer (Li et al. 2022): the planar baseline in Table 1 of NeMo."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from foredrive.models.lifting import LiftingLayer, directions_2d, place_code, project_to_cameras, refine
from foredrive.ops.attention3d import attend_volume
from foredrive.ops.lifting import lift
from foredrive.scene import CameraRig, VoxelSpec


@dataclass(frozen=True)
class BevConfig:
    """Sizes of a `BevEncoder`."""

    width: int
    """W, the channels of a cell."""
    heads: int
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


class PlaneSelfAttention(nn.Module):
    """Deformable self-attention in the plane: each cell reads P learned places around itself, in H heads."""

    def __init__(self, channels: int, heads: int, points: int) -> None:
        super().__init__()
        self.heads, self.points = heads, points
        self.value = nn.Linear(channels, channels)
        self.offset = nn.Linear(channels, heads * points * 2)
        self.weight = nn.Linear(channels, heads * points)
        self.out = nn.Linear(channels, channels)
        nn.init.zeros_(self.offset.weight)
        radius = torch.arange(1, points + 1).view(1, points, 1)
        with torch.no_grad():
            self.offset.bias.copy_((directions_2d(heads)[:, None] * radius).flatten())
        nn.init.zeros_(self.weight.weight)
        nn.init.zeros_(self.weight.bias)

    def forward(
        self, query: Float[Tensor, "b Q W"], shape_zyx: tuple[int, int, int], place: Float[Tensor, "Q 3"]
    ) -> Float[Tensor, "b Q W"]:
        """Attend among the cells of the plane.

        Args:
            query: cell features in Y X order.
            shape_zyx: (1, Y, X).
            place: cell centres in cell units (x, y, z = 0.5).
        """
        b, q, _ = query.shape
        offset = F.pad(self.offset(query).view(b, q, self.heads, self.points, 2), (0, 1))
        weight = self.weight(query).view(b, q, self.heads, self.points).softmax(-1)
        values = self.value(query).view(b, *shape_zyx, -1)
        return self.out(attend_volume(values, place[:, None, None] + offset, weight))


class PillarCrossAttention(nn.Module):
    """Deformable cross-attention of a cell: it reads around the projections of K heights above it.

    As in BEVFormer, the P points of a head and level are divided among the heights, and one softmax weights
    all of them. Each height is averaged over the cameras that see it.

    Args:
        features: channels of the image features.
        channels: W, channels of the cells.
        heads, levels, points: as in `CameraCrossAttention`; `points` is per height.
        pillars: K.
    """

    def __init__(
        self, features: int, channels: int, heads: int, levels: int, points: int, pillars: int
    ) -> None:
        super().__init__()
        self.shape = (pillars, heads, levels, points)
        self.value = nn.Linear(features, channels)
        self.offset = nn.Linear(channels, pillars * heads * levels * points * 2)
        self.weight = nn.Linear(channels, pillars * heads * levels * points)
        self.out = nn.Linear(channels, channels)
        nn.init.zeros_(self.offset.weight)
        radius = torch.arange(points).view(1, points, 1)
        with torch.no_grad():
            spread = directions_2d(heads)[:, None, None] * radius
            self.offset.bias.copy_(spread.expand(*self.shape, 2).flatten())
        nn.init.zeros_(self.weight.weight)
        nn.init.zeros_(self.weight.bias)

    def forward(
        self,
        query: Float[Tensor, "_b Q W"],
        features: Sequence[Float[Tensor, "b C _h _w D"]],
        uv: Float[Tensor, "b C N 2"],
        visible: Bool[Tensor, "b C N"],
    ) -> Float[Tensor, "b Q W"]:
        """Attend to the cameras.

        Args:
            query: cells, of batch size b or 1.
            features: image features, one tensor per level.
            uv, visible: projections of N = Q·K points, heights last, and their visibility.
        """
        b, q = len(uv), query.shape[1]
        pillars, heads, levels, points = self.shape
        offset = self.offset(query).view(-1, q * pillars, heads, levels, points, 2)
        score = self.weight(query).view(-1, q, *self.shape).transpose(2, 3)  # [b Q H K L P]
        weight = score.flatten(3).softmax(-1).view(score.shape).transpose(2, 3).flatten(1, 2)
        values = [self.value(level) for level in features]
        read = lift(
            values, uv, visible, offset.expand(b, *offset.shape[1:]), weight.expand(b, *weight.shape[1:])
        )
        return self.out(read.unflatten(1, (q, pillars)).sum(2))


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
        y, x = torch.meshgrid(torch.arange(ny) + 0.5, torch.arange(nx) + 0.5, indexing="ij")
        place = torch.stack([x, y, torch.full_like(x, 0.5)], dim=-1).flatten(0, 1)
        self.register_buffer("place", place, persistent=False)
        up = (torch.arange(pillars) + 0.5) * height / pillars
        pillar = torch.cat(
            [place[:, None, :2].expand(-1, pillars, -1), up[None, :, None].expand(len(place), -1, -1)], -1
        )
        pillars_m = torch.tensor(spec.lower_m) + spec.voxel_m * pillar.flatten(0, 1)
        self.register_buffer("pillars_m", pillars_m, persistent=False)
        self.query = nn.Parameter(place_code(spec.centres_m(place.device)[0].flatten(0, 1), width))
        self.layers = nn.ModuleList(
            [
                LiftingLayer(
                    width,
                    PlaneSelfAttention(width, heads, points),
                    PillarCrossAttention(channels, width, heads, levels, points, pillars),
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
        volume = self.unfold(plane).view(len(uv), ny, nx, height, -1)
        return volume.permute(0, 3, 1, 2, 4).contiguous().permute(0, 4, 1, 2, 3)
