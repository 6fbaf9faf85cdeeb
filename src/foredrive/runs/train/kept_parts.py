"""World model and heads of a finished run, kept as they are by a run that trains the planner alone."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from foredrive.engine.checkpoints import load_weights
from foredrive.engine.folder import CONFIG, WEIGHTS
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.methods.recipe import Recipe
from foredrive.runs.recipes.task_heads import load_task_heads
from foredrive.runs.train.task_priors import TASKS
from foredrive.tasks.heads.joint import JointTasks


def with_kept_heads(recipe: Recipe[Any, Any], kept: Recipe[Any, Any], folder: Path) -> Recipe[Any, Any]:
    """Return a recipe whose agent has the task heads of another run: joint ones, a probe's or none.

    Args:
        recipe: its `transfer` is "frozen".
        kept: recipe of the other run.
        folder: folder of the other run.

    Raises:
        InputError: the settings of a probe cannot be read.
    """
    tasks, truth = kept.tasks, kept.clips.tasks
    probe = folder / TASKS / CONFIG
    if tasks is None and probe.is_file():
        heads = load_task_heads(probe)
        tasks, truth = JointTasks(heads.heads, heads.weights), heads.truth
    return replace(recipe, tasks=tasks, clips=replace(recipe.clips, tasks=truth))


def load_kept(agent: PlanningAgent[Any], kept: Recipe[Any, Any], folder: Path, weights: Path) -> None:
    """Load the world model and the heads of another run.

    Args:
        agent: has the heads of the other run.
        kept, folder: as for `with_kept_heads`.
        weights: of the last stage of the other run.

    Raises:
        InputError: a file cannot be read or is of another architecture.
    """
    load_weights(agent.world_model, weights, "world_model")
    if agent.heads is not None and kept.tasks is not None:
        load_weights(agent.heads, weights, "heads")
    elif agent.heads is not None:
        load_weights(agent.heads, folder / TASKS / WEIGHTS)
