"""The ego motion that measured poses and speeds suggest for the next key frames."""

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.se3 import exp_se3, inverse_se3, log_so3
from foredrive.scene import Frames

STANDING_M = 0.1
"""A vehicle that moved less than this since the last key frame has no measurable direction of travel."""


def continued_motion(frames: Frames, steps: int) -> Float[Tensor, "b F 4 4"]:
    """Return the ego motion over the next key frames at constant acceleration, on the present curve.

    Motion and curve are those since the last key frame, the acceleration is that between the speeds at both.
    Unknown speeds mean no acceleration. A standing vehicle starts straight ahead.

    Args:
        frames: at least two.
        steps: F.

    Returns:
        The ego frame at t+k+1 -> the ego frame at t+k.
    """
    # Motion since the last key frame, in the ego frame of then: translation and rotation vector. Poses are
    # relative to now, so float32 is enough; ONNX Runtime has no arc tangent in float64
    T_prev_now = inverse_se3(frames.T_now_ego[:, -2].float())
    moved_m, turn_rad = T_prev_now[:, :3, 3], log_so3(T_prev_now[:, :3, :3])
    travelled_m = moved_m.norm(dim=-1, keepdim=True)
    # Direction and curve per metre; a standing vehicle has neither and starts straight ahead
    per_m = 1 / travelled_m.clamp_min(STANDING_M)
    stands = travelled_m < STANDING_M
    direction = torch.where(stands, moved_m.new_tensor([1.0, 0.0, 0.0]), per_m * moved_m)
    curve = torch.where(stands, 0.0, per_m * turn_rad)
    known = frames.speed_valid[:, -2:].all(dim=-1)
    # Speed gained per interval, and so the distance gained per step
    faster_mps = torch.where(known, frames.speed_mps[:, -1] - frames.speed_mps[:, -2], 0.0)
    gained_m = faster_mps * (frames.t_s[:, -1] - frames.t_s[:, -2])
    steps_ahead = torch.arange(1, steps + 1, device=moved_m.device)
    # Distance in step k: the last one plus k times the gain, never backwards
    distance_m = (travelled_m + steps_ahead * gained_m[:, None]).clamp_min(0.0)[..., None]  # [b, F, 1]
    # Rotation by curve times distance; the translation is along the direction of travel
    turned = exp_se3(torch.cat([torch.zeros_like(direction), curve], dim=-1)[:, None] * distance_m)
    translation = torch.zeros_like(turned)
    translation[..., :3, 3] = distance_m * direction[:, None]
    return turned + translation
