"""Losses of neural fields: where along a ray its weight should lie (Tonderski et al., "NeuRAD", 2024).

A ray has S intervals between positions `border`, with the probabilities `weight` that the ray ends in each.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

OF_LAYERS = (1 / 32, 1 / 16, 1 / 8, 1 / 4, 1.0)
"""Weights of VGG-19's layers relu1_1 to relu5_1, as in pix2pixHD (Wang et al. 2018)."""
_LEAST_WEIGHT = 1e-5
_LEAST_SHARE = 1e-2


def interlevel_loss(
    border: Float[Tensor, "R S1"],
    weight: Float[Tensor, "R S"],
    proposal_border: Float[Tensor, "R P1"],
    proposal_weight: Float[Tensor, "R P"],
    pulse: float,
) -> Float[Tensor, ""]:
    """Return by how much a proposal's weights are less than the field's (Barron et al., "Zip-NeRF", 2023).

    The field's histogram is blurred by a box of half width `pulse` and compared on the proposal's intervals:
    Σ max(0, w - ŵ)² / ŵ. Only the proposal gets a gradient.

    Args:
        border, weight: intervals of the field. What is left of a ray is given to its last interval.
        proposal_border, proposal_weight: intervals of the proposal.
        pulse: half width of the box, in units of `border`.
    """
    with torch.no_grad():
        rest = 1 - weight.sum(-1, keepdim=True)
        # The last interval also holds what is left of the ray, so the histogram sums to 1
        full = torch.cat([weight[:, :-1], weight[:, -1:] + rest], dim=-1)
        # Share of the blurred histogram in each of the proposal's intervals: difference of its integral
        knots, passed, slope = _blurred(border, full, pulse)
        share = _quadratic(proposal_border, knots, passed, slope).diff(dim=-1)
    # A proposal must be at least as large as the field's share; too large costs nothing
    missing = (share - proposal_weight).clamp_min(0)
    return (missing**2 / (proposal_weight + _LEAST_WEIGHT)).sum(-1).mean()


def _blurred(
    border: Float[Tensor, "R S1"], weight: Float[Tensor, "R S"], pulse: float
) -> tuple[Float[Tensor, "R K"], Float[Tensor, "R K"], Float[Tensor, "R K"]]:
    """Return knots, integral and density of a histogram that is blurred by a box (Zip-NeRF, supplement)."""
    # Histogram as a density, and its steps at the borders; it is 0 outside
    density = weight / border.diff(dim=-1).clamp_min(1e-7)
    step = torch.nn.functional.pad(density, (0, 1)) - torch.nn.functional.pad(density, (1, 0))
    # Blurring by a box turns every step into a ramp from border - pulse to border + pulse
    knots, order = torch.cat([border - pulse, border + pulse], dim=-1).sort(dim=-1)
    # The slope changes by step / (2 pulse) at the start of a ramp and back at its end
    bend = (torch.cat([step, -step], dim=-1) / (2 * pulse)).gather(1, order)
    gap = knots.diff(dim=-1)
    # Two sums over the sorted knots: slope to density, density to integral (trapezoids)
    height = torch.nn.functional.pad((gap * bend.cumsum(-1)[:, :-1]).cumsum(-1), (1, 0)).clamp_min(0)
    passed = torch.nn.functional.pad((0.5 * (height[:, 1:] + height[:, :-1]) * gap).cumsum(-1), (1, 0))
    return knots, passed, height


def _quadratic(
    x: Float[Tensor, "R P"],
    knots: Float[Tensor, "R K"],
    passed: Float[Tensor, "R K"],
    height: Float[Tensor, "R K"],
) -> Float[Tensor, "R P"]:
    """Return the integral at x of a density that is linear between knots, 0 before and 1 after them."""
    # Knots around each x
    right = torch.searchsorted(knots, x.contiguous()).clamp(1, knots.shape[1] - 1)
    left = right - 1
    x0, x1 = knots.gather(1, left), knots.gather(1, right)
    h0, h1 = height.gather(1, left), height.gather(1, right)
    # Integral up to x: integral at the left knot plus a trapezoid
    way = torch.minimum(torch.maximum(x, x0), x1) - x0
    part = way / (x1 - x0).clamp_min(1e-7)
    return passed.gather(1, left) + way * (h0 + 0.5 * part * (h1 - h0))


def distortion_loss(border: Float[Tensor, "R S1"], weight: Float[Tensor, "R S"]) -> Float[Tensor, ""]:
    """Return how far apart the weights of a ray are (Barron et al., "Mip-NeRF 360", 2022, eq. 15).

    Σ w_i w_j |m_i - m_j| + ⅓ Σ w_i² δ_i for middles m and lengths δ. The double sum is taken in one pass,
    because the middles ascend.
    """
    middle = 0.5 * (border[:, 1:] + border[:, :-1])
    moment = weight * middle
    # Weight, and weight times middle, of the samples before each one
    before = weight.cumsum(-1) - weight
    moment_before = moment.cumsum(-1) - moment
    # Each pair is counted once and doubled; |m_i - m_j| = m_i - m_j, as middles ascend
    between = 2 * (moment * before - weight * moment_before).sum(-1)
    within = (weight**2 * border.diff(dim=-1)).sum(-1) / 3
    return (between + within).mean()


def carving_loss(
    middle_m: Float[Tensor, "R S"],
    weight: Float[Tensor, "R S"],
    range_m: Float[Tensor, "R"],
    returned: Bool[Tensor, "R"],
    margin_m: float,
    free_m: float,
) -> Float[Tensor, ""]:
    """Return Σ w² over the samples of beams where nothing should be, mean over the beams.

    It is NeuRAD's loss, but for beams that did not return: the reference implementation penalises only what
    lies beyond `free_m`, we what lies before it.

    Args:
        middle_m, weight: the samples without the sky.
        range_m: distance of the returns.
        returned: whether the beams returned.
        margin_m: samples of returned beams within this distance of the return count as surface.
        free_m: beams that did not return are free up to this distance.
    """
    # Samples near the return are surface; all others of a returned beam should be empty
    near = (middle_m - range_m[:, None]).abs() < margin_m
    wrong = torch.where(returned[:, None], ~near, middle_m < free_m)
    return (weight**2 * wrong).sum(-1).mean()


def beam_depth_loss(
    depth_m: Float[Tensor, "R"],
    range_m: Float[Tensor, "R"],
    returned: Bool[Tensor, "R"],
    free_m: float,
    lost_weight: float,
    quantile: float = 1.0,
) -> Float[Tensor, ""]:
    """Return the mean absolute error of expected distances, beams that did not return included.

    A lost beam should end at `free_m` or beyond. The worst errors, above a quantile, are left out.
    """
    # A lost beam beyond free_m has no error: its target is its own distance
    target = torch.where(returned, range_m, depth_m.detach().clamp_min(free_m))
    error = (depth_m - target).abs() * torch.where(returned, 1.0, lost_weight)
    if quantile < 1 and len(error):
        limit = error.detach().kthvalue(max(int(quantile * len(error)), 1)).values
        error = error[error <= limit]
    return error.mean()


def hit_loss(
    border_m: Float[Tensor, "R S1"],
    weight: Float[Tensor, "R S"],
    range_m: Float[Tensor, "R"],
    returned: Bool[Tensor, "R"],
    near_m: float,
) -> Float[Tensor, ""]:
    """Return the mean of -log of the share of a beam that ends near its return; 0 if none returned.

    An interval that reaches beyond the neighbourhood counts with the part inside. The expected distance of
    `beam_depth_loss` can be right where a beam ends nowhere near its return; this loss cannot.

    Args:
        border_m, weight: intervals of the beams.
        range_m: distance of the returns.
        returned: whether the beams returned.
        near_m: what is nearer to the return than this counts.
    """
    if not bool(returned.any()):
        return weight.new_zeros(())
    low, high = border_m[:, :-1], border_m[:, 1:]
    target = range_m[:, None]
    # Overlap of each interval with the neighbourhood of the return
    inside = torch.minimum(high, target + near_m) - torch.maximum(low, target - near_m)
    part = inside.clamp_min(0) / (high - low).clamp_min(1e-6)
    # A share bounded from below keeps the logarithm finite
    share = (weight * part).sum(-1)[returned]
    return -(share + _LEAST_SHARE).log().mean()


def weighted_feature_loss(
    seen: Sequence[Float[Tensor, "n _c _h _w"]], real: Sequence[Float[Tensor, "n _c _h _w"]]
) -> Float[Tensor, ""]:
    """Return L1 between the features of images, summed over layers with the weights `OF_LAYERS`."""
    parts = zip(OF_LAYERS, seen, real, strict=False)  # small images have fewer layers
    return torch.stack([share * (a - b).abs().mean() for share, a, b in parts]).sum()
