"""Actions of a vehicle between key frames: velocity and steering angle of a bicycle model."""

import math

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from foredrive.geometry.se3 import compose_se3, inverse_se3, yaw_from_matrix
from foredrive.scene import Clip, Frames

WHEELBASE_M = 2.86
SLOW_MPS = 0.5
"""Below this speed (m/s) the steering angle is set to 0, because the curvature is noise."""


def actions_of(clip: Clip) -> Float[Tensor, "b T 2"]:
    """Return `actions_between` for all frames of a clip."""
    return actions_between(clip.T_world_ego, clip.t_s, clip.ego_speed_mps, clip.ego_speed_valid)


def actions_in(frames: Frames) -> Float[Tensor, "b T 2"]:
    """Return `actions_between` for observed frames."""
    return actions_between(frames.T_now_ego, frames.t_s, frames.speed_mps, frames.speed_valid)


def actions_between(
    T_any_ego: Float64[Tensor, "b T 4 4"],
    t_s: Float[Tensor, "b T"],
    speed_mps: Float[Tensor, "b T"],
    speed_valid: Bool[Tensor, "b T"],
) -> Float[Tensor, "b T 2"]:
    """Return the action from each frame to the next: velocity (m/s) and steering angle of the bicycle (rad).

    The angle is that of the arc between the two poses. It is 0 at the last frame, where it is unknown, and
    while the vehicle hardly moves.

    Args:
        T_any_ego: poses in any common frame.
    """
    # Relative poses are formed in 64 bits, as poses of the world are large
    T_step = compose_se3(inverse_se3(T_any_ego[:, :-1]), T_any_ego[:, 1:]).float()
    way_m = T_step[..., :2, 3].norm(dim=-1)
    dt_s = torch.diff(t_s, dim=1).to(way_m)
    # An unmeasured speed is the distance to the next pose over time
    speed = torch.where(speed_valid[:, :-1], speed_mps[:, :-1].to(way_m), way_m / dt_s)
    # Curvature of the arc: turn over distance
    curvature = yaw_from_matrix(T_step) / way_m.clamp_min(1e-3)
    # Steering angle of the bicycle model: tan(steering) = wheelbase · curvature
    steering = torch.where(way_m > SLOW_MPS * dt_s, torch.atan(WHEELBASE_M * curvature), 0.0)
    done = torch.stack([speed, steering], dim=-1).float()
    return torch.cat([done, torch.zeros_like(done[:, :1])], dim=1)


def motion_of(action: Float[Tensor, "b 2"], dt_s: float) -> Float[Tensor, "b 4 4"]:
    """Return the pose after an action in the ego frame before it, along the arc of the bicycle."""
    speed, steering = action.float().unbind(-1)
    way_m, curvature = speed * dt_s, torch.tan(steering) / WHEELBASE_M
    yaw = way_m * curvature
    cos, sin = yaw.cos(), yaw.sin()
    zero, one = torch.zeros_like(yaw), torch.ones_like(yaw)
    # Chord of the arc: way · sin(yaw/2) / (yaw/2), finite also for yaw = 0; it points along half the turn
    chord = way_m * torch.sinc(0.5 * yaw / math.pi)
    x, y = chord * (0.5 * yaw).cos(), chord * (0.5 * yaw).sin()
    rows = [[cos, -sin, zero, x], [sin, cos, zero, y], [zero, zero, one, zero], [zero, zero, zero, one]]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
