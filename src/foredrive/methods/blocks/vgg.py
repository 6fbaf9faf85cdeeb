"""VGG features for perceptual losses."""

from pathlib import Path
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.methods.blocks.backbone import normalise_rgb
from foredrive.methods.blocks.published_weights import load_published, load_state


class _Kind(NamedTuple):
    """A network and what its loss reads off it."""

    convolutions: tuple[int, ...]
    """Number of convolutions in each block."""
    tap: int
    """The convolution of each block after whose ReLU the activation is read."""
    normalised: bool
    """Whether images are normalised as ImageNet's were."""
    url: str


_KINDS = {
    16: _Kind((2, 2, 3, 3), -1, True, "https://download.pytorch.org/models/vgg16-397923af.pth"),
    19: _Kind((2, 2, 4, 4, 1), 0, False, "https://download.pytorch.org/models/vgg19-dcbb9e9d.pth"),
}
_WIDTHS = (64, 128, 256, 512, 512)


class VggFeatures(nn.Module):
    """Activations of VGG-16 or VGG-19 (Simonyan & Zisserman 2015), frozen.

    VGG-16 gives relu1_2, relu2_2, relu3_3 and relu4_3 of normalised images (Johnson et al. 2016). VGG-19
    gives relu1_1 to relu5_1 of images from 0 to 1, as NeuRAD's reference implementation. Layer names follow
    torchvision's `features.N`, so its published weights load directly.

    Args:
        weights: a .safetensors or .pth file of torchvision's network, or "download" to fetch it from
            PyTorch's server into the torch hub cache.
        layers: 16 or 19.
    """

    def __init__(self, weights: str | Path, layers: Literal[16, 19] = 16) -> None:
        super().__init__()
        kind, name = _KINDS[layers], f"VGG-{layers}"
        modules: list[nn.Module] = []
        self.taps: list[int] = []
        self.normalised = kind.normalised
        width = 3
        for out, count in zip(_WIDTHS, kind.convolutions, strict=False):
            first = len(modules)
            for _ in range(count):
                modules += [nn.Conv2d(width, out, 3, padding=1), nn.ReLU()]
                width = out
            # Index of the ReLU behind the tapped convolution; two modules per convolution
            self.taps.append(first + 2 * (kind.tap % count) + 1)
            modules.append(nn.MaxPool2d(2))
        self.features = nn.Sequential(*modules[: self.taps[-1] + 1])
        if str(weights) == "download":
            state = dict(torch.hub.load_state_dict_from_url(kind.url, weights_only=True))
            load_state(self, state, kind.url, name)
        else:
            load_published(self, Path(weights), name)

    def train(self, mode: bool = True) -> "VggFeatures":
        """Stay in evaluation mode, because the features are fixed."""
        return super().train(False)

    def forward(self, rgb: Float[Tensor, "n 3 H W"]) -> tuple[Float[Tensor, "n _c _h _w"], ...]:
        """Return features of RGB images in [0, 1]; of small images, only as deep as they can be pooled."""
        x = normalise_rgb(rgb) if self.normalised else rgb
        taps = []
        for index, layer in enumerate(self.features):
            # Another pooling would leave no pixels
            if isinstance(layer, nn.MaxPool2d) and min(x.shape[-2:]) < 2:
                break
            x = layer(x)
            if index in self.taps:
                taps.append(x)
        return tuple(taps)
