"""Build the modules that a recipe describes."""

from typing import Any

from torch import nn

from foredrive.models.agent import PlanningAgent
from foredrive.models.planner import VolumePlanner
from foredrive.recipes.config import Recipe
from foredrive.recipes.world_models import WORLD_MODELS


def build_agent(recipe: Recipe[Any, Any], *, fetch: bool = True) -> PlanningAgent[Any]:
    """Build the world model and the planner with fresh weights.

    Args:
        fetch: whether to download what the recipe names: weights of a backbone and encodings of texts. It is
            not needed where trained weights replace them.
    """
    clips = recipe.clips
    world_model = WORLD_MODELS[recipe.model.kind].build(recipe.model, clips, fetch)
    planner = VolumePlanner(
        recipe.planner,
        clips.voxels,
        channels=world_model.channels,
        horizon_steps=clips.horizon_steps,
        dt_s=clips.horizon_dt_s,
    )
    return PlanningAgent(world_model, planner)


def build_objective(recipe: Recipe[Any, Any], stage: Any, agent: PlanningAgent[Any]) -> nn.Module:
    """Build the module that maps an example to its losses in one stage of the recipe."""
    objective = WORLD_MODELS[stage.kind].objective(stage, agent, recipe.clips)
    if recipe.path is not None and agent.planner.path is not None:
        agent.planner.path.requires_grad_(False)  # it is fitted after the last stage
    return objective
