"""Image features at several resolutions: a ResNet from transformers with a feature pyramid."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from foredrive.errors import InputError

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


def normalise_images(images: UInt8[Tensor, "n 3 H W"]) -> Float[Tensor, "n 3 H W"]:
    """Normalise 8-bit RGB images to zero mean and unit variance by the statistics of ImageNet."""
    return normalise_rgb(images.float() / 255)


def normalise_rgb(rgb: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n 3 H W"]:
    """Normalise RGB images in [0, 1] by the statistics of ImageNet."""
    mean = torch.tensor(IMAGENET_MEAN, device=rgb.device).view(3, 1, 1)
    std = torch.tensor(IMAGENET_STD, device=rgb.device).view(3, 1, 1)
    return (rgb - mean) / std


@dataclass(frozen=True)
class BackboneConfig:
    """Sizes of an `ImageBackbone`."""

    embedding_size: int
    """Channels of the stem of the ResNet."""
    hidden_sizes: tuple[int, ...]
    """Channels of the stages. `hidden_sizes`, `depths` and `layer_type` are those of
    `transformers.ResNetConfig`."""
    depths: tuple[int, ...]
    """Number of residual blocks of each stage."""
    layer_type: Literal["basic", "bottleneck"]
    """Residual blocks of the stages: "basic" ones of two convolutions, or "bottleneck" ones of three."""
    stages: tuple[str, ...]
    """Stages that feed the pyramid, e.g. ("stage2", "stage3")."""
    stem_stride: Literal[2, 4] = 4
    """Stride of the stem. 2 leaves its max pooling out, which halves the strides of all stages."""
    levels: int | None = None
    """Number of levels that the encoder reads, finest first; None: all. The pyramid hands the coarse stages
    down to them."""
    weights: str | None = None
    """Hub name or local folder of a `transformers` ResNet; None starts from random weights. Its sizes
    replace the ones given here."""
    checkpoint: bool = False
    """Keep only the images for the backward pass and recompute the rest. From random weights, the running
    statistics of batch normalisation then count every batch twice."""


class ImageBackbone(nn.Module):
    """A ResNet (He et al. 2016) with a feature pyramid (Lin et al. 2017). All levels have D channels.

    Where weights were loaded, batch normalisation is frozen, as in DETR and BEVFormer: neither its statistics
    nor its scales change in training.

    Args:
        config: sizes.
        channels: D of every pyramid level.
        levels: number of levels to return, finest first; None returns all.
        fetch: load `config.weights`. Not needed when trained weights replace them later.

    Raises:
        InputError: there are fewer levels than are to be returned.
    """

    def __init__(
        self, config: BackboneConfig, *, channels: int, levels: int | None = None, fetch: bool = True
    ) -> None:
        from transformers import ResNetBackbone, ResNetConfig  # slow to import, and recipes do not need it

        super().__init__()
        # the separate flag for pretrained norms
        self.checkpoint = config.checkpoint
        self.pretrained = False
        self.resnet = ResNetBackbone(
            ResNetConfig(
                embedding_size=config.embedding_size,
                hidden_sizes=list(config.hidden_sizes),
                depths=list(config.depths),
                layer_type=config.layer_type,
                out_features=list(config.stages),
            )
        )
        if fetch and config.weights is not None:
            self._load(config.weights, config.stages)
        # Without the max pooling of the stem, all stages come out at twice the resolution
        if config.stem_stride == 2:
            self.resnet.embedder.pooler = nn.Identity()
        # Lateral 1x1 convolutions bring every stage to D channels; 3x3 ones smooth after each upsampling
        widths = self.resnet.channels
        self.lateral = nn.ModuleList([nn.Conv2d(width, channels, 1) for width in widths])
        self.smooth = nn.ModuleList([nn.Conv2d(channels, channels, 3, padding=1) for _ in widths])
        self.levels = len(widths) if levels is None else levels
        if not 0 < self.levels <= len(widths):
            raise InputError(f"the image backbone has {len(widths)} levels, of which {levels} cannot be read")
        self.smooth[self.levels :].requires_grad_(False)  # they stay so that stored weights fit
        for norm in self._frozen_norms():
            norm.requires_grad_(False)

    def train(self, mode: bool = True) -> "ImageBackbone":
        """Set the mode of all parts but frozen norms."""
        super().train(mode)
        for norm in self._frozen_norms():
            norm.eval()
        return self

    def _frozen_norms(self) -> list[nn.BatchNorm2d]:
        norms = [part for part in self.resnet.modules() if isinstance(part, nn.BatchNorm2d)]
        return norms if self.pretrained else []

    def _load(self, weights: str, stages: Sequence[str]) -> None:
        from transformers import ResNetBackbone

        try:
            self.resnet = ResNetBackbone.from_pretrained(weights, out_features=list(stages))
            self.pretrained = True
        except OSError as error:
            first_line = str(error).splitlines()[0]
            warnings.warn(
                f"image backbone starts from RANDOM weights: {weights!r} could not be loaded ({first_line})",
                stacklevel=3,
            )

    def forward(self, images: UInt8[Tensor, "n 3 H W"]) -> tuple[Float[Tensor, "n _h _w D"], ...]:
        """Return the finest pyramid levels from fine to coarse, channels last."""
        if self.checkpoint and torch.is_grad_enabled():
            return checkpoint(self._pyramid, images, use_reentrant=False)
        return self._pyramid(images)

    def _pyramid(self, images: UInt8[Tensor, "n 3 H W"]) -> tuple[Float[Tensor, "n _h _w D"], ...]:
        # Channels-last memory is the faster layout for convolutions on the GPU
        x = normalise_images(images).contiguous(memory_format=torch.channels_last)
        maps = self.resnet(x).feature_maps
        # Top-down path: start at the coarsest stage and add each upsampled sum to the next finer stage
        merged = self.lateral[-1](maps[-1])
        levels = [merged]
        for lateral, feature in zip(list(self.lateral)[-2::-1], maps[-2::-1], strict=True):
            merged = lateral(feature) + F.interpolate(merged, size=feature.shape[-2:], mode="nearest")
            levels.append(merged)
        # `levels` runs from coarse to fine: read the last ones in
        # reverse, paired with smoothing from fine to coarse
        finest = zip(self.smooth[: self.levels], levels[: -self.levels - 1 : -1], strict=True)
        out = [smooth(level) for smooth, level in finest]
        # Channels last, because the attention reads whole feature vectors at image positions
        return tuple(level.float().permute(0, 2, 3, 1) for level in out)
