"""Rendered images beside real ones by networks of perception.

LPIPS and FID read published networks from local files. `tower_lpips` and `tower_fid` are the same formulas on
an image tower, such as the one that comes with the package: without LPIPS's learned weights of channels, and
not comparable with figures of the published networks.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import torch
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.methods.blocks.inception import InceptionFeatures
from foredrive.methods.blocks.losses import ImageFeatures
from foredrive.methods.blocks.lpips import Lpips, unit_features
from foredrive.methods.blocks.published_weights import load_published
from foredrive.methods.reconstruction.reconstructed import ReconstructedScene
from foredrive.methods.reconstruction.views import CameraView


@dataclass(frozen=True)
class PerceptualWeights:
    """Files of weights; a metric without its file is left out."""

    alexnet: Path | None = None
    """For LPIPS, see `Lpips`."""
    inception: Path | None = None
    """For FID, see `InceptionFeatures`."""


@dataclass(frozen=True, eq=False)
class PerceptualTower:
    """An image tower as a network of perception."""

    features: ImageFeatures
    """Returns the activations of some stages for RGB images from 0 to 1."""
    embedding: nn.Module
    """Maps 8-bit images to one vector each."""


class PerceptualMetrics:
    """LPIPS (mean over images) and FID (over all of them) of a scene's images.

    Args:
        weights: files of the published networks.
        tower: an image tower; None: `tower_lpips` and `tower_fid` are left out.

    Raises:
        InputError: a file of weights is missing or holds other weights.
    """

    def __init__(self, weights: PerceptualWeights, tower: PerceptualTower | None = None) -> None:
        self.tower = tower
        self.lpips = None if weights.alexnet is None else Lpips(weights.alexnet)
        self.inception = None
        if weights.inception is not None:
            self.inception = InceptionFeatures()
            load_published(self.inception, weights.inception, "FID's Inception")

    @torch.no_grad()
    def evaluate(self, scene: ReconstructedScene, views: Sequence[CameraView]) -> dict[str, float]:
        """Return the metrics of views with images. Fréchet distances need two images at least."""
        from torchmetrics.image.fid import FrechetInceptionDistance  # takes seconds

        distances: dict[str, list[float]] = {}
        networks = {"fid": self.inception, "tower_fid": self.tower and self.tower.embedding}
        frechet = {
            name: FrechetInceptionDistance(network)
            for name, network in networks.items()
            if network is not None and len(views) > 1
        }
        for view in views:
            assert view.image is not None
            real = view.image[None].cpu()
            rendered = scene.camera(scene.graph, view.to(scene.device))
            pair = rendered.rgb.clamp(0, 1)[None].cpu(), real.float() / 255
            if self.lpips is not None:
                distances.setdefault("lpips", []).append(float(self.lpips(*pair)))
            if self.tower is not None:
                distance = feature_distance(*map(self.tower.features, pair))
                distances.setdefault("tower_lpips", []).append(float(distance))
            for metric in frechet.values():
                metric.update(real, real=True)
                metric.update(rendered.rgb_8bit[None], real=False)
        return {name: fmean(values) for name, values in distances.items()} | {
            name: float(metric.compute()) for name, metric in frechet.items()
        }


def feature_distance(
    rendered: Sequence[Float[Tensor, "n _c _h _w"]], real: Sequence[Float[Tensor, "n _c _h _w"]]
) -> Float[Tensor, "n"]:
    """Return LPIPS's distance of features with equal weights: 0 for equal images, at most 4.

    Features are unit vectors over the channels. Their squared distances are averaged over places and stages.
    """
    parts = [
        (unit_features(a) - unit_features(b)).square().sum(1).mean((1, 2))
        for a, b in zip(rendered, real, strict=True)
    ]
    return torch.stack(parts).mean(0)
