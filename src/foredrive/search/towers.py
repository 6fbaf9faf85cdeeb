"""The protocol of towers, which embed images, sweeps and texts into one space."""

import hashlib
from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from foredrive.errors import InputError
from foredrive.scene import LidarSweep
from foredrive.search.crops import Crop

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
    """An image tower, a text tower and optionally a lidar tower with a common embedding space.

    Embeddings have any length; the caller normalises them (`unit`). Towers are called under `torch.no_grad`.
    Their output depends only on weights and input, not on the batch.
    """

    name: str
    """Name of the towers for users."""
    fingerprint: str
    """Digest of the weights and of everything else that embeddings depend on. An index stores it."""
    dim: int
    """D, the length of an embedding."""
    image_side_px: int
    """Length of the shorter side of whole images, with the aspect ratio kept."""
    crop: Crop
    """The part of an image that the image tower looks at."""
    has_lidar: bool

    def embed_images(self, images: UInt8[Tensor, "n 3 H W"]) -> Float[Tensor, "n D"]:
        """Embed RGB images of one camera sector each, cut to `crop`."""
        ...

    def embed_sweeps(self, sweeps: LidarSweep) -> Float[Tensor, "n D"] | None:
        """Embed sweeps [n N] of one sector each. Return None if there is no lidar tower.

        Each sweep has the returns in its sector, cut to `crop` as the image is. Its frame is the ego frame
        turned about z, so that x points along the middle of the sector. Padding has `valid` False.
        """
        ...

    def embed_text(self, texts: Sequence[str]) -> Float[Tensor, "n D"]:
        """Embed texts, each independently."""
        ...


def unit(embeddings: Float[Tensor, "*n D"]) -> Float[Tensor, "*n D"]:
    """Return embeddings of length 1. Zeros stay zeros."""
    return F.normalize(embeddings.float(), dim=-1)


def embed_prompt(towers: Towers, text: str, templates: Sequence[str] = PROMPTS) -> Float[Tensor, "D"]:
    """Return one text in several wordings as one unit vector: the normalised mean of their unit vectors.

    Args:
        templates: wordings with one {} for the text. ("{}",) is the text alone.

    Raises:
        InputError: the text is empty.
    """
    if not text.strip():
        raise InputError("an empty text finds nothing; say what to look for")
    worded = [template.format(text.strip()) for template in templates]
    return unit(unit(towers.embed_text(worded)).mean(0))


def weights_digest(weights: Mapping[str, Tensor]) -> str:
    """Return the digest of all weights and their names, for a fingerprint."""
    digest = hashlib.sha256()
    for name, tensor in sorted(weights.items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()[:16]
