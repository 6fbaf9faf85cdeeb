"""Baselines: planners that see nothing and learn nothing."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.errors import InputError
from foredrive.methods.planner.ego_mlp import ego_speeds
from foredrive.scene import Clip, Trajectory


@dataclass(frozen=True)
class StandStill:
    """Plans to stay where it is (an `Agent`)."""

    steps: int
    dt_s: float

    def act(self, observation: Clip) -> Trajectory:
        """Plan to stay."""
        return _straight(torch.zeros_like(observation.ego_speed_mps[:, 0]), self.steps, self.dt_s)


@dataclass(frozen=True)
class ConstantVelocity:
    """Plans to go on straight ahead at its present speed (an `Agent`)."""

    steps: int
    dt_s: float

    def act(self, observation: Clip) -> Trajectory:
        """Plan to go on. An unknown speed is taken from the last two poses.

        Raises:
            InputError: if there is no earlier pose either.
        """
        now = observation.now
        if now == 0 and not bool(observation.ego_speed_valid[:, 0].all()):
            raise InputError("constant velocity needs a speed at now or an earlier pose")
        return _straight(ego_speeds(observation)[:, now], self.steps, self.dt_s)


def _straight(speed_mps: Float[Tensor, "b"], steps: int, dt_s: float) -> Trajectory:
    x = speed_mps[:, None, None] * dt_s * torch.arange(1, steps + 1, device=speed_mps.device)
    return Trajectory(
        xy=torch.stack([x, torch.zeros_like(x)], dim=-1),
        yaw=torch.zeros_like(x),
        valid=torch.ones_like(x, dtype=torch.bool),
        log_prob=torch.zeros_like(x[..., 0]),
        dt_s=dt_s,
    )
