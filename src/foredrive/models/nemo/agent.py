"""NeMo as something that drives: the world model and the planner on top of it."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import nn

from foredrive.models.ego_mlp import ego_motion
from foredrive.models.nemo.world_model import Nemo
from foredrive.models.planner import VolumePlanner
from foredrive.scene import Belief, Clip, Decoded, Trajectory


class NemoOutput(NamedTuple):
    """Everything NeMo says about a clip."""

    beliefs: list[Belief]
    """Now, then the imagined key frames."""
    decoded: list[Decoded]
    plan: Trajectory


class NemoAgent(nn.Module):
    """An `Agent`: plans from the volume at now and the one imagined next (NeMo §3.3)."""

    def __init__(self, world_model: Nemo, planner: VolumePlanner) -> None:
        super().__init__()
        self.world_model = world_model
        self.planner = planner

    def forward(self, clip: Clip, steps: int) -> NemoOutput:
        """Observe, imagine `steps` key frames and whatever the planner looks at, plan."""
        beliefs, decoded = self.world_model(clip, max(steps, self.planner.looks_ahead))
        return NemoOutput(beliefs[: steps + 1], decoded[: steps + 1], self.plan(clip, beliefs))

    def plan(self, clip: Clip, beliefs: Sequence[Belief]) -> Trajectory:
        """Plan from what is believed of now and of the next key frames, as many as the planner looks at."""
        now = clip.now
        poses, speeds = ego_motion(clip, self.planner.history)
        plan: Trajectory = self.planner(
            beliefs[0].volume,
            beliefs[1].volume if self.planner.looks_ahead else None,
            clip.command,
            clip.command_valid,
            clip.ego_speed_mps[:, now],
            clip.ego_speed_valid[:, now],
            torch.cat([poses, speeds[:, :-1, None]], dim=-1),
        )
        return plan

    @torch.no_grad()
    def act(self, observation: Clip) -> Trajectory:
        """The plan from now on."""
        return self(observation, 0).plan
