"""Contraction of unbounded space into the unit cube."""

import torch
from jaxtyping import Float
from torch import Tensor


def contract(
    points_m: Float[Tensor, "N 3"], footprint_m: Float[Tensor, "N"], scale_m: float
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N"]]:
    """Map space into the unit cube (Barron et al., "Mip-NeRF 360", 2022, eq. 10, with the maximum norm).

    The cube of half side `scale_m` about the origin becomes the inner half of the unit cube, without change
    of shape. What lies beyond is drawn together. A footprint shrinks by the cube root of the volume's change.

    Args:
        points_m: positions.
        footprint_m: side of the volume that each position stands for.
        scale_m: half side of the cube that keeps its shape.

    Returns:
        Positions in the unit cube, and footprints in sides of the cube.
    """
    points = points_m / scale_m
    size = points.abs().amax(-1, keepdim=True).clamp_min(1)
    inverse = 1 / size
    points = points * (2 - inverse) * inverse
    with torch.no_grad():
        shrink = ((2 * size - 1) ** 2)[:, 0].pow(1 / 3) * inverse[:, 0] ** 2
        footprint = footprint_m / (4 * scale_m) * shrink
    return 0.25 * points + 0.5, footprint
