"""Projection of Gaussians to azimuth and elevation of a lidar (Hess et al., "SplatAD", 2025)."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.geometry.se3 import hat
from foredrive.methods.reconstruction.gaussians import Gaussians
from foredrive.methods.splatad.beams import sector_of
from foredrive.methods.splatad.footprint import InSensor, footprint, in_sensor, positions_in_sensor, through
from foredrive.ops.precision import numba_supports
from foredrive.ops.splatting import Splats

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
    among: Bool[Tensor, "N"] | None = None,
    twist_lidar: Float[Tensor, "6"] | None = None,
    compensate: bool = True,
    reach_m: float = math.inf,
    scan_s: Float[Tensor, "S"] | None = None,
) -> Splats:
    """Return splats over azimuth and elevation, for `beam_points`. Those that no beam can see are left out.

    With J the Jacobian of (azimuth, elevation, range) and Σ' = J Σ Jᵀ, the covariance of a splat is that of
    its angles plus ε. Where a beam passes beside the centre, its range is the conditional mean there: it
    changes by Σ'_range,angles (Σ'_angles + ε)⁻¹ over the plane. Gradients reach all tensors. Kernels
    (`lidar_kernels`) compute the same on the CPU.

    Args:
        gaussians: Gaussians in the scene's frame.
        T_lidar_scene: scene -> lidar (x forward, y left, z up) at time 0 of the beams.
        velocity_mps: velocity of each Gaussian in the scene's axes; None: all are static.
        among: the Gaussians that count; None: all.
        twist_lidar: velocity (m/s) then turn rate (rad/s) of the lidar in its own axes; None: it is static.
            See `geometry.se3.sensor_twist`.
        compensate: lower the opacity by as much as ε widens a splat.
        reach_m: maximum range of the centre of a visible Gaussian.
        scan_s: result of `scan_times`: the motion of each Gaussian is then right at the time at which its
            azimuth is scanned. None: right at time 0, and decimetres wrong at 25 m/s half a turn later.
    """
    position = positions_in_sensor(gaussians, T_lidar_scene)
    with torch.no_grad():
        x, y, z = position
        level2 = x * x + y * y
        range2 = level2 + z * z
        # Within reach, and not straight above or below, where the azimuth has no derivative
        seen = (range2 > NEAR_M**2) & (range2 <= reach_m**2) & (level2 > UPRIGHT**2 * range2)
        chosen = (seen if among is None else seen & among).nonzero()[:, 0]
    if numba_supports(position):
        from foredrive.methods.splatad.projection_numba import lidar_projection, projected  # slow to import

        lidar = lidar_projection(scan_s, SPREAD_RAD2, compensate)
        return projected(lidar, gaussians, chosen, T_lidar_scene, velocity_mps, twist_lidar)
    in_view = in_sensor(gaussians, position, chosen, T_lidar_scene, velocity_mps, twist_lidar)
    # Motion of the centre over the angles and the range: tangent at time 0, or a line through two places
    if scan_s is None:
        angles, range_m, jacobian = _project(in_view.position_m)
        centre = _Centre(angles, range_m, (jacobian * in_view.velocity_mps).sum(1))
    else:
        twist = in_view.position_m.new_zeros(6) if twist_lidar is None else twist_lidar
        centre, jacobian = _scanned(in_view, twist, scan_s)
    # J M for azimuth, elevation and range; the first two rows give the footprint
    spread = through(jacobian, in_view.factor_m)
    shape = footprint(spread[:2], SPREAD_RAD2)
    # Covariance of the range with both angles
    with_azimuth, with_elevation = (spread[:2] * spread[2]).sum(1)
    xx, xy, yy = shape.inverse.unbind(-1)
    return Splats(
        mean=centre.angles,
        inverse_covariance=shape.inverse,
        opacity=in_view.opacity * shape.compensation if compensate else in_view.opacity,
        range_m=centre.range_m,
        # Slope of the conditional mean of range over the angles:
        # Σ'_range,angles times the inverse footprint
        range_slope=torch.stack(
            [xx * with_azimuth + xy * with_elevation, xy * with_azimuth + yy * with_elevation], -1
        ),
        velocity=centre.velocity[:2].T,
        range_rate_mps=centre.velocity[2],
        feature=in_view.feature,
    )


class _Centre(NamedTuple):
    """Motion of the centres of splats, linear in time."""

    angles: Float[Tensor, "N 2"]
    """Azimuth and elevation at time 0, rad."""
    range_m: Float[Tensor, "N"]
    """Range at time 0."""
    velocity: Float[Tensor, "3 N"]
    """Change of azimuth, elevation (rad/s) and range (m/s)."""


def _scanned(
    in_view: InSensor, twist_lidar: Float[Tensor, "6"], scan_s: Float[Tensor, "S"]
) -> tuple[_Centre, Float[Tensor, "3 3 N"]]:
    """Return the centres such that they are right when they are scanned, and the Jacobian at that time.

    A turn ends where it begins, so Gaussians near this seam are seen twice, and their places a turn earlier
    or later must be right too. The motion is therefore the line through both places. The tangent would lead
    near Gaussians astray within a turn. The Jacobian takes vectors in the axes of the lidar at time 0.
    """
    with torch.no_grad():
        # First guess of the scan time from the azimuth at time 0, refined once after moving there
        time_s = scan_s[sector_of(torch.atan2(in_view.position_m[1], in_view.position_m[0]))]
        x, y, _ = _moved(in_view.position_m, in_view.velocity_mps, twist_lidar, time_s)
        time_s = scan_s[sector_of(torch.atan2(y, x))]
        turn_s = scan_s.max() - scan_s.min()
        # The same azimuth a turn earlier or later, at the other side of the seam
        other_s = torch.where(time_s > 0, time_s - turn_s, time_s + turn_s)
    here, beyond = (
        _project(_moved(in_view.position_m, in_view.velocity_mps, twist_lidar, when_s))
        for when_s in (time_s, other_s)
    )
    azimuth, elevation = (beyond[0] - here[0]).T
    # Difference of azimuths across ±π
    azimuth = torch.remainder(azimuth + math.pi, 2 * math.pi) - math.pi
    velocity = torch.stack([azimuth, elevation, beyond[1] - here[1]]) / (other_s - time_s)
    # The line through (time_s, here) at time 0
    centre = _Centre(here[0] - (time_s * velocity[:2]).T, here[1] - time_s * velocity[2], velocity)
    # Until then the axes turn by time · ω, and J (1 - time [ω]×) takes vectors in the axes at time 0.
    turned = hat(twist_lidar[3:]) @ here[2]
    return centre, here[2] + time_s * turned


def _moved(
    position_m: Float[Tensor, "3 N"],
    velocity_mps: Float[Tensor, "3 N"],
    twist_lidar: Float[Tensor, "6"],
    time_s: Float[Tensor, "N"],
) -> Float[Tensor, "3 N"]:
    """Return positions in the lidar's frame at another time, to second order.

    With p' = v in a frame that moves by u and turns by ω, p'' = -ω × (2 v + u + ω × p).
    """
    turn = hat(twist_lidar[3:])
    change = -turn @ (2 * velocity_mps + twist_lidar[:3, None] + turn @ position_m)
    # Taylor expansion to second order: p + t v + t²/2 p''
    return position_m + time_s * (velocity_mps + 0.5 * time_s * change)


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
    # Rows are the gradients of azimuth, elevation and range
    jacobian = [
        torch.stack([-y / level2, x / level2, zero]),
        torch.stack([-x * z / level, -y * z / level, level]) / range2,
        position_m / range_m,
    ]
    return angles, range_m, torch.stack(jacobian)
