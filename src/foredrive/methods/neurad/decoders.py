"""Decoders of a field's features: images from patches of rays, intensity and ray drop from beams."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

UPSAMPLING = 3
"""Pixels along a side for which one ray stands, as in NeuRAD's reference implementation."""
_FIRST_DROP_LOGIT = -2.0
"""Initial logit of the probability that a beam does not return."""


@dataclass(frozen=True)
class PatchDecoderConfig:
    """Sizes of a `PatchDecoder`. The defaults are those of NeuRAD's reference implementation."""

    width: int = 32
    """Channels before the image is enlarged."""
    fine_width: int = 32
    """Channels after the image is enlarged."""
    kernel: int = 7
    """Side of the convolutions of the blocks, px; odd."""
    coarse_blocks: int = 2
    """Residual blocks before the image is enlarged."""
    fine_blocks: int = 2
    """Residual blocks after the image is enlarged."""
    batch_norm: bool = True
    """Batch normalisation after each convolution of the blocks."""

    def __post_init__(self) -> None:
        """Check that images keep their size."""
        if self.kernel % 2 == 0:
            raise ValueError(f"a kernel of {self.kernel} pixels has no middle: its size must be odd")


class PatchDecoder(nn.Module):
    """A CNN from the features of a patch of rays to an image with three times as many pixels a side.

    Args:
        features: number of the field's features.
        cameras: number of cameras, each with an appearance code.
        appearance: size of a code.
        config: sizes of the layers.
    """

    def __init__(self, features: int, cameras: int, appearance: int, config: PatchDecoderConfig) -> None:
        super().__init__()
        self.appearance = nn.Parameter(torch.randn(cameras, appearance))
        width, fine = config.width, config.fine_width
        self.first = nn.Conv2d(features + appearance, width, 1)
        self.coarse = nn.Sequential(*(_Block(width, config) for _ in range(config.coarse_blocks)))
        # As a transposed convolution of kernel and stride 3: each ray gives the channels of nine pixels.
        self.enlarge = nn.Conv2d(width, fine * UPSAMPLING**2, 1)
        self.fine = nn.Sequential(*(_Block(fine, config) for _ in range(config.fine_blocks)))
        self.last = nn.Conv2d(fine, 3, 1)

    def forward(
        self, feature: Float[Tensor, "n H W D"], camera: Int[Tensor, "n"]
    ) -> Float[Tensor, "n 3 H3 W3"]:
        """Return patches of images, RGB from 0 to 1.

        Args:
            feature: features of the patches' rays.
            camera: index of each patch's camera. In training, batch normalisation takes its statistics over
                all patches of a call, of whichever cameras they are.
        """
        code = self.appearance.index_select(0, camera)[:, None, None].expand(*feature.shape[:3], -1)
        # Features and the camera's appearance code, as channels of an image
        seen = torch.cat([feature, code], dim=-1).permute(0, 3, 1, 2)
        coarse = self.coarse(F.relu(self.first(seen)))
        # Nine sets of channels per ray become the 3 x 3 pixels for which it stands
        fine = F.pixel_shuffle(self.enlarge(coarse), UPSAMPLING)
        image: Tensor = self.last(self.fine(fine)).sigmoid()
        return image


class _Block(nn.Module):
    """Two convolutions and a shortcut."""

    def __init__(self, width: int, config: PatchDecoderConfig) -> None:
        super().__init__()

        def convolution() -> list[nn.Module]:
            padded = nn.Conv2d(width, width, config.kernel, padding=config.kernel // 2)
            return [padded, nn.BatchNorm2d(width)] if config.batch_norm else [padded]

        self.net = nn.Sequential(*convolution(), nn.ReLU(), *convolution())

    def forward(self, x: Float[Tensor, "n C H W"]) -> Float[Tensor, "n C H W"]:
        """Return features of the same size."""
        return F.relu(x + self.net(x))


class BeamDecoder(nn.Module):
    """An MLP from a beam's feature to intensity and ray drop, as in NeuRAD."""

    def __init__(self, features: int, appearance: int, width: int = 32) -> None:
        super().__init__()
        self.appearance = nn.Parameter(torch.randn(appearance))
        self.net = nn.Sequential(
            nn.Linear(features + appearance, width),
            nn.ReLU(),
            nn.Linear(width, width),
            nn.ReLU(),
            nn.Linear(width, 2),
        )
        # At first every beam is more likely to return than not. Where a log has no lost beams, this stays so.
        with torch.no_grad():
            self.net[-1].weight[1] = 0  # type: ignore[operator]
            self.net[-1].bias[1] = _FIRST_DROP_LOGIT  # type: ignore[operator]

    def forward(self, feature: Float[Tensor, "P D"]) -> tuple[Float[Tensor, "P"], Float[Tensor, "P"]]:
        """Return intensity from 0 to 1, and the logit of the probability that the beam does not return."""
        code = self.appearance.expand(len(feature), -1)
        intensity, drop_logit = self.net(torch.cat([feature, code], dim=-1)).unbind(-1)
        return intensity.sigmoid(), drop_logit
