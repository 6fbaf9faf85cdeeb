"""Agents that look at nothing: what every other has to beat."""

from dataclasses import dataclass

import torch

from foredrive.scene import Clip, Trajectory
from foredrive.simulation.observation import FRAME_DT_S, HORIZON_STEPS


@dataclass(frozen=True)
class Straight:
    """Straight on at one speed, whatever comes. At 0 it stays where it is.

    Drives begin at rest, so that constant velocity in the sense of open loop would never move.
    """

    speed_mps: float

    def act(self, observation: Clip) -> Trajectory:
        """The same plan for everyone."""
        batch = observation.t_s.shape[0]
        x = self.speed_mps * FRAME_DT_S * torch.arange(1, HORIZON_STEPS + 1)
        xy = torch.stack([x, torch.zeros_like(x)], dim=-1).expand(batch, 1, -1, -1)
        flat = xy[..., 0]
        return Trajectory(
            xy=xy,
            yaw=torch.zeros_like(flat),
            valid=torch.ones_like(flat, dtype=torch.bool),
            log_prob=torch.zeros(batch, 1),
            dt_s=FRAME_DT_S,
        )
