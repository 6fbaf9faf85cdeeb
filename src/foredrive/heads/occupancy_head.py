"""The head of semantic occupancy: an MLP for each voxel, which knows its surroundings in the plane."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor, nn

from foredrive.heads.plane import PlanePyramid, Planes
from foredrive.scene.semantics import VOXEL_CLASSES, Taxonomy


@dataclass(frozen=True)
class VoxelHeadConfig:
    """Sizes of a `VoxelHead`."""

    taxonomy: Taxonomy = "occ3d"
    hidden: int = 32


class VoxelHead(nn.Module):
    """An MLP from the features of a voxel and of its column to the logits of the voxel's classes.

    The column's features come from the fine plane and become one vector for each height (FlashOcc, Yu et al.
    2023).

    Args:
        planes: the module that makes the planes.
        channels: D of the volume.
        height: Z of the volume.
        config: sizes.
    """

    def __init__(self, planes: PlanePyramid, channels: int, height: int, config: VoxelHeadConfig) -> None:
        super().__init__()
        self.taxonomy = config.taxonomy
        self.height = height
        self.own = nn.Conv3d(channels, config.hidden, 1)
        self.column = nn.Conv2d(planes.fine_width, height * config.hidden, 1)
        self.out = nn.Conv3d(config.hidden, len(VOXEL_CLASSES[config.taxonomy]), 1)

    def forward(self, volume: Float[Tensor, "b D Z Y X"], planes: Planes) -> Float[Tensor, "b C Z Y X"]:
        """Return the logits in the order of `VOXEL_CLASSES`."""
        # One vector of the column for each height, added to the features of each voxel
        around = self.column(planes.fine.features).unflatten(1, (-1, self.height))
        logits: Tensor = self.out((self.own(volume) + around).relu())
        return logits
