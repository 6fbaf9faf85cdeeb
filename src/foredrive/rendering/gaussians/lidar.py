"""Projection of Gaussians to azimuth and elevation of a lidar (Hess et al., "SplatAD", 2025)."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.ops.splatting import Splats
from foredrive.rendering.gaussians.footprint import footprint, in_sensor, positions_in_sensor, through
from foredrive.rendering.gaussians.gaussians import Gaussians

NEAR_M = 0.2
"""Minimum range of the centre of a visible Gaussian, m."""
UPRIGHT = 0.02
"""Minimum cosine of the elevation. Closer to straight up or down, azimuth is undefined."""
SPREAD_RAD2 = 0.01719 * math.radians(1) ** 2
"""ε: variance that a beam's width adds to a splat, from SplatAD: 0.131° squared."""


def project_lidar(
    gaussians: Gaussians,
    T_lidar_scene: Float[Tensor, "4 4"],
    *,
    velocity_mps: Float[Tensor, "N 3"] | None = None,
    twist_lidar: Float[Tensor, "6"] | None = None,
    compensate: bool = True,
    reach_m: float = math.inf,
) -> Splats:
    """Return splats over azimuth and elevation, for `beam_points`. Those that no beam can see are left out.

    With J the Jacobian of (azimuth, elevation, range) and Σ' = J Σ Jᵀ, the covariance of a splat is that of
    its angles plus ε. Where a beam passes beside the centre, its range is the conditional mean there: it
    changes by Σ'_range,angles (Σ'_angles + ε)⁻¹ over the plane. Gradients reach all tensors.

    Args:
        gaussians: Gaussians in the scene's frame.
        T_lidar_scene: scene -> lidar (x forward, y left, z up) at time 0 of the beams.
        velocity_mps: velocity of each Gaussian in the scene's axes; None: all are static.
        twist_lidar: velocity (m/s) then turn rate (rad/s) of the lidar in its own axes; None: it is static.
            See `geometry.se3.sensor_twist`.
        compensate: lower the opacity by as much as ε widens a splat.
        reach_m: maximum range of the centre of a visible Gaussian.
    """
    position = positions_in_sensor(gaussians, T_lidar_scene)
    with torch.no_grad():
        x, y, z = position
        level2 = x * x + y * y
        range2 = level2 + z * z
        seen = (range2 > NEAR_M**2) & (range2 <= reach_m**2) & (level2 > UPRIGHT**2 * range2)
        chosen = seen.nonzero()[:, 0]
    them = in_sensor(gaussians, position, chosen, T_lidar_scene, velocity_mps, twist_lidar)
    angles, range_m, jacobian = _project(them.position_m)
    spread = through(jacobian, them.factor_m)
    shape = footprint(spread[:2], SPREAD_RAD2)
    with_azimuth, with_elevation = (spread[:2] * spread[2]).sum(1)
    xx, xy, yy = shape.inverse.unbind(-1)
    velocity = (jacobian * them.velocity_mps).sum(1)
    return Splats(
        mean=angles,
        inverse_covariance=shape.inverse,
        opacity=them.opacity * shape.compensation if compensate else them.opacity,
        range_m=range_m,
        range_slope=torch.stack(
            [xx * with_azimuth + xy * with_elevation, xy * with_azimuth + yy * with_elevation], -1
        ),
        velocity=velocity[:2].T,
        range_rate_mps=velocity[2],
        feature=them.feature,
    )


def _project(
    position_m: Float[Tensor, "3 N"],
) -> tuple[Float[Tensor, "N 2"], Float[Tensor, "N"], Float[Tensor, "3 3 N"]]:
    """Return azimuth and elevation (rad), range (m), and the Jacobian of all three by position."""
    x, y, z = position_m
    level2 = x * x + y * y
    level, range2 = level2.sqrt(), level2 + z * z
    range_m = range2.sqrt()
    zero = torch.zeros_like(x)
    angles = torch.stack([torch.atan2(y, x), torch.atan2(z, level)], -1)
    jacobian = [
        torch.stack([-y / level2, x / level2, zero]),
        torch.stack([-x * z / level, -y * z / level, level]) / range2,
        position_m / range_m,
    ]
    return angles, range_m, torch.stack(jacobian)
