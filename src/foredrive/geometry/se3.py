"""Rigid motions as 4×4 matrices. `T_dst_src` maps points of frame src to frame dst.

Products are computed in full precision, also within autocast.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.precision import full_precision


def inverse_se3(T: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """Invert rigid motions by transposing the rotation."""
    with full_precision(T) as (T,):
        R_t = T[..., :3, :3].transpose(-1, -2)
        # Inverse of [R t] is [Rᵀ -Rᵀ t]
        out = torch.zeros_like(T)
        out[..., :3, :3] = R_t
        out[..., :3, 3:] = -R_t @ T[..., :3, 3:]
        out[..., 3, 3] = 1
        return out


def compose_se3(
    T_dst_mid: Float[Tensor, "*#b 4 4"], T_mid_src: Float[Tensor, "*#b 4 4"]
) -> Float[Tensor, "*#b 4 4"]:
    """Return T_dst_src of two motions one after the other."""
    with full_precision(T_dst_mid, T_mid_src) as (T_dst_mid, T_mid_src):
        return T_dst_mid @ T_mid_src


def transform_points(T: Float[Tensor, "*b 4 4"], points: Float[Tensor, "*b N 3"]) -> Float[Tensor, "*b N 3"]:
    """Map points from src to dst."""
    with full_precision(T, points) as (T, points):
        return points @ T[..., :3, :3].transpose(-1, -2) + T[..., None, :3, 3]


def rotate_vectors(T: Float[Tensor, "*b 4 4"], vectors: Float[Tensor, "*b N 3"]) -> Float[Tensor, "*b N 3"]:
    """Rotate free vectors (directions, velocities) from src to dst."""
    with full_precision(T, vectors) as (T, vectors):
        return vectors @ T[..., :3, :3].transpose(-1, -2)


def yaw_from_matrix(T: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b"]:
    """Return the heading of the x axis of src in dst, about the z axis of dst, rad in (-π, π]."""
    return torch.atan2(T[..., 1, 0], T[..., 0, 0])


def hat(v: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Return the cross-product matrix: hat(v) @ u = v × u."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


def exp_se3(xi: Float[Tensor, "*b 6"]) -> Float[Tensor, "*b 4 4"]:
    """Return the exponential map of se(3). Its value and gradient are smooth at 0.

    Args:
        xi: translation part (3, m), then rotation vector (3, rad).
    """
    with full_precision(xi) as (xi,):
        rho, phi = xi[..., :3], xi[..., 3:]
        theta2 = (phi * phi).sum(-1)[..., None, None]
        # Small angles use series, in which neither value nor gradient divides by zero
        small = theta2 < 1e-6
        safe2 = torch.where(small, torch.ones_like(theta2), theta2)
        theta = safe2.sqrt()
        # a = sin θ / θ, b = (1 - cos θ) / θ², c = (θ - sin θ) / θ³
        a = torch.where(small, 1 - theta2 / 6, theta.sin() / theta)
        b = torch.where(small, 0.5 - theta2 / 24, (1 - theta.cos()) / safe2)
        c = torch.where(small, 1 / 6 - theta2 / 120, (theta - theta.sin()) / (safe2 * theta))
        W = hat(phi)
        W2 = W @ W
        eye = torch.eye(3, dtype=xi.dtype, device=xi.device)
        # Rodrigues for the rotation; the translation part is multiplied by the left Jacobian of SO(3)
        top = torch.cat([eye + a * W + b * W2, (eye + b * W + c * W2) @ rho[..., None]], dim=-1)
        bottom = torch.zeros_like(top[..., :1, :])
        bottom[..., 3] = 1
        return torch.cat([top, bottom], dim=-2)


def sensor_twist(T_ego_sensor: Float[Tensor, "4 4"], twist_ego: Float[Tensor, "6"]) -> Float[Tensor, "6"]:
    """Return velocity (m/s) and turn rate (rad/s) of a sensor fixed to the ego frame, in the sensor's axes.

    Args:
        twist_ego: velocity (m/s) and turn rate (rad/s) of the ego frame, in the axes of the ego frame.
    """
    # Velocity of the sensor's position: v + ω × r, then into the sensor's axes
    linear = twist_ego[:3] + torch.linalg.cross(twist_ego[3:], T_ego_sensor[:3, 3])
    return torch.cat([T_ego_sensor[:3, :3].T @ linear, T_ego_sensor[:3, :3].T @ twist_ego[3:]])


def log_so3(R: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Return the rotation vectors, rad, of rotations by less than π."""
    # v = 2 sin θ · axis
    v = torch.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], dim=-1
    )
    sin = 0.5 * v.norm(dim=-1)
    cos = 0.5 * (R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1)
    angle = torch.atan2(sin, cos)
    # θ / (2 sin θ), or ½ where both vanish
    scale = torch.where(sin < 1e-7, torch.full_like(sin, 0.5), angle / (2 * sin.clamp_min(1e-7)))
    return v * scale[..., None]


def matrix_from_yaw(yaw: Float[Tensor, "*b"], xyz: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4 4"]:
    """Return the pose of a frame at `xyz` (m) that is turned by `yaw` (rad) about z."""
    cos, sin = yaw.cos(), yaw.sin()
    T = torch.zeros(*yaw.shape, 4, 4, dtype=yaw.dtype, device=yaw.device)
    T[..., 0, 0], T[..., 0, 1] = cos, -sin
    T[..., 1, 0], T[..., 1, 1] = sin, cos
    T[..., 2, 2] = T[..., 3, 3] = 1
    T[..., :3, 3] = xyz
    return T
