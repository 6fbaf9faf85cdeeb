"""The simplest lifting of camera features to a volume, as a baseline for attention."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from foredrive.methods.blocks.lifting import position_code, project_to_cameras
from foredrive.methods.blocks.plane_context import PlaneContextConfig, plane_context
from foredrive.ops.lifting import lift
from foredrive.scene import CameraRig, VoxelSpec

PLACE_CHANNELS = 28
"""Channels of the position code that are not random (`position_code`)."""


@dataclass(frozen=True)
class AveragingConfig:
    """Sizes of an `AveragingEncoder`."""

    hidden: int | None
    """Channels between two 3-D convolutions. None leaves the convolutions out."""
    gate: int | None = None
    """Hidden width of the gate: each voxel scales and shifts its features by learned functions of its place.
    None leaves it out."""
    context: PlaneContextConfig | None = None
    """U-Net in the plane after the convolutions."""
    kind: Literal["averaging"] = "averaging"


class AveragingEncoder(nn.Module):
    """One bilinear sample per voxel and camera, and the mean over cameras; then gate and convolutions.

    As in Simple-BEV (Harley et al. 2023) and ImVoxelNet (Rukhovich et al. 2022), sampling positions are not
    learned. All voxels along a ray read the same features; gate, convolutions and context separate them.

    Args:
        config: sizes.
        spec: grid of the volume.
        channels: D.
        levels: number of image feature levels; only the finest is read.
    """

    centres_m: Tensor
    place: Tensor

    def __init__(self, config: AveragingConfig, spec: VoxelSpec, *, channels: int, levels: int) -> None:
        super().__init__()
        self.spec, hidden = spec, config.hidden
        centres = spec.centres_m(torch.get_default_device()).flatten(0, 2)
        self.register_buffer("centres_m", centres, persistent=False)
        # The gate depends on the place of a voxel only, so it is the same for all clips and cameras
        self.gate: nn.Sequential | None = None
        if config.gate is not None:
            self.register_buffer("place", position_code(centres, PLACE_CHANNELS), persistent=False)
            self.gate = nn.Sequential(
                nn.Linear(PLACE_CHANNELS, config.gate), nn.ReLU(), nn.Linear(config.gate, 2 * channels)
            )
        self.convolve: nn.Module = nn.Identity()
        if hidden is not None:
            self.convolve = nn.Sequential(
                nn.Conv3d(channels, hidden, 3, padding=1),
                nn.ReLU(),
                nn.Conv3d(hidden, channels, 3, padding=1),
            )
        self.context = plane_context(config.context, spec, channels)

    def forward(
        self,
        features: Sequence[Float[Tensor, "b C _h _w D"]],
        rig: CameraRig,
        image_valid: Bool[Tensor, "b C"],
    ) -> Float[Tensor, "b D Z Y X"]:
        """Lift the finest image features. The result is channels-last in memory."""
        # Sample at the exact projection (zero offset) with weight 1:
        # the mean over the cameras that see the voxel
        uv, visible = project_to_cameras(self.centres_m, rig, image_valid)
        b, q = len(uv), len(self.centres_m)
        at_projection = uv.new_zeros(b, q, 1, 1, 1, 2)
        read = lift(features[:1], uv, visible, at_projection, uv.new_ones(b, q, 1, 1, 1))
        if self.gate is not None:
            # The scale is learned as a deviation from 1, so a gate near
            # zero leaves the features as they are
            scale, shift = self.gate(self.place).chunk(2, dim=-1)
            read = read * (1 + scale) + shift
        volume = read.unflatten(1, self.spec.shape_zyx).permute(0, 4, 1, 2, 3)
        lifted: Tensor = self.context(self.convolve(volume))
        return lifted
