"""An encoder of images as a plane: a lifted volume with heights folded into channels."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from jaxtyping import Bool, Float
from torch import Tensor, nn

from foredrive.methods.blocks.lifting import LiftingConfig, LiftingEncoder
from foredrive.scene import CameraRig, VoxelSpec


@dataclass(frozen=True)
class PooledLiftingConfig:
    """Sizes of a `PooledLiftingEncoder`."""

    lifting: LiftingConfig
    kind: Literal["pooled"] = "pooled"


class PooledLiftingEncoder(nn.Module):
    """Deformable lifting into a volume, whose columns are then folded into one vector each.

    Args:
        config: sizes.
        spec: grid of the volume.
        channels: D.
        plane_channels: C of the plane.
        levels: number of image feature levels.
    """

    def __init__(
        self, config: PooledLiftingConfig, spec: VoxelSpec, *, channels: int, plane_channels: int, levels: int
    ) -> None:
        super().__init__()
        self.lifting = LiftingEncoder(config.lifting, spec, channels=channels, levels=levels)
        self.fold = nn.Linear(spec.shape_zyx[0] * channels, plane_channels)

    @property
    def spec(self) -> VoxelSpec:
        """Grid of the volume."""
        return self.lifting.spec

    def forward(
        self,
        features: Sequence[Float[Tensor, "b C _h _w D"]],
        rig: CameraRig,
        image_valid: Bool[Tensor, "b C"],
    ) -> Float[Tensor, "b _W Y X"]:
        """Encode image features as a plane."""
        volume = self.lifting(features, rig, image_valid)
        return self.fold(volume.permute(0, 3, 4, 2, 1).flatten(3)).permute(0, 3, 1, 2)
