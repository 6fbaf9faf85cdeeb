"""A driving agent: a world model with a planner on top."""

from collections.abc import Sequence
from typing import Generic, NamedTuple, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.models.ego_mlp import ego_motion, route_target
from foredrive.models.planner import VolumePlanner
from foredrive.scene import Belief, Clip, Decoded, Trajectory, WorldModel

W = TypeVar("W", bound=WorldModel)


class AgentOutput(NamedTuple):
    """The output of an agent for one clip."""

    beliefs: list[Belief]
    """The belief about now, then those of the imagined key frames."""
    decoded: list[Decoded]
    plan: Trajectory


class PlanningAgent(nn.Module, Generic[W]):
    """An `Agent` over any world model. It plans from the volumes at now and at the next step (NeMo §3.3)."""

    def __init__(self, world_model: W, planner: VolumePlanner) -> None:
        super().__init__()
        self.world_model: W = world_model
        self.planner = planner

    def forward(self, clip: Clip, steps: int) -> AgentOutput:
        """Observe the clip, imagine `steps` key frames (and those the planner needs), and plan."""
        beliefs = self.rollout(clip, max(steps, self.planner.imagined_frames))
        decoded = [self.world_model.decode(belief) for belief in beliefs[: steps + 1]]
        return AgentOutput(beliefs[: steps + 1], decoded, self.plan(clip, beliefs))

    def rollout(self, clip: Clip, steps: int) -> list[Belief]:
        """Return the beliefs about now and about the next `steps` key frames."""
        now = self.world_model.observe(clip)
        return [now, *self.world_model.imagine(now, steps)] if steps else [now]

    def plan(self, clip: Clip, beliefs: Sequence[Belief]) -> Trajectory:
        """Plan from the belief about now and those next key frames that the planner uses."""
        now = clip.now
        poses, speeds = ego_motion(clip, self.planner.history)
        plan: Trajectory = self.planner(
            self.planner_volume(beliefs[0]),
            self.planner_volume(beliefs[1]) if self.planner.imagined_frames else None,
            clip.command,
            clip.command_valid,
            speeds[:, -1],
            clip.ego_speed_valid[:, now],
            torch.cat([poses, speeds[:, :-1, None]], dim=-1),
            route_target(clip) if self.planner.target else None,
        )
        return plan

    def planner_volume(self, belief: Belief) -> Float[Tensor, "b D Z Y X"]:
        """Return the volume that the planner reads."""
        return self.world_model.volume_for(belief, "planning")

    @torch.no_grad()
    def act(self, observation: Clip) -> Trajectory:
        """Return the plan from now on."""
        return self.plan(observation, self.rollout(observation, self.planner.imagined_frames))
