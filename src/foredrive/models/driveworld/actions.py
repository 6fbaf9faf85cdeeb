"""What a vehicle does from one key frame to the next, as velocity and steering angle of a bicycle."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.se3 import inverse_se3, yaw_of
from foredrive.scene import Clip

WHEELBASE_M = 2.86
SLOW_MPS = 0.5
"""A vehicle slower than this is said not to steer: its curvature is noise."""


def actions_of(clip: Clip) -> Float[Tensor, "b T 2"]:
    """What was done at each frame up to the next: velocity, m/s, and the bicycle's steering angle, rad.

    The angle is that of the arc between two poses; 0 at the last frame, where it is not known, and while
    the vehicle hardly moves.
    """
    T = clip.T_world_ego
    T_step = inverse_se3(T[:, :-1]) @ T[:, 1:]
    way_m = T_step[..., :2, 3].norm(dim=-1)
    dt_s = torch.diff(clip.t_s, dim=1).to(way_m)
    speed = torch.where(clip.ego_speed_valid[:, :-1], clip.ego_speed_mps[:, :-1].to(way_m), way_m / dt_s)
    curvature = yaw_of(T_step) / way_m.clamp_min(1e-3)
    steering = torch.where(way_m > SLOW_MPS * dt_s, torch.atan(WHEELBASE_M * curvature), 0.0)
    done = torch.stack([speed, steering], dim=-1).float()
    return torch.cat([done, torch.zeros_like(done[:, :1])], dim=1)


def motion_of(action: Float[Tensor, "b 2"], dt_s: float) -> Float[Tensor, "b 4 4"]:
    """The ego frame after an action, in that before it: the bicycle's arc."""
    speed, steering = action.unbind(-1)
    way_m, curvature = speed * dt_s, torch.tan(steering) / WHEELBASE_M
    yaw = way_m * curvature
    cos, sin = yaw.cos(), yaw.sin()
    zero, one = torch.zeros_like(yaw), torch.ones_like(yaw)
    chord = way_m * torch.sinc(0.5 * yaw / math.pi)
    x, y = chord * (0.5 * yaw).cos(), chord * (0.5 * yaw).sin()
    rows = [[cos, -sin, zero, x], [sin, cos, zero, y], [zero, zero, one, zero], [zero, zero, zero, one]]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
