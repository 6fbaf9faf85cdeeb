"""A small image tower: a ResNet with attention pooling."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from foredrive.models.attention_pool import AttentionPool
from foredrive.models.backbone import normalise_images


class ImageTower(nn.Module):
    """A ResNet (He et al. 2016) of four stages with an attention pool: images of any size to D numbers.

    Args:
        widths, depths: sizes of the stages of the ResNet (basic layers).
        heads: heads of the pool.
        dim: D.
    """

    def __init__(self, *, widths: Sequence[int], depths: Sequence[int], heads: int, dim: int) -> None:
        from transformers import ResNetBackbone, ResNetConfig  # slow to import

        super().__init__()
        last = f"stage{len(widths)}"
        self.resnet = ResNetBackbone(
            ResNetConfig(
                embedding_size=widths[0],
                hidden_sizes=list(widths),
                depths=list(depths),
                layer_type="basic",
                out_features=[last],
            )
        )
        self.pool = AttentionPool(widths[-1], heads, dim)

    def forward(self, images: UInt8[Tensor, "n 3 H W"]) -> Float[Tensor, "n D"]:
        """Return one vector per image."""
        pixels = normalise_images(images).contiguous(memory_format=torch.channels_last)
        (seen,) = self.resnet(pixels).feature_maps
        return self.pool(seen.flatten(2).mT)
