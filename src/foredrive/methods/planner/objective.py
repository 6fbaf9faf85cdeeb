"""Training of a planner alone, on a world model and heads that stay as they are."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.heads.plan_losses import waypoint_loss
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.methods.planner.planner import set_planner_trainable
from foredrive.scene import Example


class PlannerObjective(nn.Module):
    """The mapping from a batch to the loss of the plan. World model and heads are frozen, in evaluation mode.

    Args:
        agent: of any world model.
    """

    def __init__(self, agent: PlanningAgent[Any]) -> None:
        super().__init__()
        self.agent = agent
        agent.keep(*(part for part in (agent.world_model, agent.heads) if part is not None))
        set_planner_trainable(agent.planner, trainable=True)

    def forward(self, example: Example, generator: torch.Generator) -> dict[str, Float[Tensor, ""]]:
        """Return losses by name; "loss" is minimised. Nothing is drawn from the generator."""
        observed, agent = example.clip.observed(), self.agent
        # World model and heads run without gradients: only the planner is trained
        with torch.no_grad():
            beliefs = agent.rollout(observed, agent.planner.imagined_frames)
            output = agent.perceive(beliefs[0], observed)
        error = waypoint_loss(agent.plan(observed, beliefs, output), example.clip.future)
        return {"wpts": error, "loss": error}
