"""Image reconstruction (NeMo eq. 9)."""

from collections.abc import Callable, Sequence

import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.ops.masked import masked_mean

ImageFeatures = Callable[[Float[Tensor, "n 3 H W"]], Sequence[Float[Tensor, "n _c _h _w"]]]


def l1_loss(
    predicted: Float[Tensor, "n 3 H W"], truth: Float[Tensor, "n 3 H W"], valid: Bool[Tensor, "n"]
) -> Float[Tensor, ""]:
    """Return the mean absolute colour error of the valid images, RGB in [0, 1]; 0 when none is valid."""
    return masked_mean((predicted - truth).abs().mean(dim=(1, 2, 3)), valid)


def perceptual_loss(
    predicted: Float[Tensor, "n 3 H W"],
    truth: Float[Tensor, "n 3 H W"],
    valid: Bool[Tensor, "n"],
    features: ImageFeatures,
) -> Float[Tensor, ""]:
    """Return L1 between network features of the valid images, summed over layers (Johnson et al. 2016)."""
    if not valid.any():
        return predicted.new_zeros(())
    # Invalid images are left out before the network runs
    pairs = zip(features(predicted[valid]), features(truth[valid]), strict=True)
    return sum((F.l1_loss(a, b) for a, b in pairs), start=predicted.new_zeros(()))
