"""World model and heads of a finished run, with which another run begins."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from safetensors import safe_open

from foredrive.engine.checkpoints import load_weights
from foredrive.engine.folder import CONFIG, WEIGHTS
from foredrive.heads.joint import JointTasks
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.methods.recipe import Recipe
from foredrive.runs.recipes.task_heads import load_task_heads
from foredrive.runs.train.task_priors import TASKS


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


def load_perception(agent: PlanningAgent[Any], weights: Path) -> None:
    """Load the world model of another run, and the parts of its heads that the agent has too.

    Args:
        agent: its other parts stay as they are.
        weights: of the last stage of the other run.

    Raises:
        InputError: the file cannot be read, or is of another architecture.
    """
    load_weights(agent.world_model, weights, "world_model")
    assert agent.heads is not None
    # Agents with forecasts begin from agents without them, so their parts are loaded one by one
    parts = dict(agent.heads.named_children())
    agents = parts.pop("agents", None)
    parts |= {} if agents is None else {f"agents.{name}": part for name, part in agents.named_children()}
    with safe_open(weights, framework="pt") as file:
        stored = tuple(file.keys())
    for name, part in parts.items():
        if any(key.startswith(f"heads.{name}.") for key in stored):
            load_weights(part, weights, f"heads.{name}")
