"""LPIPS, a learned distance of images (Zhang et al., 2018), on AlexNet."""

from importlib import resources
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.methods.blocks.published_weights import load_published, load_state

_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
_TAPS = (1, 4, 7, 9, 11)
"""Layers whose output is compared: each ReLU."""
_CHANNELS = (64, 192, 384, 256, 256)
_TINY = 1e-8


class Lpips(nn.Module):
    """LPIPS with the published linear layers, which torchmetrics ships, on AlexNet's features.

    Args:
        weights: .safetensors or .pth file of torchvision's AlexNet (alexnet-owt-7be5be79.pth).
    """

    def __init__(self, weights: Path) -> None:
        super().__init__()
        a, b, c, d, e = _CHANNELS
        self.features = nn.Sequential(
            *(nn.Conv2d(3, a, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)),
            *(nn.Conv2d(a, b, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)),
            *(nn.Conv2d(b, c, 3, padding=1), nn.ReLU()),
            *(nn.Conv2d(c, d, 3, padding=1), nn.ReLU()),
            *(nn.Conv2d(d, e, 3, padding=1), nn.ReLU()),
        )
        load_published(self, weights, "AlexNet")
        # One learned weight per channel turns squared differences into a distance
        heads = [nn.Conv2d(channels, 1, 1, bias=False) for channels in _CHANNELS]
        shipped = resources.files("torchmetrics") / "functional/image/lpips_models/alex.pth"
        with shipped.open("rb") as file:
            published = torch.load(file, map_location="cpu", weights_only=True)
        for number, head in enumerate(heads):
            weight = {"weight": published[f"lin{number}.model.1.weight"]}
            load_state(head, weight, "torchmetrics", "LPIPS")
        self.heads = nn.ModuleList(heads)

    def forward(
        self, rendered: Float[Tensor, "n 3 H W"], real: Float[Tensor, "n 3 H W"]
    ) -> Float[Tensor, "n"]:
        """Return the distance of each pair of images, RGB in 0 to 1; at least 63 px a side."""
        # LPIPS scales images to -1..1 and then normalises them
        shift, scale = (rendered.new_tensor(value)[:, None, None] for value in (_SHIFT, _SCALE))
        a, b = ((2 * image - 1 - shift) / scale for image in (rendered, real))
        distance = rendered.new_zeros(len(rendered))
        for index, layer in enumerate(self.features):
            a, b = layer(a), layer(b)
            if index in _TAPS:
                difference = (unit_features(a) - unit_features(b)) ** 2
                distance = distance + self.heads[_TAPS.index(index)](difference).mean((1, 2, 3))
        return distance


def unit_features(feature: Float[Tensor, "n C H W"]) -> Float[Tensor, "n C H W"]:
    """Return features as unit vectors over the channels."""
    return feature / (feature.square().sum(1, keepdim=True) + _TINY).sqrt()
