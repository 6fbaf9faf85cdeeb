"""Agents that look at nothing: what every other has to beat."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.scene import Clip, Trajectory
from foredrive.simulation.logged_drive import LoggedDrive
from foredrive.simulation.observation import FRAME_DT_S, HORIZON_STEPS


@dataclass(frozen=True)
class Straight:
    """Straight on at one speed, whatever comes. At 0 it stays where it is.

    Drives begin at rest, so that constant velocity in the sense of open loop would never move.
    """

    speed_mps: float

    def act(self, observation: Clip) -> Trajectory:
        """The same plan for everyone."""
        x = self.speed_mps * FRAME_DT_S * torch.arange(1, HORIZON_STEPS + 1)
        xy = torch.stack([x, torch.zeros_like(x)], dim=-1)
        return _plan(xy.expand(len(observation.t_s), 1, -1, -1))


@dataclass(frozen=True, eq=False)
class Replay:
    """Who drives as the log was driven, from wherever that has led; at its end it stands."""

    drive: LoggedDrive
    clock: Callable[[], float]
    """Time of the log, s."""

    def act(self, observation: Clip) -> Trajectory:
        """Where the log is at the next key frames, of a batch of one.

        What the vehicle is off by is made up for evenly until the last of them: who wanted it sooner would
        plan to speed up at once and then brake, and controllers that feed that forward fall behind for good.
        """
        now_s, T_world_ego = self.clock(), observation.T_world_ego[0, -1].numpy()
        poses = [self.drive.pose_at(now_s + FRAME_DT_S * k) for k in range(HORIZON_STEPS + 1)]
        xy = (np.linalg.inv(T_world_ego) @ np.stack(poses))[:, :2, 3]
        left = 1 - np.arange(1, HORIZON_STEPS + 1)[:, None] / HORIZON_STEPS
        return _plan(torch.from_numpy(xy[1:] - left * xy[0]).float()[None, None])


def _plan(xy: Float[Tensor, "b 1 T 2"]) -> Trajectory:
    """Controllers take headings from the points."""
    flat = xy[..., 0]
    return Trajectory(
        xy=xy,
        yaw=torch.zeros_like(flat),
        valid=torch.ones_like(flat, dtype=torch.bool),
        log_prob=torch.zeros(len(xy), 1),
        dt_s=FRAME_DT_S,
    )
