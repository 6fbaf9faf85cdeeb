"""A vocabulary of plans: paths to the target point of the route × speeds."""

import math
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

NEAR_M = 4.0
"""A target that is nearer is moved away to this distance."""
CURVE_POINTS = 33


@dataclass(frozen=True)
class VocabularyConfig:
    """The plans of a `plan_vocabulary`: all combinations of ends, headings and speeds."""

    lateral_m: tuple[float, ...] = (-3.5, -1.75, -0.8, 0.0, 0.8, 1.75, 3.5)
    """Lateral offsets of the paths' ends from the target point, positive to the left."""
    bend_rad: tuple[float, ...] = (-0.35, 0.0, 0.35)
    """Differences of the heading at the end from that of an arc through the target point."""
    speeds: tuple[tuple[float, float], ...] = (
        (0.0, 6.0),
        (0.0, 3.0),
        (0.0, 1.5),
        (1.0, 3.0),
        (2.0, 1.5),
        (2.0, 4.0),
        (4.0, 1.5),
        (4.0, 3.0),
        (6.0, 1.5),
        (6.0, 3.0),
        (8.0, 1.2),
        (8.0, 2.5),
        (10.0, 1.5),
        (13.0, 1.2),
        (13.0, 2.5),
    )
    """Final speed (m/s) and acceleration towards it (m/s²)."""

    @property
    def size(self) -> int:
        """Return N, the number of plans."""
        return len(self.lateral_m) * len(self.bend_rad) * len(self.speeds)


class Candidates(NamedTuple):
    """N plans of T steps in the ego frame at now."""

    xy: Float[Tensor, "b N T 2"]
    """Middle of the rear axle, m."""
    yaw: Float[Tensor, "b N T"]
    speed_mps: Float[Tensor, "b N T"]


def plan_vocabulary(
    config: VocabularyConfig,
    speed_mps: Float[Tensor, "b"],
    target: Float[Tensor, "b 3"],
    steps: int,
    dt_s: float,
) -> Candidates:
    """Return all plans from the present speed, paths first.

    VADv2 and Hydra-MDP (Chen et al. 2024; Li et al. 2024) score a fixed vocabulary of thousands of driven
    trajectories. Here a few hundred are made anew from the present speed and the target point, so that each
    can be driven and leads along the route. A path is a cubic that begins in the ego vehicle's heading.
    Beyond its end it continues straight.

    Args:
        config: the combinations.
        speed_mps: present speed.
        target: x, y of the target point of the route and 1; zeros mean straight ahead.
        steps: T.
        dt_s: time of a step.
    """
    curve = _curves(config, target)  # [b P K 2]
    along_m, speeds = _distances(config, speed_mps, steps, dt_s)  # [b S T]
    b, paths, kinds = len(curve), curve.shape[1], along_m.shape[1]
    asked = along_m[:, None].expand(b, paths, kinds, steps).flatten(2)
    xy, yaw = _along(curve, asked)
    speeds = speeds[:, None].expand(b, paths, kinds, steps)
    return Candidates(
        xy.unflatten(2, (kinds, steps)).flatten(1, 2),
        yaw.unflatten(2, (kinds, steps)).flatten(1, 2),
        speeds.flatten(1, 2),
    )


def _curves(config: VocabularyConfig, target: Float[Tensor, "b 3"]) -> Float[Tensor, "b P K 2"]:
    """Return cubic Hermite curves from the ego vehicle to the places around the target."""
    known = target[:, 2:] > 0
    ahead = torch.where(known, target[:, :2], target.new_tensor([20.0, 0.0]))
    far_m = ahead.norm(dim=-1, keepdim=True)
    ahead = torch.where(far_m < 0.1, target.new_tensor([1.0, 0.0]), ahead)
    ahead = ahead * (NEAR_M / ahead.norm(dim=-1, keepdim=True)).clamp_min(1.0)
    arc = 2 * torch.atan2(ahead[:, 1], ahead[:, 0])
    arc = torch.atan2(arc.sin(), arc.cos())
    offset, bend = target.new_tensor(list(product(config.lateral_m, config.bend_rad))).T
    left = torch.stack([-arc.sin(), arc.cos()], dim=-1)
    end = ahead[:, None] + offset[:, None] * left[:, None]  # [b P 2]
    heading = arc[:, None] + bend
    length_m = end.norm(dim=-1, keepdim=True)
    at_start = length_m * target.new_tensor([1.0, 0.0])
    at_end = length_m * torch.stack([heading.cos(), heading.sin()], dim=-1)
    u = torch.linspace(0, 1, CURVE_POINTS, device=target.device)[:, None]
    return (
        (u**3 - 2 * u**2 + u) * at_start[:, :, None]
        + (3 * u**2 - 2 * u**3) * end[:, :, None]
        + (u**3 - u**2) * at_end[:, :, None]
    )


def _distances(
    config: VocabularyConfig, speed_mps: Float[Tensor, "b"], steps: int, dt_s: float
) -> tuple[Float[Tensor, "b S T"], Float[Tensor, "b S T"]]:
    """Return distance and speed at each step: a constant acceleration until the final speed is reached."""
    final, rate = speed_mps.new_tensor(config.speeds).T
    change = final - speed_mps[:, None]  # [b S]
    lasts_s = (change.abs() / rate)[..., None]
    t_s = dt_s * torch.arange(1, steps + 1, device=speed_mps.device)
    changing_s = torch.minimum(t_s, lasts_s)
    signed = (rate * change.sign())[..., None]
    speed = speed_mps[:, None, None] + signed * changing_s
    changing_m = speed_mps[:, None, None] * changing_s + 0.5 * signed * changing_s**2
    return changing_m + speed * (t_s - changing_s), speed


def _along(
    curve: Float[Tensor, "b P K 2"], at_m: Float[Tensor, "b P Q"]
) -> tuple[Float[Tensor, "b P Q 2"], Float[Tensor, "b P Q"]]:
    """Return points and headings of curves at distances along them."""
    step = curve.diff(dim=2)
    length = step.norm(dim=-1)
    begins = torch.cat([torch.zeros_like(length[..., :1]), length.cumsum(-1)], dim=-1)
    segment = torch.searchsorted(begins.contiguous(), at_m.contiguous(), right=True) - 1
    segment = segment.clamp(0, length.shape[-1] - 1)
    unit = step / length.clamp_min(1e-6)[..., None]
    index = segment[..., None].expand(*segment.shape, 2)
    direction = unit.gather(2, index)
    past_m = at_m - begins.gather(2, segment)
    xy = curve.gather(2, index) + past_m[..., None] * direction
    return xy, torch.atan2(direction[..., 1], direction[..., 0])


def turn_rates(candidates: Candidates, dt_s: float) -> Float[Tensor, "b N T"]:
    """Return the yaw rates of plans, rad/s."""
    turned = candidates.yaw.diff(dim=-1, prepend=torch.zeros_like(candidates.yaw[..., :1]))
    return ((turned + math.pi) % (2 * math.pi) - math.pi) / dt_s
