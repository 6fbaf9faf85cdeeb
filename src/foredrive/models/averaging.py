"""The simplest lifting of camera features to a volume, as a baseline for attention."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from foredrive.models.lifting import project_to_cameras
from foredrive.ops.lifting import lift
from foredrive.scene import CameraRig, VoxelSpec


@dataclass(frozen=True)
class AveragingConfig:
    """Sizes of an `AveragingEncoder`."""

    hidden: int
    """Channels between the two convolutions."""
    kind: Literal["averaging"] = "averaging"


class AveragingEncoder(nn.Module):
    """One bilinear sample per voxel and camera, the mean over cameras, and two 3-D convolutions.

    As in Simple-BEV (Harley et al. 2023) and ImVoxelNet (Rukhovich et al. 2022), sampling positions are not
    learned. Only the convolutions can separate the voxels along a ray.

    Args:
        config: sizes.
        spec: grid of the volume.
        channels: D.
        levels: number of image feature levels; only the finest is read.
    """

    centres_m: Tensor

    def __init__(self, config: AveragingConfig, spec: VoxelSpec, *, channels: int, levels: int) -> None:
        super().__init__()
        self.spec, hidden = spec, config.hidden
        centres = spec.centres_m(torch.get_default_device()).flatten(0, 2)
        self.register_buffer("centres_m", centres, persistent=False)
        self.convolve = nn.Sequential(
            nn.Conv3d(channels, hidden, 3, padding=1), nn.ReLU(), nn.Conv3d(hidden, channels, 3, padding=1)
        )

    def forward(
        self,
        features: Sequence[Float[Tensor, "b C _h _w D"]],
        rig: CameraRig,
        image_valid: Bool[Tensor, "b C"],
    ) -> Float[Tensor, "b D Z Y X"]:
        """Lift the finest image features. The result is channels-last in memory."""
        uv, visible = project_to_cameras(self.centres_m, rig, image_valid)
        b, q = len(uv), len(self.centres_m)
        at_projection = uv.new_zeros(b, q, 1, 1, 1, 2)
        read = lift(features[:1], uv, visible, at_projection, uv.new_ones(b, q, 1, 1, 1))
        return self.convolve(read.unflatten(1, self.spec.shape_zyx).permute(0, 4, 1, 2, 3))
