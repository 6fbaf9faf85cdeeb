"""Rendered images against real ones, where both exist."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def psnr_db(
    rendered: Float[Tensor, "n 3 H W"], real: Float[Tensor, "n 3 H W"], known: Bool[Tensor, "n H W"]
) -> Float[Tensor, "n"]:
    """Return the peak signal-to-noise ratio of each image over its known pixels, dB; NaN without any.

    Args:
        rendered, real: RGB from 0 to 1.
        known: pixels that count.
    """
    from torchmetrics.functional.image import peak_signal_noise_ratio  # takes seconds

    # PSNR over the known pixels only
    scores = [
        peak_signal_noise_ratio(a[:, k], b[:, k], data_range=1.0) if k.any() else a.new_tensor(torch.nan)
        for a, b, k in zip(rendered, real, known, strict=True)
    ]
    return torch.stack(scores) if scores else rendered.new_zeros(0)


def ssim(
    rendered: Float[Tensor, "n 3 H W"], real: Float[Tensor, "n 3 H W"], known: Bool[Tensor, "n H W"]
) -> Float[Tensor, "n"]:
    """Return the structural similarity of each image over its known pixels; NaN without any.

    The window is Gaussian with σ = 1.5 px. Unknown pixels are set to the real image's, so that they add
    nothing to their neighbours' difference.
    """
    from torchmetrics.functional.image import structural_similarity_index_measure  # takes seconds

    if not len(rendered):
        return rendered.new_zeros(0)
    # Unknown pixels equal the real image, so the window around known ones sees no difference there
    filled = torch.where(known[:, None], rendered, real)
    _, similarity = structural_similarity_index_measure(filled, real, data_range=1.0, return_full_image=True)
    known_pixels = known[:, None].expand_as(similarity)
    return torch.where(known_pixels, similarity, 0.0).sum(dim=(1, 2, 3)) / known_pixels.sum(dim=(1, 2, 3))
