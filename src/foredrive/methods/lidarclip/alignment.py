"""Training of towers for a common space: images and texts by contrast, sweeps from image embeddings.

The contrast is that of Radford et al. (2021), figure 3.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn

from foredrive.methods.lidarclip import LidarEncoder, PointCloud
from foredrive.methods.lidarclip.image_tower import ImageTower
from foredrive.ops.precision import computes_bfloat16
from foredrive.scene.record import Record


def is_true(stated: Bool[Tensor, "t V"], holds: Bool[Tensor, "i V"]) -> Bool[Tensor, "i t"]:
    """Return which of t texts are true of which of i images: all facts that a text states hold.

    Args:
        stated: of V facts, those that each text states.
        holds: of V facts, those that hold for each image.
    """
    # Number of stated facts that do not hold, for every pair; a text is true if there are none
    return (~holds).float() @ stated.float().T == 0


def info_nce(
    logits: Float[Tensor, "n n"], true: Bool[Tensor, "n n"]
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Return InfoNCE over rows and columns whose pairs lie on the diagonal; other true pairs are left out.

    Returns:
        The mean loss, and the share of rows whose own text comes first.
    """
    own = torch.arange(len(logits), device=logits.device)
    # A text that is true of another image is no negative: its logit is removed from the softmax
    other_true = true & ~torch.eye(len(logits), dtype=torch.bool, device=logits.device)
    logits = logits.masked_fill(other_true, -torch.inf)
    # Both directions: images to texts by rows, texts to images by columns
    loss = (F.cross_entropy(logits, own) + F.cross_entropy(logits.T, own)) / 2
    return loss, (logits.argmax(dim=1) == own).float().mean()


@dataclass(frozen=True)
class ContrastConfig:
    """Numbers of a `ContrastObjective`. The temperatures are CLIP's (Radford et al. 2021, section 2.4)."""

    initial_temperature: float = 0.07
    max_inverse_temperature: float = 100.0
    crop_share: float = 0.1
    """Share of height and width that random cropping removes from a training image."""


@dataclass(frozen=True)
class CaptionedImages(Record):
    """Views, T true texts of each, and which of V facts each text states."""

    images: UInt8[Tensor, "*n 3 H W"]
    texts: Float[Tensor, "*n T D"]
    """Embeddings of the texts, with the mean over all texts subtracted."""
    stated: Bool[Tensor, "*n T V"]
    holds: Bool[Tensor, "*n V"]
    """Facts that are true of the view."""
    key: tuple[str, ...]


@dataclass(frozen=True)
class ImagedSweeps(Record):
    """Sectors of sweeps and image embeddings of the same times and sectors, without texts."""

    cloud: PointCloud
    targets: Float[Tensor, "*n 2 D"]
    """Embeddings of the images, original and mirrored; any length."""
    key: tuple[str, ...]


class ContrastObjective(nn.Module):
    """InfoNCE in both directions (Radford et al. 2021, figure 3) between images and frozen text embeddings.

    A text that is also true of another image of the batch is not a negative for that image.
    """

    def __init__(self, tower: ImageTower, config: ContrastConfig) -> None:
        super().__init__()
        self.tower, self.config = tower, config
        # The logarithm of the inverse temperature is learned, which keeps it positive
        self.log_scale = nn.Parameter(torch.tensor(-math.log(config.initial_temperature)))

    def forward(self, batch: CaptionedImages, generator: torch.Generator) -> dict[str, Tensor]:
        """Return losses with one random text per view. Mirroring and cropping the views changes no fact."""
        rows = torch.arange(len(batch.images), device=batch.images.device)
        drawn = torch.randint(batch.texts.shape[1], (len(rows),), generator=generator).to(rows.device)
        device = batch.images.device.type
        with torch.autocast(device, torch.bfloat16, enabled=computes_bfloat16(device)):
            embedded = self.tower(_augmented(batch.images, self.config.crop_share, generator))
        embedded = F.normalize(embedded.float(), dim=-1)
        # Unit vectors: the logits are scaled cosines
        texts = F.normalize(batch.texts[rows, drawn], dim=-1)
        logits = self.log_scale.exp().clamp(max=self.config.max_inverse_temperature) * embedded @ texts.T
        loss, accuracy = info_nce(logits, is_true(batch.stated[rows, drawn], batch.holds))
        return {"loss": loss, "hits": accuracy}


class DistillationObjective(nn.Module):
    """The loss of LidarCLIP (Hess et al. 2024, section 3): regress the image embedding of the same time.

    Args:
        kind: mean squared error on features of any length, or 1 - cosine.
    """

    def __init__(self, encoder: LidarEncoder, kind: Literal["mse", "cosine"]) -> None:
        super().__init__()
        self.encoder, self.kind = encoder, kind

    def forward(self, batch: ImagedSweeps, generator: torch.Generator) -> dict[str, Tensor]:
        """Return losses. Half of the sweeps are mirrored and compared with mirrored images."""
        rows = torch.arange(len(batch.targets), device=batch.targets.device)
        mirrored = (torch.rand(len(rows), generator=generator) < 0.5).to(rows.device)
        # Mirroring a sweep negates y of all of its points
        y = torch.where(mirrored[batch.cloud.item], -1.0, 1.0)
        points = torch.stack([torch.ones_like(y), y, torch.ones_like(y), torch.ones_like(y)], dim=-1)
        embedded = self.encoder(PointCloud(batch.cloud.points * points, batch.cloud.item), len(rows))
        target = batch.targets[rows, mirrored.long()]
        cosine = F.cosine_similarity(embedded, target, dim=-1).mean()
        loss = F.mse_loss(embedded, target) if self.kind == "mse" else 1 - cosine
        return {"loss": loss, "cosine": cosine}


def _augmented(
    images: UInt8[Tensor, "n 3 H W"], crop_share: float, generator: torch.Generator
) -> UInt8[Tensor, "n 3 h w"]:
    """Crop all images of the batch equally and mirror each with probability 1/2."""
    height, width = images.shape[-2:]
    # One crop for the whole batch keeps the images of equal size
    kept_h, kept_w = height - round(crop_share * height), width - round(crop_share * width)
    top = int(torch.randint(height - kept_h + 1, (1,), generator=generator))
    left = int(torch.randint(width - kept_w + 1, (1,), generator=generator))
    images = images[..., top : top + kept_h, left : left + kept_w]
    mirrored = (torch.rand(len(images), generator=generator) < 0.5).to(images.device)
    return torch.where(mirrored[:, None, None, None], images.flip(-1), images)
