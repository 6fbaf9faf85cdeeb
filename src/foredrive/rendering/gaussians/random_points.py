"""Random seed points around a drive, in the far field and near the path, as SplatAD has them."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.se3 import transform_points
from foredrive.rendering.seed_points import SeedPoints, even_in_inverse, neighbour_distance_m

AHEAD_M, ASIDE_M, HEIGHT_M = 80.0, 60.0, 50.0
"""Padding of the drive's bounds ahead and behind, and to both sides; height of the bounds, m."""
FAR_M = 1e4
"""Distance of the farthest points, m."""


class DriveBounds(NamedTuple):
    """An upright box around the poses of a drive, in the scene's axes."""

    centre_m: Float[Tensor, "3"]
    size_m: Float[Tensor, "3"]


def drive_bounds(T_scene_sensor: Float[Tensor, "V 4 4"]) -> DriveBounds:
    """Return the box around the mean position that holds every pose with its padding.

    Args:
        T_scene_sensor: poses with x ahead and y to the left.
    """
    padding = [(0.0, 0.0, 0.0), *((x, y, 0.0) for x in (-AHEAD_M, AHEAD_M) for y in (-ASIDE_M, ASIDE_M))]
    corners = torch.stack([transform_points(T, T.new_tensor(padding)) for T in T_scene_sensor])
    centre_m = T_scene_sensor[:, :3, 3].mean(0)
    size_m = 2 * (corners - centre_m).abs().amax((0, 1))
    size_m[2] = HEIGHT_M
    return DriveBounds(centre_m, size_m)


def random_points(
    bounds: DriveBounds, far: int, near: int, scale: float, generator: torch.Generator
) -> SeedPoints:
    """Return points of random colours: `far` above and around the bounds, `near` in them.

    Far points lie in random directions of the upper half, at distances uniform in 1/m from the bounds to
    `FAR_M`. Near points are uniform in the bounds.

    Args:
        scale: standard deviation in units of the mean distance to the nearest of these points.
    """
    direction = torch.rand(far, 3, generator=generator) - 0.5
    direction[:, 2].abs_()
    range_m = even_in_inverse(far, (0.5 * float(bounds.size_m[:2].min()), FAR_M), generator)
    away_m = torch.nn.functional.normalize(direction, dim=-1) * range_m[:, None]
    beside_m = (torch.rand(near, 3, generator=generator) - 0.5) * bounds.size_m
    xyz_m = bounds.centre_m + torch.cat([away_m, beside_m])
    return SeedPoints(
        xyz_m,
        torch.rand(far + near, 3, generator=generator),
        torch.zeros(far + near, dtype=torch.bool),
        scale * neighbour_distance_m(xyz_m),
    )
