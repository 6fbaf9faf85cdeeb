"""Sampling and compositing along rays (NeMo eq. 2 and 5).

The feature of a ray is Σ w_i f_i over its samples. `attention3d.attend_volume` computes this sum directly
from the volume with the weights of this module, so that the features of the samples are never stored.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.precision import full_precision


class Composite(NamedTuple):
    """The compositing result of N samples on a ray.

    Attributes:
        weights: w_i = α_i Π_{j<i} (1 - α_j), the probability that the ray ends at sample i.
        expected_depth: Σ w_i d_i, m. A ray that does not end adds nothing. Divide by Σ w_i for the depth of
            rays that end.
        transmittance: Π (1 - α_i), the probability that the ray passes all samples.
    """

    weights: Float[Tensor, "*b N"]
    expected_depth: Float[Tensor, "*b"]
    transmittance: Float[Tensor, "*b"]


def composite(alpha: Float[Tensor, "*b N"], depth_m: Float[Tensor, "*b N"]) -> Composite:
    """Compute the weight of each sample of a ray, front to back (NeMo eq. 5).

    Values and gradients are exact, also at α = 0 and 1.

    Args:
        alpha: opacity of each sample, 0 to 1.
        depth_m: distance of each sample along its ray.

    Returns:
        float32 (float64 for float64 input), also from half precision.
    """
    with full_precision(alpha, depth_m) as (alpha, depth_m):
        # Memory traffic dominates here: a numba kernel was measured and is not faster.
        passed = torch.cumprod(1 - alpha, dim=-1)
        # The transmittance in front of sample i is the product over the samples before it
        weights = torch.cat([torch.ones_like(alpha[..., :1]), passed[..., :-1]], dim=-1) * alpha
        return Composite(
            weights=weights,
            expected_depth=(weights * depth_m).sum(-1),
            transmittance=passed[..., -1],
        )


def stratified_depths(
    near_m: float, far_m: float, bins: int, shape: tuple[int, ...], generator: torch.Generator | None = None
) -> Float[Tensor, "*shape bins"]:
    """Return one distance in each of `bins` equal parts of [near, far), ascending, for each ray.

    Args:
        near_m, far_m: start and end of the sampled interval.
        bins: number of samples on a ray.
        shape: shape of the set of rays.
        generator: draws uniformly within each bin, on its own device. None gives the bin centres.
    """
    if generator is None:
        within = torch.full((*shape, bins), 0.5)
    else:
        within = torch.rand((*shape, bins), generator=generator, device=generator.device)
    # Sample i lies at (i + within) bins from the start, so the distances ascend
    step = torch.arange(bins, device=within.device) + within
    return near_m + (far_m - near_m) / bins * step
