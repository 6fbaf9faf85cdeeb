"""Losses of rendered sweeps (Hess et al., "SplatAD", 2025, §3.5)."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.ops.masked import masked_mean


def range_loss(
    rendered_m: Float[Tensor, "P"], real_m: Float[Tensor, "P"], returned: Bool[Tensor, "P"], quantile: float
) -> Float[Tensor, ""]:
    """Return the mean absolute error of returned beams up to a quantile of the error; 0 if none returned.

    The worst beams are left out, because they hit something thin or moving.
    """
    error = (rendered_m - real_m).abs()[returned]
    if not len(error):
        return rendered_m.new_zeros(())
    # The limit is the quantile of the error itself, so the worst beams drop out
    limit = error.detach().kthvalue(max(int(quantile * len(error)), 1)).values
    return error[error <= limit].mean()


def intensity_loss(
    rendered: Float[Tensor, "P"], real: Float[Tensor, "P"], returned: Bool[Tensor, "P"]
) -> Float[Tensor, ""]:
    """Return the mean squared error of the beams that returned; 0 if none did."""
    return masked_mean((rendered - real) ** 2, returned)


def drop_loss(drop_logit: Float[Tensor, "P"], returned: Bool[Tensor, "P"]) -> Float[Tensor, ""]:
    """Return the binary cross-entropy of lost beams."""
    return F.binary_cross_entropy_with_logits(drop_logit, (~returned).to(drop_logit))


def line_of_sight_loss(
    alpha_before_hit: Float[Tensor, "P"], returned: Bool[Tensor, "P"]
) -> Float[Tensor, ""]:
    """Return the mean share of light that is stopped before the beam's hit; 0 if none returned."""
    return masked_mean(alpha_before_hit, returned)


def published_lidar_losses(
    weighted_range_m: Float[Tensor, "P"],
    intensity: Float[Tensor, "P"],
    opacity_before_hit: Float[Tensor, "P"],
    real_range_m: Float[Tensor, "P"],
    real_intensity: Float[Tensor, "P"],
    returned: Bool[Tensor, "P"],
    quantile: float,
) -> dict[str, Float[Tensor, ""]]:
    """Return the losses "depth", "intensity" and "line_of_sight" of SplatAD's reference implementation.

    A beam whose error of depth reaches the quantile adds 0 to each of them; means are over all returned
    beams. With our losses (`range_loss`, `intensity_loss`, `line_of_sight_loss`) the quantile bounds depth
    alone.

    Args:
        weighted_range_m: Σ weight · range. It is not divided by alpha, so the loss raises opacities too.
        opacity_before_hit: `alpha_before_hit` with `BeforeHit` "opacities".
    """
    error = (weighted_range_m - real_range_m).abs()[returned]
    if not len(error):
        nothing = weighted_range_m.new_zeros(())
        return {"depth": nothing, "intensity": nothing, "line_of_sight": nothing}
    # Beams above the quantile count 0, but stay in the mean
    counts = error < torch.quantile(error.detach(), quantile)
    return {
        "depth": (error * counts).mean(),
        "intensity": (counts * (intensity - real_intensity)[returned] ** 2).mean(),
        "line_of_sight": (counts * opacity_before_hit[returned]).mean(),
    }
