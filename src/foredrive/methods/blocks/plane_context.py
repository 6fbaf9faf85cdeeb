"""A U-Net in the plane that gives each column of a volume its surroundings."""

from dataclasses import dataclass

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.scene import VoxelSpec


@dataclass(frozen=True)
class PlaneContextConfig:
    """Sizes of a `PlaneContext`."""

    widths: tuple[int, int] = (96, 128)
    """Channels at half and at a quarter of the resolution."""
    blocks: tuple[int, int] = (2, 3)
    """Residual blocks at half and at a quarter of the resolution."""


class PlaneContext(nn.Module):
    """A residual U-Net over x and y; the heights of a column are its channels.

    It is not part of NeMo. Lifting reads the images for each voxel apart. The U-Net relates the columns at
    the cost of 2-D convolutions at half and at a quarter of the resolution.

    Args:
        config: sizes.
        channels: D.
        height: Z.
    """

    def __init__(self, config: PlaneContextConfig, *, channels: int, height: int) -> None:
        from transformers.models.resnet.modeling_resnet import ResNetBasicLayer  # slow to import

        super().__init__()
        half, quarter = config.widths
        at_half, at_quarter = config.blocks
        self.down = nn.Sequential(
            nn.Conv2d(height * channels, half, 3, stride=2, padding=1, bias=False),
            nn.BatchNorm2d(half),
            nn.ReLU(),
        )
        self.fine = nn.Sequential(*[ResNetBasicLayer(half, half) for _ in range(at_half - 1)])
        self.coarse = nn.Sequential(
            ResNetBasicLayer(half, quarter, stride=2),
            *[ResNetBasicLayer(quarter, quarter) for _ in range(at_quarter - 1)],
        )
        self.lateral = nn.Conv2d(quarter, half, 1)
        self.merged = ResNetBasicLayer(half, half)
        self.out = nn.Conv2d(half, 4 * height * channels, 1)

    def forward(self, volume: Float[Tensor, "b D Z Y X"]) -> Float[Tensor, "b D Z Y X"]:
        """Return the volume with context, channels-last in memory."""
        b, d, z, y, x = volume.shape
        # Heights and channels of a column become the channels of an image, heights outermost
        plane = volume.permute(0, 3, 4, 2, 1).reshape(b, y, x, z * d).permute(0, 3, 1, 2)
        fine = self.fine(self.down(plane))
        coarse = self.lateral(self.coarse(fine))
        merged = self.merged(fine + F.interpolate(coarse, size=fine.shape[-2:], mode="nearest"))
        # The 4 · Z · D channels at half resolution are Z · D of each of 2 by 2 cells, as in a pixel shuffle.
        # Here the cells come first, so that the channels of a voxel stay together in memory
        assert self.out.bias is not None
        weight, bias = (
            of_out.unflatten(0, (z, d, 2, 2)).permute(2, 3, 0, 1, *range(4, of_out.dim() + 3)).flatten(0, 3)
            for of_out in (self.out.weight, self.out.bias)
        )
        change = F.conv2d(merged, weight, bias).permute(0, 2, 3, 1).unflatten(-1, (2, 2, z, d))
        change = change.permute(0, 5, 1, 3, 2, 4, 6).reshape(b, z, 2 * len(change[0]), -1, d)
        # An odd size was rounded up by the strided convolution: cut to the size of the volume above
        whole = volume.permute(0, 2, 3, 4, 1) + change[:, :, :y, :x].to(volume.dtype)
        return whole.permute(0, 4, 1, 2, 3)


def plane_context(config: PlaneContextConfig | None, spec: VoxelSpec, channels: int) -> nn.Module:
    """Return the context of a volume on `spec`; without a config, it changes nothing."""
    if config is None:
        return nn.Identity()
    return PlaneContext(config, channels=channels, height=spec.shape_zyx[0])
