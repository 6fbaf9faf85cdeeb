"""Pinhole cameras with OpenCV radial-tangential distortion. Pixel centres lie at +0.5."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

MIN_DEPTH_M = 1e-5
UNDISTORT_ITERATIONS = 10


def distort(xy: Float[Tensor, "*b N 2"], dist: Float[Tensor, "*b 5"]) -> Float[Tensor, "*b N 2"]:
    """Apply the distortion k1 k2 p1 p2 k3 to normalised image coordinates (x/z, y/z)."""
    k1, k2, p1, p2, k3 = (d[..., None] for d in dist.unbind(-1))
    # r2 is the squared distance from the optical axis in the plane z = 1
    x, y = xy.unbind(-1)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    # Radial factor, then the two tangential terms
    return torch.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        dim=-1,
    )


def distortion_jacobian(xy: Float[Tensor, "*b N 2"], dist: Float[Tensor, "*b 5"]) -> Float[Tensor, "*b N 3"]:
    """Return the Jacobian of `distort` at normalised image coordinates: its entries xx, xy = yx and yy."""
    k1, k2, p1, p2, k3 = (d[..., None] for d in dist.unbind(-1))
    x, y = xy.unbind(-1)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # 2 · d(radial)/d(r2)
    return torch.stack(
        [
            radial + slope * x * x + 2 * p1 * y + 6 * p2 * x,
            slope * x * y + 2 * p1 * x + 2 * p2 * y,
            radial + slope * y * y + 6 * p1 * y + 2 * p2 * x,
        ],
        dim=-1,
    )


def undistort(xy: Float[Tensor, "*b N 2"], dist: Float[Tensor, "*b 5"]) -> Float[Tensor, "*b N 2"]:
    """Invert `distort` by fixed-point iteration. It is accurate where the distortion is invertible."""
    if _is_ideal(dist):
        return xy
    out = xy
    # x ← x - (distort(x) - target): a contraction where the distortion is small
    for _ in range(UNDISTORT_ITERATIONS):
        out = out - (distort(out, dist) - xy)
    return out


def _is_ideal(dist: Float[Tensor, "*b 5"]) -> bool:
    """Return whether the distortion is zero, so that it can be skipped.

    Return False during tracing, because a traced graph must also work for cameras with distortion.
    """
    return not torch.compiler.is_compiling() and not bool(dist.any())


def project(
    points_cam: Float[Tensor, "*b N 3"],
    K: Float[Tensor, "*b 3 3"],
    dist: Float[Tensor, "*b 5"],
    size_hw: tuple[int, int],
) -> tuple[Float[Tensor, "*b N 2"], Float[Tensor, "*b N"], Bool[Tensor, "*b N"]]:
    """Project points in the camera frame.

    Returns:
        Pixel coordinates u, v (px).
        Depth z (m).
        Whether the point is in front of the camera and inside the image. Points far outside the field of view
        are rejected before distortion, because the distortion polynomial would fold them back into the image.
    """
    depth = points_cam[..., 2]
    # The clamp keeps points behind the camera finite; they are masked below
    xy = points_cam[..., :2] / depth.clamp_min(MIN_DEPTH_M)[..., None]
    height, width = size_hw
    # Largest distance from the axis within the image: that of the most distant corner
    corners = torch.tensor([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]], dtype=K.dtype)
    rays = pixels_to_rays(corners.to(K.device).expand(*K.shape[:-2], 4, 2), K, dist)
    reach = (rays[..., :2] / rays[..., 2:]).norm(dim=-1).amax(-1)[..., None]
    in_view = (depth > MIN_DEPTH_M) & (xy.norm(dim=-1) <= 1.05 * reach)
    # Points out of view are set to the axis before the polynomial, which may overflow there
    bent = xy if _is_ideal(dist) else distort(torch.where(in_view[..., None], xy, torch.zeros_like(xy)), dist)
    uv = bent * torch.stack([K[..., 0, 0], K[..., 1, 1]], -1)[..., None, :] + K[..., None, :2, 2]
    inside = (uv >= 0).all(-1) & (uv[..., 0] < width) & (uv[..., 1] < height)
    return uv, depth, in_view & inside


def pixels_to_rays(
    uv: Float[Tensor, "*b N 2"], K: Float[Tensor, "*b 3 3"], dist: Float[Tensor, "*b 5"]
) -> Float[Tensor, "*b N 3"]:
    """Return unit viewing directions of pixel coordinates, in the camera frame."""
    # Focal lengths in the order of u and v
    focal = torch.stack([K[..., 0, 0], K[..., 1, 1]], -1)[..., None, :]
    xy = undistort((uv - K[..., None, :2, 2]) / focal, dist)
    rays = torch.cat([xy, torch.ones_like(xy[..., :1])], dim=-1)
    return rays / rays.norm(dim=-1, keepdim=True)


def pixel_centres(size_hw: tuple[int, int]) -> Float[Tensor, "H W 2"]:
    """Return the coordinates u, v of every pixel centre, px."""
    v, u = torch.meshgrid(torch.arange(size_hw[0]) + 0.5, torch.arange(size_hw[1]) + 0.5, indexing="ij")
    return torch.stack([u, v], dim=-1)
