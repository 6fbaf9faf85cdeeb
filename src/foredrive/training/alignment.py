"""Training of towers for a common space: images and texts by contrast, sweeps from image embeddings."""

import math
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn

from foredrive.losses.contrast import contrast, true_of
from foredrive.models.image_tower import ImageTower
from foredrive.models.lidar_clip import LidarEncoder, PointCloud
from foredrive.ops.precision import computes_bfloat16
from foredrive.scene.record import Record

FIRST_TEMPERATURE, SHARPEST = 0.07, 100.0
"""Temperature at the start and maximum inverse temperature, from CLIP (Radford et al. 2021, section 2.4)."""
CROP_SHARE = 0.1
"""Share of height and width that cropping removes from a training image."""


@dataclass(frozen=True)
class CaptionedImages(Record):
    """Views, T true texts of each, and the facts each text states out of a vocabulary of V facts."""

    images: UInt8[Tensor, "*n 3 H W"]
    texts: Float[Tensor, "*n T D"]
    """Embeddings of the texts, with the mean over all texts subtracted."""
    said: Bool[Tensor, "*n T V"]
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

    def __init__(self, tower: ImageTower) -> None:
        super().__init__()
        self.tower = tower
        self.log_scale = nn.Parameter(torch.tensor(-math.log(FIRST_TEMPERATURE)))

    def forward(self, batch: CaptionedImages, generator: torch.Generator) -> dict[str, Tensor]:
        """Return losses with one random text per view. Mirroring and cropping the views changes no fact."""
        rows = torch.arange(len(batch.images), device=batch.images.device)
        drawn = torch.randint(batch.texts.shape[1], (len(rows),), generator=generator).to(rows.device)
        device = batch.images.device.type
        with torch.autocast(device, torch.bfloat16, enabled=computes_bfloat16(device)):
            found = self.tower(_jittered(batch.images, generator))
        found = F.normalize(found.float(), dim=-1)
        texts = F.normalize(batch.texts[rows, drawn], dim=-1)
        logits = self.log_scale.exp().clamp(max=SHARPEST) * found @ texts.T
        loss, share = contrast(logits, true_of(batch.said[rows, drawn], batch.holds))
        return {"loss": loss, "hits": share}


class DistilObjective(nn.Module):
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
        y = torch.where(mirrored[batch.cloud.item], -1.0, 1.0)
        points = torch.stack([torch.ones_like(y), y, torch.ones_like(y), torch.ones_like(y)], dim=-1)
        found = self.encoder(PointCloud(batch.cloud.points * points, batch.cloud.item), len(rows))
        target = batch.targets[rows, mirrored.long()]
        cosine = F.cosine_similarity(found, target, dim=-1).mean()
        loss = F.mse_loss(found, target) if self.kind == "mse" else 1 - cosine
        return {"loss": loss, "cosine": cosine}


def _jittered(images: UInt8[Tensor, "n 3 H W"], generator: torch.Generator) -> UInt8[Tensor, "n 3 h w"]:
    """Crop all images of the batch equally and mirror each with probability 1/2."""
    height, width = images.shape[-2:]
    kept_h, kept_w = height - round(CROP_SHARE * height), width - round(CROP_SHARE * width)
    top = int(torch.randint(height - kept_h + 1, (1,), generator=generator))
    left = int(torch.randint(width - kept_w + 1, (1,), generator=generator))
    images = images[..., top : top + kept_h, left : left + kept_w]
    mirrored = (torch.rand(len(images), generator=generator) < 0.5).to(images.device)
    return torch.where(mirrored[:, None, None, None], images.flip(-1), images)
