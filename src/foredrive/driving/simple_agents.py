"""Agents that ignore their observations: the baselines of every other agent."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.driving.observation import FRAME_DT_S, HORIZON_STEPS
from foredrive.driving.replay.logged_drive import LoggedDrive
from foredrive.scene import Clip, Trajectory


@dataclass(frozen=True)
class StraightAgent:
    """Agent that drives straight on at a constant speed. At speed 0 it stands still."""

    speed_mps: float
    keeps: bool = False
    """If True, it keeps the speed that it has where that is more. Drives in towns begin at rest."""

    def act(self, observation: Clip) -> Trajectory:
        """Return a straight plan for every item of the batch."""
        speed = torch.full((len(observation.t_s), 1), self.speed_mps)
        if self.keeps:
            now = observation.ego_speed_mps[:, observation.now, None].to(speed)
            speed = torch.maximum(now, speed)
        x = speed * FRAME_DT_S * torch.arange(1, HORIZON_STEPS + 1)
        return plan_of(torch.stack([x, torch.zeros_like(x)], dim=-1)[:, None])


@dataclass(frozen=True, eq=False)
class ReplayAgent:
    """Agent that replays the logged drive from wherever it is. At the end of the log it stands still."""

    drive: LoggedDrive
    clock: Callable[[], float]
    """Returns the time of the log, s."""

    def act(self, observation: Clip) -> Trajectory:
        """Return the log's positions at the next key frames, for a batch of one.

        The current offset from the log is reduced linearly to 0 at the last of these frames. A faster
        correction would accelerate at once and then brake, and a controller that feeds this forward would
        stay behind for good.
        """
        now_s, T_world_ego = self.clock(), observation.T_world_ego[0, -1].numpy()
        poses = [self.drive.pose_at(now_s + FRAME_DT_S * k) for k in range(HORIZON_STEPS + 1)]
        xy = (np.linalg.inv(T_world_ego) @ np.stack(poses))[:, :2, 3]
        left = 1 - np.arange(1, HORIZON_STEPS + 1)[:, None] / HORIZON_STEPS
        return plan_of(torch.from_numpy(xy[1:] - left * xy[0]).float()[None, None])


def plan_of(xy: Float[Tensor, "b 1 T 2"]) -> Trajectory:
    """Build a trajectory from points. Its headings are 0, because controllers derive them from the points."""
    flat = xy[..., 0]
    return Trajectory(
        xy=xy,
        yaw=torch.zeros_like(flat),
        valid=torch.ones_like(flat, dtype=torch.bool),
        log_prob=torch.zeros(len(xy), 1),
        dt_s=FRAME_DT_S,
    )
