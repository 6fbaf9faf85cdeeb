"""The photometric loss of rendered images: absolute differences and structural similarity."""

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from foredrive.ops.photometric_kernels import (
    MOMENTS,
    SLOPES,
    ImagePair,
    compare,
    image_gradient,
    local_means,
    padded,
    spread_columns,
)
from foredrive.ops.precision import numba_supports
from foredrive.ops.threads import in_parallel

WINDOW_PX, SIGMA_PX = 11, 1.5
C1, C2 = 0.01**2, 0.03**2
MIN_ROWS = 32
"""Minimum number of rows of a channel per thread."""


def photometric_loss(
    rendered: Float[Tensor, "C H W"], real: Float[Tensor, "C H W"], ssim_share: float = 0.2
) -> Float[Tensor, ""]:
    """Return (1 - λ) L1 + λ (1 - SSIM), RGB in 0 to 1 (Kerbl et al., 2023, eq. 7); 6 px a side at least.

    On the CPU, kernels compute loss and gradient together. The real image gets no gradient there.
    """
    # Kernels check no sizes; plain PyTorch refuses images that differ or are smaller than the window's half
    is_sound = rendered.shape == real.shape and min(rendered.shape[-2:]) > WINDOW_PX // 2
    if not is_sound or real.requires_grad or not numba_supports(rendered, real):
        return photometric_loss_reference(rendered, real, ssim_share)
    loss: Tensor = _Photometric.apply(rendered.float(), real.float(), ssim_share)
    return loss


def photometric_loss_reference(
    rendered: Float[Tensor, "C H W"], real: Float[Tensor, "C H W"], ssim_share: float = 0.2
) -> Float[Tensor, ""]:
    """Return what `photometric_loss` does, in plain PyTorch."""
    l1 = (rendered - real).abs().mean()
    return (1 - ssim_share) * l1 + ssim_share * (1 - _mean_ssim(rendered[None], real[None]))


def _window(like: Tensor) -> Float[Tensor, "K"]:
    offset = torch.arange(WINDOW_PX, device=like.device) - WINDOW_PX // 2
    # Normalised Gaussian weights: a softmax of -x²/2σ² sums to 1
    return torch.softmax(-0.5 * (offset / SIGMA_PX) ** 2, dim=0).to(like)


def _mean_ssim(a: Float[Tensor, "1 C H W"], b: Float[Tensor, "1 C H W"]) -> Float[Tensor, ""]:
    """Return structural similarity (Wang et al., 2004) with a separable window, borders mirrored."""
    window, channels = _window(a), a.shape[1]
    # All five local moments go through one convolution
    stack = torch.cat([a, b, a * a, b * b, a * b], dim=1)
    stack = F.pad(stack, (WINDOW_PX // 2,) * 4, mode="reflect")
    # Separable window: rows, then columns, each channel on its own
    for kernel in (window[None], window[:, None]):
        stack = F.conv2d(stack, kernel.expand(stack.shape[1], 1, -1, -1), groups=stack.shape[1])
    mean_a, mean_b, aa, bb, ab = stack[0].unflatten(0, (MOMENTS, channels)).unbind(0)
    # Variance and covariance from the moments
    var_a, var_b, cov = aa - mean_a**2, bb - mean_b**2, ab - mean_a * mean_b
    similarity = (2 * mean_a * mean_b + C1) * (2 * cov + C2)
    return (similarity / ((mean_a**2 + mean_b**2 + C1) * (var_a + var_b + C2))).mean()


class _Photometric(torch.autograd.Function):
    """`photometric_loss` for float32 on the CPU. The forward pass computes the gradient too."""

    @staticmethod
    def forward(
        ctx: Any, rendered: Float[Tensor, "C H W"], real: Float[Tensor, "C H W"], ssim_share: float
    ) -> Float[Tensor, ""]:
        """Compute the loss, and its gradient if one is wanted."""
        channels, height, width = rendered.shape
        pair = ImagePair(
            rendered.detach().contiguous().numpy(),
            real.contiguous().numpy(),
            _window(rendered).numpy(),
            np.empty((channels, MOMENTS, height, padded(width)), np.float32),
            np.empty((channels, SLOPES, height, padded(width)), np.float32),
            np.empty((channels, height)),
            np.empty((channels, height)),
        )
        rows, count = channels * height, rendered.numel()
        in_parallel(lambda start, stop: local_means(pair, start, stop), rows, MIN_ROWS)
        c1, c2 = np.float32(C1), np.float32(C2)
        in_parallel(lambda start, stop: compare(pair, c1, c2, start, stop), rows, MIN_ROWS)
        l1, ssim = pair.difference.sum() / count, pair.similarity.sum() / count
        if ctx.needs_input_grad[0]:
            gradient = torch.empty_like(rendered, memory_format=torch.contiguous_format)
            out, by_l1, by_ssim = (
                gradient.numpy(),
                np.float32((1 - ssim_share) / count),
                np.float32(-ssim_share / count),
            )
            in_parallel(lambda start, stop: spread_columns(pair, start, stop), rows, MIN_ROWS)
            in_parallel(
                lambda start, stop: image_gradient(pair, by_l1, by_ssim, out, start, stop), rows, MIN_ROWS
            )
            ctx.save_for_backward(gradient)
        return rendered.new_tensor((1 - ssim_share) * l1 + ssim_share * (1 - ssim))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_out: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradient of the rendered image."""
        (gradient,) = ctx.saved_tensors
        return grad_out * gradient, None, None
