"""Where along their rays a field is sampled.

Positions on a ray are s in 0 to 1, with t = spacing · s / (1 - s): uniform near the sensor, and uniform in
inverse distance far away. This is the power spacing of Barron et al., "Zip-NeRF", 2023, with λ = -1.
"""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

Resampling = Literal["greedy", "padded"]
"""Rules by which the borders of new intervals follow from the weights of others.

greedy: 0.01 / N is added to the weights of N intervals, and the new ones reach from the first border to the
last. padded: 0.01 is added to each weight, and the borders are the middles of equal quantiles, as in NeuRAD's
reference implementation. If one of 128 intervals has all weight, it gets 44 % of the new ones, not 98 %.
"""
_LEAST_SHARE = 0.01
"""Added to the weights, so that no interval is never sampled."""


def to_distance(s: Float[Tensor, "*b"], spacing_m: float, far_m: float) -> Float[Tensor, "*b"]:
    """Return distances of positions; s = 1 is `far_m`."""
    # s = 1 maps to far_m instead of infinity
    s = s * (far_m / (far_m + spacing_m))
    return spacing_m * s / (1 - s)


def to_position(distance_m: Float[Tensor, "*b"], spacing_m: float, far_m: float) -> Float[Tensor, "*b"]:
    """Return the positions of distances up to `far_m`."""
    return distance_m / (distance_m + spacing_m) * ((far_m + spacing_m) / far_m)


def first_borders(
    rays: int, samples: int, generator: torch.Generator | None, like: Tensor
) -> Float[Tensor, "R N1"]:
    """Return the borders of equal intervals from 0 to 1.

    Args:
        rays: number of rays.
        samples: number of intervals.
        generator: moves the inner borders of each ray by up to half an interval, all together. None: no move.
        like: a tensor with the type and the device of the result.
    """
    borders = torch.linspace(0, 1, samples + 1, device=like.device, dtype=like.dtype).expand(rays, -1)
    if generator is None:
        return borders
    # One shift for all inner borders of a ray keeps the intervals equal
    move = (_random(rays, generator, like) - 0.5) / samples
    inner = borders[:, 1:-1] + move
    return torch.cat([borders[:, :1], inner, borders[:, -1:]], dim=-1)


def resampled_borders(
    borders: Float[Tensor, "R N1"],
    weights: Float[Tensor, "R N"],
    samples: int,
    generator: torch.Generator | None,
    how: Resampling = "greedy",
) -> Float[Tensor, "R M1"]:
    """Return the borders of M intervals that have about equal shares of a histogram.

    Args:
        borders, weights: intervals and weights of the histogram; both are taken as constants.
        samples: number of intervals M.
        generator: see `first_borders`.
        how: see `Resampling`.
    """
    with torch.no_grad():
        padded = how == "padded"
        # A small share for every interval keeps some samples where the proposal sees nothing
        share = weights + _LEAST_SHARE / (1 if padded else weights.shape[1])
        passed = torch.cumsum(share, dim=-1)
        # Cumulative distribution from 0 to 1 over the borders
        passed = torch.cat([torch.zeros_like(passed[:, :1]), passed / passed[:, -1:]], dim=-1)
        if padded:
            wanted = _quantiles(len(borders), samples + 1, generator, borders)
        else:
            wanted = first_borders(len(borders), samples, generator, borders)
        # Inverse of the cumulative distribution at equal quantiles
        return interpolated(wanted.contiguous(), passed, borders)


def _quantiles(
    rays: int, count: int, generator: torch.Generator | None, like: Tensor
) -> Float[Tensor, "R M1"]:
    """Return one position in each of `count` equal parts of 0 to 1: the middles, or the same random place."""
    parts = torch.arange(count, device=like.device, dtype=like.dtype).expand(rays, -1)
    return (parts + (0.5 if generator is None else _random(rays, generator, like))) / count


def interpolated(
    x: Float[Tensor, "R M"], query: Float[Tensor, "R N"], value: Float[Tensor, "R N"]
) -> Float[Tensor, "R M"]:
    """Return the piecewise linear functions through (at, value) at x, constant beyond their ends."""
    # Interval of each x; values outside of the ends use the first or last one and are clamped
    right = torch.searchsorted(query, x, right=True).clamp(1, query.shape[1] - 1)
    x0, x1 = query.gather(1, right - 1), query.gather(1, right)
    y0, y1 = value.gather(1, right - 1), value.gather(1, right)
    part = ((x - x0) / (x1 - x0).clamp_min(torch.finfo(x.dtype).tiny)).clamp(0, 1)
    return y0 + part * (y1 - y0)


def _random(count: int, generator: torch.Generator, like: Tensor) -> Float[Tensor, "R 1"]:
    return torch.rand(count, 1, generator=generator, device=generator.device).to(like)
