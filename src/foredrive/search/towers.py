"""What an index asks of the towers that embed images, sweeps and texts into one space."""

import hashlib
from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from foredrive.errors import InputError
from foredrive.scene import LidarSweep

PROMPTS = (
    "{}",
    "a photo of {}",
    "a picture of {} taken from a car",
    "a dash cam photo of {}",
    "{} in traffic",
)
"""Templates of a prompt ensemble (Radford et al. 2021, section 3.1.4)."""


@runtime_checkable
class Towers(Protocol):
    """An image tower, a text tower and, maybe, a lidar tower of the same space.

    Embeddings come as the towers make them, of any length; who compares them normalises (`unit`). Towers are
    asked under `torch.no_grad`, and what they answer depends on weights and input alone, not on the batch.
    """

    name: str
    """What a user calls them by."""
    fingerprint: str
    """Changes with the weights and with all that embeddings depend on; an index remembers it."""
    dim: int
    """D, the length of an embedding."""
    image_side_px: int
    """Images are read so that their shorter side has this length, aspect kept."""
    has_lidar: bool

    def embed_images(self, images: UInt8[Tensor, "n 3 H W"]) -> Float[Tensor, "n D"]:
        """RGB images, of one camera sector each."""
        ...

    def embed_sweeps(self, sweeps: LidarSweep) -> Float[Tensor, "n D"] | None:
        """Sweeps [n N], of one sector each; None where there is no lidar tower.

        Each holds the returns that lie in its sector, in the axes of a frame below the ego vehicle's rear
        axle that is turned about z until x points along the sector's middle; padding has `valid` False.
        """
        ...

    def embed_text(self, texts: Sequence[str]) -> Float[Tensor, "n D"]:
        """Texts, each by itself."""
        ...


def unit(embeddings: Float[Tensor, "*n D"]) -> Float[Tensor, "*n D"]:
    """Embeddings of length 1; zeros stay zeros."""
    return F.normalize(embeddings.float(), dim=-1)


def embed_prompt(towers: Towers, text: str, templates: Sequence[str] = PROMPTS) -> Float[Tensor, "D"]:
    """One text in several wordings as one unit vector: the mean of their unit vectors, normalised.

    Args:
        templates: each with one {} for the text; ("{}",) takes the text alone.

    Raises:
        InputError: the text is empty.
    """
    if not text.strip():
        raise InputError("an empty text finds nothing; say what to look for")
    worded = [template.format(text.strip()) for template in templates]
    return unit(unit(towers.embed_text(worded)).mean(0))


def weights_digest(weights: Mapping[str, Tensor]) -> str:
    """Of every weight, by name: what a fingerprint is made of."""
    digest = hashlib.sha256()
    for name, tensor in sorted(weights.items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()[:16]
