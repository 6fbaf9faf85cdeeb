"""Rendered images beside real ones by networks of perception: LPIPS and FID, with weights in local files."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import torch

from foredrive.methods.blocks.inception import InceptionFeatures
from foredrive.methods.blocks.lpips import Lpips
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


class PerceptualMetrics:
    """LPIPS (mean over images) and FID (over all of them) of a scene's images.

    Raises:
        InputError: a file of weights is missing or holds other weights.
    """

    def __init__(self, weights: PerceptualWeights) -> None:
        self.lpips = None if weights.alexnet is None else Lpips(weights.alexnet)
        self.inception = None
        if weights.inception is not None:
            self.inception = InceptionFeatures()
            load_published(self.inception, weights.inception, "FID's Inception")

    @torch.no_grad()
    def evaluate(self, scene: ReconstructedScene, views: Sequence[CameraView]) -> dict[str, float]:
        """Return "lpips" and "fid" of views with images. FID needs two images at least."""
        from torchmetrics.image.fid import FrechetInceptionDistance  # takes seconds

        distances, fid = [], None
        if self.inception is not None and len(views) > 1:
            fid = FrechetInceptionDistance(self.inception)
        for view in views:
            assert view.image is not None
            real = view.image[None].cpu()
            rendered = scene.camera(scene.graph, view.to(scene.device))
            if self.lpips is not None:
                distances.append(float(self.lpips(rendered.rgb.clamp(0, 1)[None].cpu(), real.float() / 255)))
            if fid is not None:
                fid.update(real, real=True)
                fid.update(rendered.rgb_8bit[None], real=False)
        figures = {"lpips": fmean(distances)} if distances else {}
        return figures if fid is None else figures | {"fid": float(fid.compute())}
