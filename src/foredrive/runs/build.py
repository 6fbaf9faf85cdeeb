"""Build the modules that a recipe describes."""

from typing import Any

from jaxtyping import Float
from torch import Tensor, nn

from foredrive.errors import InputError
from foredrive.heads.heads import TaskHeads
from foredrive.heads.joint import TaskTerms
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.methods.planner.objective import PlannerObjective
from foredrive.methods.planner.planner import VolumePlanner
from foredrive.methods.recipe import Recipe
from foredrive.runs.recipes.world_models import WORLD_MODELS


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
        heads=None if recipe.tasks is None else recipe.tasks.heads,
    )
    return PlanningAgent(world_model, planner, _heads(recipe, world_model.channels))


def _heads(recipe: Recipe[Any, Any], channels: int) -> TaskHeads | None:
    if recipe.tasks is None:
        return None
    if recipe.clips.tasks is None:
        raise InputError(f"{recipe.name}: it has task heads, but clips.tasks reads no truth for them")
    return TaskHeads(
        recipe.tasks.heads,
        recipe.clips.voxels,
        channels=channels,
        raster=recipe.clips.tasks.raster,
        instance_grid=recipe.clips.tasks.instances,
    )


def build_objective(
    recipe: Recipe[Any, Any],
    stage: Any,
    agent: PlanningAgent[Any],
    class_weight: Float[Tensor, "C"] | None = None,
) -> nn.Module:
    """Build the module that maps an example to its losses in one stage of the recipe.

    Args:
        class_weight: weight of each class of semantic voxels, for the losses of the heads.
    """
    objective: nn.Module
    if recipe.transfer == "frozen":
        objective = PlannerObjective(agent)
    else:
        tasks = None if recipe.tasks is None else TaskTerms(recipe.tasks, recipe.clips.voxels, class_weight)
        objective = WORLD_MODELS[stage.kind].objective(stage, agent, recipe.clips, tasks)
        if recipe.transfer == "perception":
            agent.keep(agent.world_model.backbone, agent.world_model.encoder)
    if recipe.path is not None and agent.planner.path is not None:
        agent.planner.path.requires_grad_(False)  # It is fitted after the last stage
    return objective
