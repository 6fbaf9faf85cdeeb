"""Training of a driver: its eyes on logs, its planner by the rule."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.driver.eyes import CameraEyes
from foredrive.driver.losses import SightWeights, sight_losses
from foredrive.driver.packed import RouteExample
from foredrive.driver.volume_eyes import VolumeEyes

BRIGHTNESS, CONTRAST, COLOUR = 0.06, 0.2, 0.03
"""Standard deviations of the changes of an image in training, as shares of its range."""
GREY = 110
"""The value that keeps its brightness when contrast changes."""


class SightObjective(nn.Module):
    """The mapping from a batch to the losses of a driver's sight.

    Args:
        eyes: they are trained.
        weights: of the losses.
    """

    def __init__(self, eyes: CameraEyes | VolumeEyes, weights: SightWeights) -> None:
        super().__init__()
        self.eyes, self.weights = eyes, weights

    def forward(self, example: RouteExample, generator: torch.Generator) -> dict[str, Float[Tensor, ""]]:
        """Return losses by name; "loss" is minimised. The generator changes brightness and colours."""
        clip = example.clip
        if self.training:
            clip = _recoloured(example, generator).clip
        sight = self.eyes(clip)
        return sight_losses(sight, example.truth, clip, self.weights)


def _recoloured(example: RouteExample, generator: torch.Generator) -> RouteExample:
    """Return the examples with other contrast, brightness and colours; the same for all images of a clip."""
    images = example.clip.images
    b, device = len(images), images.device

    # Random numbers on the generator's device, so that they do not depend on the model's
    def normal(*shape: int) -> Tensor:
        return torch.randn(b, *shape, generator=generator, device=generator.device).to(device)

    contrast = (1 + CONTRAST * normal(1, 1, 1, 1, 1)).clamp(0.5, 1.6)
    shift = 255 * BRIGHTNESS * normal(1, 1, 1, 1, 1) + 255 * COLOUR * normal(1, 1, 3, 1, 1)
    # Contrast about a middle grey, so that it does not change the brightness
    changed = images.float().mul_(contrast).add_(GREY * (1 - contrast) + shift).clamp_(0, 255)
    clip = dataclasses.replace(example.clip, images=changed.to(torch.uint8))
    return dataclasses.replace(example, clip=clip)
