"""VGG-16 features for the perceptual loss."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.models.backbone import normalise_rgb
from foredrive.models.published_weights import load_published, load_state

_BLOCKS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512))
TORCHVISION_URL = "https://download.pytorch.org/models/vgg16-397923af.pth"


class Vgg16Features(nn.Module):
    """Activations relu1_2, relu2_2, relu3_3, relu4_3 of VGG-16 (Simonyan & Zisserman 2015), frozen.

    Layer names follow torchvision's `features.N`, so its published weights load directly.

    Args:
        weights: a .safetensors or .pth file of torchvision's VGG-16, or "download" to fetch it from PyTorch's
            server into the torch hub cache.
    """

    def __init__(self, weights: str | Path) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        self.taps: list[int] = []
        width = 3
        for block in _BLOCKS:
            for out in block:
                layers += [nn.Conv2d(width, out, 3, padding=1), nn.ReLU()]
                width = out
            self.taps.append(len(layers) - 1)
            layers.append(nn.MaxPool2d(2))
        self.features = nn.Sequential(*layers[:-1])
        if str(weights) == "download":
            state = dict(torch.hub.load_state_dict_from_url(TORCHVISION_URL, weights_only=True))
            load_state(self, state, TORCHVISION_URL, "VGG-16")
        else:
            load_published(self, Path(weights), "VGG-16")

    def train(self, mode: bool = True) -> "Vgg16Features":
        """Stay in evaluation mode, because the features are fixed."""
        return super().train(False)

    def forward(self, rgb: Float[Tensor, "n 3 H W"]) -> tuple[Float[Tensor, "n _c _h _w"], ...]:
        """Return features of RGB images in [0, 1]; of small images, only as deep as they can be pooled."""
        x = normalise_rgb(rgb)
        taps = []
        for index, layer in enumerate(self.features):
            if isinstance(layer, nn.MaxPool2d) and min(x.shape[-2:]) < 2:
                break
            x = layer(x)
            if index in self.taps:
                taps.append(x)
        return tuple(taps)
