"""A small image tower: a ResNet with attention pooling."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from foredrive.methods.blocks.backbone import normalise_images, normalise_rgb
from foredrive.methods.lidarclip.attention_pool import AttentionPool


@dataclass(frozen=True)
class ImageTowerConfig:
    """Sizes of an `ImageTower`."""

    widths: tuple[int, ...]
    """Channels of the stages of the ResNet."""
    depths: tuple[int, ...]
    """Number of basic layers of each stage."""
    heads: int
    """Heads of the attention pool."""
    side_px: int
    """Length of the shorter side of the training images."""


class ImageTower(nn.Module):
    """A ResNet (He et al. 2016) with an attention pool: images of any size to D numbers.

    Args:
        config: sizes.
        dim: D.
    """

    def __init__(self, config: ImageTowerConfig, *, dim: int) -> None:
        from transformers import ResNetBackbone, ResNetConfig  # slow to import

        super().__init__()
        widths, last = config.widths, f"stage{len(config.widths)}"
        self.resnet = ResNetBackbone(
            ResNetConfig(
                embedding_size=widths[0],
                hidden_sizes=list(widths),
                depths=list(config.depths),
                layer_type="basic",
                out_features=[last],
            )
        )
        self.pool = AttentionPool(widths[-1], config.heads, dim)

    def forward(self, images: UInt8[Tensor, "n 3 H W"]) -> Float[Tensor, "n D"]:
        """Return one vector per image."""
        # Channels-last memory is the faster layout for convolutions
        pixels = normalise_images(images).contiguous(memory_format=torch.channels_last)
        (features,) = self.resnet(pixels).feature_maps
        return self.pool(features.flatten(2).mT)


class ImageTowerFeatures(nn.Module):
    """Activations of the first stages of a trained `ImageTower`, frozen, for a perceptual loss.

    Images are enlarged first, because the tower was trained on whole ones and its first stage has stride 4.

    Args:
        tower: a trained tower.
        stages: number of stages that are read.
        enlarge: factor of enlargement.
    """

    def __init__(self, tower: ImageTower, *, stages: int = 3, enlarge: int = 4) -> None:
        super().__init__()
        self.enlarge = enlarge
        self.embedder = tower.resnet.embedder
        self.stages = nn.ModuleList(list(tower.resnet.encoder.stages)[:stages])
        self.requires_grad_(False)
        self.eval()

    def train(self, mode: bool = True) -> "ImageTowerFeatures":
        """Stay in evaluation mode, because the features are fixed."""
        return super().train(False)

    def forward(self, rgb: Float[Tensor, "n 3 H W"]) -> tuple[Float[Tensor, "n _c _h _w"], ...]:
        """Return features of RGB images in [0, 1]."""
        enlarged = F.interpolate(rgb, scale_factor=float(self.enlarge), mode="bilinear", align_corners=False)
        x = self.embedder(normalise_rgb(enlarged))
        features = []
        for stage in self.stages:
            x = stage(x)
            features.append(x)
        return tuple(features)
