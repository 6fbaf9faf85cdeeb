"""Rendered images beside real ones."""

import torch
from torch import Tensor

from foredrive.scene import Example
from foredrive.tasks.metric import EvaluationContext, Figures, Shown
from foredrive.tasks.predictor import Part, Prediction
from foredrive.tasks.rendering.image_scores import psnr_db, ssim


class ImageMetric:
    """PSNR and SSIM, averaged over images. Keys: `psnr_db` and `ssim` at now, then `future_1s.psnr_db`."""

    name = "image"
    title = "Images"
    shown: tuple[Shown, ...] = ()
    needs: frozenset[Part] = frozenset({"images"})

    def __init__(self, context: EvaluationContext) -> None:
        self._context = context
        self._sums: Tensor | None = None
        self._images: Tensor | None = None

    def update(self, prediction: Prediction, truth: Example) -> None:
        """Compare the views of b clips with the images of their frames from now on."""
        assert prediction.images is not None
        rendered, stride, clip = prediction.images, prediction.image_stride, truth.clip
        frames = slice(clip.now, clip.now + rendered.shape[1])
        # Real pixels at the positions that were rendered
        real = clip.images[:, frames, :, :, stride // 2 :: stride, stride // 2 :: stride].float() / 255
        known = clip.image_valid[:, frames, :, None, None].expand_as(real[:, :, :, 0])
        sums = torch.zeros(rendered.shape[1], 2, dtype=torch.float64)
        images = torch.zeros(rendered.shape[1], 1, dtype=torch.int64)
        for k in range(rendered.shape[1]):
            # Only views with an image are compared
            seen = known[:, k].flatten(2).any(dim=-1)  # [b, C]
            views = (rendered[:, k][seen], real[:, k][seen], known[:, k][seen])
            scores = torch.stack([psnr_db(*views), ssim(*views)], dim=-1)
            sums[k] = scores.double().sum(dim=0).cpu()
            images[k] = len(scores)
        self._sums = sums if self._sums is None else self._sums + sums
        self._images = images if self._images is None else self._images + images

    def result(self) -> Figures:
        """Return the means over images, by frame."""
        if self._sums is None or self._images is None:
            return {}
        out: Figures = {}
        names = self._context.frame_names(len(self._sums))
        for name, (psnr, similarity) in zip(names, (self._sums / self._images).tolist(), strict=True):
            key = "" if name == "now" else f"{name}."
            out |= {f"{key}psnr_db": psnr, f"{key}ssim": similarity}
        return out
