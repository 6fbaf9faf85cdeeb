"""Projection of Gaussians to the image plane of a camera (Zwicker et al., "EWA splatting", 2002)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.geometry.projection import distort, distortion_jacobian, pixels_to_rays
from foredrive.methods.reconstruction.gaussians import Gaussians
from foredrive.methods.splatad.footprint import footprint, in_sensor, positions_in_sensor, through
from foredrive.ops.precision import numba_supports
from foredrive.ops.splatting import Splats

NEAR_M = 0.2
"""Minimum depth of the centre of a visible Gaussian, m."""
SPREAD_PX2 = 0.3
"""ε: variance that a pixel adds to a splat, px²."""
BEYOND, BEYOND_BENT = 0.15, 0.025
"""Margin beyond each border of the image, in image sizes, without and with distortion. Inside it, projections
are linearised at the centre; outside it, at the limit. A distorted image may fold soon after its border."""
REACH = 4.0
"""Visible extent of an opaque Gaussian in standard deviations, with some margin."""


def project_camera(
    gaussians: Gaussians,
    T_cam_scene: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    dist: Float[Tensor, "5"],
    size_hw: tuple[int, int],
    *,
    velocity_mps: Float[Tensor, "N 3"] | None = None,
    among: Bool[Tensor, "N"] | None = None,
    twist_cam: Float[Tensor, "6"] | None = None,
    compensate: bool = True,
    near_m: float = NEAR_M,
) -> Splats:
    """Return splats on the image plane, for `pixel_points`. Those that cannot reach the image are left out.

    Centres are projected exactly, including lens distortion; covariances by the Jacobian of the projection
    there. `Splats.range_m` is the depth along the camera's axis. Gradients reach all tensors. Kernels
    (`camera_kernels`) compute the same on the CPU, unless K or `dist` need gradients.

    Args:
        gaussians: Gaussians in the scene's frame.
        T_cam_scene: scene -> camera (x right, y down, z forward) when the middle row is exposed.
        K, dist: intrinsics, px, for images of `size_hw`, and distortion k1 k2 p1 p2 k3.
        velocity_mps: velocity of each Gaussian in the scene's axes; None: all are static.
        among: the Gaussians that count; None: all.
        twist_cam: velocity (m/s) then turn rate (rad/s) of the camera in its own axes, for rolling shutter;
            None: it is static. See `geometry.se3.sensor_twist`.
        compensate: lower the opacity by as much as ε = 0.3 px² widens a splat.
        near_m: minimum depth of the centre of a visible Gaussian.
    """
    position = positions_in_sensor(gaussians, T_cam_scene)
    lower, upper = _limits(K.detach(), dist.detach(), size_hw)
    with torch.no_grad():
        reach_m = REACH * gaussians.log_scale.amax(-1).exp()
        x, y, z = position
        seen = z > near_m
        for across, low, high in ((x, lower[0], upper[0]), (y, lower[1], upper[1])):
            # Signed distance to the left and right (top and bottom) plane of the view, inside positive
            seen &= (across - low * z) / (1 + low * low).sqrt() > -reach_m
            seen &= (high * z - across) / (1 + high * high).sqrt() > -reach_m
        chosen = (seen if among is None else seen & among).nonzero()[:, 0]
    if numba_supports(position, K, dist) and not K.requires_grad and not dist.requires_grad:
        from foredrive.methods.splatad.projection_numba import camera_projection, projected  # slow to import

        camera = camera_projection(K, dist, torch.cat([lower, upper]), SPREAD_PX2, compensate)
        return projected(camera, gaussians, chosen, T_cam_scene, velocity_mps, twist_cam)
    in_view = in_sensor(gaussians, position, chosen, T_cam_scene, velocity_mps, twist_cam)
    # Linear images of the covariances at the centres: Σ' = J M (J M)ᵀ + ε I
    uv, jacobian = _project(in_view.position_m, K, dist, lower, upper)
    spread = footprint(through(jacobian, in_view.factor_m), SPREAD_PX2)
    return Splats(
        mean=uv,
        inverse_covariance=spread.inverse,
        opacity=in_view.opacity * spread.compensation if compensate else in_view.opacity,
        range_m=in_view.position_m[2],
        range_slope=torch.zeros_like(uv),
        # Velocity on the image (px/s) and along the axis, for rolling shutter
        velocity=(jacobian * in_view.velocity_mps).sum(1).T,
        range_rate_mps=in_view.velocity_mps[2],
        feature=in_view.feature,
    )


def _limits(
    K: Float[Tensor, "3 3"], dist: Float[Tensor, "5"], size_hw: tuple[int, int]
) -> tuple[Float[Tensor, "2"], Float[Tensor, "2"]]:
    """Return bounds of x/z and y/z for the image with its margin."""
    height, width = size_hw
    # The borders' corners and middles bound x/z and y/z, also for a bent image
    border = [(u, v) for u in (0.0, width / 2, width) for v in (0.0, height / 2, height)]
    rays = pixels_to_rays(K.new_tensor(border), K, dist)
    xy = rays[:, :2] / rays[:, 2:]
    lower, upper = xy.amin(0), xy.amax(0)
    beyond = (BEYOND_BENT if dist.any() else BEYOND) * (upper - lower)
    return lower - beyond, upper + beyond


def _project(
    position_m: Float[Tensor, "3 N"],
    K: Float[Tensor, "3 3"],
    dist: Float[Tensor, "5"],
    lower: Float[Tensor, "2"],
    upper: Float[Tensor, "2"],
) -> tuple[Float[Tensor, "N 2"], Float[Tensor, "2 3 N"]]:
    """Return pixels of points and the Jacobian with respect to the points, px/m."""
    near = 1 / position_m[2]
    # Normalised coordinates x/z, y/z, and the same clamped to the image with its margin
    xy = (position_m[:2] * near).T
    within = torch.minimum(torch.maximum(xy, lower), upper)
    if dist.any():
        # Outside of the margin, the distortion is continued linearly: the polynomial may fold back there
        xx, xy_, yy = distortion_jacobian(within, dist).unbind(-1)
        dx, dy = (xy - within).unbind(-1)
        bent = distort(within, dist) + torch.stack([xx * dx + xy_ * dy, xy_ * dx + yy * dy], -1)
    else:
        xx, xy_, yy = torch.ones_like(near), torch.zeros_like(near), torch.ones_like(near)
        bent = xy
    (fx, fy), centre = (K[0, 0], K[1, 1]), K[:2, 2]
    # Chain rule: distortion Jacobian times that of (x/z, y/z), where -x/z² is -x·near in these units
    x, y = within.unbind(-1)
    across = torch.stack([fx * xx, fx * xy_, -fx * (xx * x + xy_ * y)])
    down = torch.stack([fy * xy_, fy * yy, -fy * (xy_ * x + yy * y)])
    return bent * torch.stack([fx, fy]) + centre, torch.stack([across, down]) * near
