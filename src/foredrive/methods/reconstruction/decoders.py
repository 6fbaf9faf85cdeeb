"""Decoders from composited features to sensor readings (Hess et al., "SplatAD", 2025, §3.4)."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

ALBEDO = 3
"""Number of leading features that are albedo."""
_LAST_LAYER_GAIN = 1e-2
"""Initial gain of the last layer. An image is at first almost its albedo."""
_FAINT, _SENT_BACK = -2.0, 2.0
"""Initial logits: most returns are faint, and most beams return."""
_LEAST_CHANCE = 1e-4
"""Bound on the probabilities that a beam returns or does not."""


@dataclass(frozen=True)
class CameraDecoderConfig:
    """Sizes of a `CameraDecoder`."""

    width: int = 32
    """Channels of the hidden layers."""
    blocks: Literal["plain", "residual"] = "plain"
    """Two convolutions, or two residual blocks of two convolutions (SplatAD's reference implementation)."""


class ResidualConvolutions(nn.Module):
    """Two 3×3 convolutions and a shortcut: a 1×1 convolution where the number of channels changes."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.shortcut = nn.Identity() if channels == width else nn.Conv2d(channels, width, 1)
        self.net = nn.Sequential(*_convolution(channels, width), nn.Conv2d(width, width, 3, padding=1))

    def forward(self, x: Float[Tensor, "n C H W"]) -> Float[Tensor, "n D H W"]:
        """Return features of the same height and width."""
        return (self.shortcut(x) + self.net(x)).relu()


def _convolution(channels: int, width: int) -> list[nn.Module]:
    return [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]


class CameraDecoder(nn.Module):
    """A decoder of colour that depends on view and camera.

    rgb = albedo · (1 + s) + b, with s and b from a small CNN over the other features, the appearance code of
    the camera and the viewing direction.
    """

    def __init__(self, features: int, cameras: int, config: CameraDecoderConfig, appearance: int = 8) -> None:
        """Create a decoder for `features` features besides albedo."""
        # One learned code per camera takes up its exposure and white balance
        super().__init__()
        self.appearance = nn.Parameter(0.1 * torch.randn(cameras, appearance))
        channels, width = features + appearance + 3, config.width
        last = nn.Conv2d(width, 2 * ALBEDO, 1)
        # A small last layer makes gain and offset nearly 0 at the start
        with torch.no_grad():
            last.weight *= _LAST_LAYER_GAIN
            last.bias.zero_()  # type: ignore[union-attr]
        hidden: list[nn.Module] = []
        for inputs in (channels, width):
            plain = config.blocks == "plain"
            hidden += _convolution(inputs, width) if plain else [ResidualConvolutions(inputs, width)]
        self.net: nn.Module = nn.Sequential(*hidden, last)
        for parameter in self.net.parameters():
            if parameter.dim() == 4:  # same memory layout as composited features
                parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)

    def forward(
        self, feature: Float[Tensor, "H W D"], direction: Float[Tensor, "H W 3"], camera: int
    ) -> Float[Tensor, "3 H W"]:
        """Decode an image. It is linear in albedo and not clamped.

        Args:
            feature: composited albedo and features.
            direction: unit viewing direction in the scene's frame.
            camera: index in the rig.
        """
        # The batch of one image is in channel-first order
        albedo = feature[..., :ALBEDO].permute(2, 0, 1)
        appearance = self.appearance[camera].expand(*feature.shape[:2], -1)
        seen = torch.cat([feature[..., ALBEDO:], appearance, direction], dim=-1)
        gain, offset = self.net(seen.permute(2, 0, 1)[None])[0].split(ALBEDO)
        return albedo * (1 + gain) + offset


class LidarDecoder(nn.Module):
    """A decoder of intensity and ray drop: an MLP over features, appearance code and direction.

    A beam returns if something stops it (alpha) and the surface sends it back (the output of the MLP).

    Args:
        features: number of features besides albedo.
        drop_from_alpha: multiply the two. If False, the output of the MLP alone decides.
    """

    def __init__(
        self, features: int, drop_from_alpha: bool = True, appearance: int = 8, width: int = 32
    ) -> None:
        super().__init__()
        self.drop_from_alpha = drop_from_alpha
        self.appearance = nn.Parameter(0.1 * torch.randn(appearance))
        last = nn.Linear(width, 2)
        with torch.no_grad():
            # The initial bias holds for all beams: faint, and likely to return
            last.bias.add_(torch.tensor([_FAINT, _SENT_BACK]))
        self.net = nn.Sequential(
            nn.Linear(features + appearance + 3, width),
            nn.ReLU(),
            nn.Linear(width, width),
            nn.ReLU(),
            last,
        )

    def forward(
        self, feature: Float[Tensor, "P D"], alpha: Float[Tensor, "P"], direction: Float[Tensor, "P 3"]
    ) -> tuple[Float[Tensor, "P"], Float[Tensor, "P"]]:
        """Return intensity in 0 to 1 and the logit of the probability that the beam does not return.

        Args:
            feature: composited albedo and features.
            alpha: share of the beam's light that is stopped.
            direction: unit direction of the beams in the scene's frame.
        """
        appearance = self.appearance.expand(len(feature), -1)
        seen = torch.cat([feature[:, ALBEDO:], appearance, direction], dim=-1)
        intensity, sent_back = self.net(seen).unbind(-1)
        if not self.drop_from_alpha:
            return intensity.sigmoid(), -sent_back
        # The bound keeps the logit finite
        returns = (alpha * sent_back.sigmoid()).clamp(_LEAST_CHANCE, 1 - _LEAST_CHANCE)
        return intensity.sigmoid(), -returns.logit()
