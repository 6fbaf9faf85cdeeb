"""The head of semantic occupancy: an MLP for each voxel."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor, nn

from foredrive.scene.semantics import VOXEL_CLASSES, Taxonomy


@dataclass(frozen=True)
class VoxelHeadConfig:
    """Sizes of a `VoxelHead`."""

    taxonomy: Taxonomy = "occ3d"
    hidden: int = 32


class VoxelHead(nn.Module):
    """An MLP from the features of a voxel to the logits of its classes, as NeMo's occupancy MLP.

    Args:
        channels: D of the volume.
        config: sizes.
    """

    def __init__(self, channels: int, config: VoxelHeadConfig) -> None:
        super().__init__()
        self.taxonomy = config.taxonomy
        self.mlp = nn.Sequential(
            nn.Conv3d(channels, config.hidden, 1),
            nn.ReLU(),
            nn.Conv3d(config.hidden, len(VOXEL_CLASSES[config.taxonomy]), 1),
        )

    def forward(self, volume: Float[Tensor, "b D Z Y X"]) -> Float[Tensor, "b C Z Y X"]:
        """Return the logits in the order of `VOXEL_CLASSES`."""
        logits: Tensor = self.mlp(volume)
        return logits
