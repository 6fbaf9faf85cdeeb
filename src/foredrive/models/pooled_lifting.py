"""A plane from a lifted volume: heights folded into channels."""

from collections.abc import Sequence

from jaxtyping import Bool, Float
from torch import Tensor, nn

from foredrive.models.lifting import LiftingEncoder
from foredrive.scene import CameraRig, VoxelSpec


class PooledLiftingEncoder(nn.Module):
    """Deformable lifting into a volume whose columns are folded into one vector each.

    Args:
        lifting: the encoder of the volume, of D channels.
        channels: D.
        width: C of the plane.
    """

    def __init__(self, lifting: LiftingEncoder, *, channels: int, width: int) -> None:
        super().__init__()
        self.lifting, self.width = lifting, width
        self.fold = nn.Linear(lifting.spec.shape_zyx[0] * channels, width)

    @property
    def spec(self) -> VoxelSpec:
        """Of the volume."""
        return self.lifting.spec

    def forward(
        self,
        features: Sequence[Float[Tensor, "b C _h _w D"]],
        rig: CameraRig,
        image_valid: Bool[Tensor, "b C"],
    ) -> Float[Tensor, "b _W Y X"]:
        """Image features to a plane."""
        volume = self.lifting(features, rig, image_valid)
        return self.fold(volume.permute(0, 3, 4, 2, 1).flatten(3)).permute(0, 3, 1, 2)
