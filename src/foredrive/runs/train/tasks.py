"""Task heads of a run: trained on its frozen world model, kept in its folder."""

import dataclasses
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from foredrive.data import LogPath
from foredrive.engine.checkpoints import load_weights, save_weights
from foredrive.engine.config import save_recipe
from foredrive.engine.folder import CONFIG, WEIGHTS
from foredrive.engine.loop import train
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.heads.heads import TaskHeads
from foredrive.heads.probe import ProbeObjective
from foredrive.methods.recipe import Recipe
from foredrive.runs.recipes.task_heads import TaskHeadsRecipe, check_instances, load_task_heads
from foredrive.runs.train.kept_volumes import KeptVolumes, collate_kept
from foredrive.runs.train.run import Run, begin_run, load_agent, open_run
from foredrive.runs.train.sequences import in_sequences
from foredrive.runs.train.task_priors import (
    PRIORS,
    SURVEYED,
    TASKS,
    check_truth,
    load_priors,
    place_map_elements,
    save_priors,
    semantic_weights,
)
from foredrive.tasks.task_priors import TaskPriors, fit_task_priors


@dataclass(frozen=True)
class TrainedHeads:
    """Trained heads in evaluation mode, and their settings."""

    heads: TaskHeads
    recipe: TaskHeadsRecipe
    priors: TaskPriors
    """Constant predictions that fit the training set best: baselines."""


def probe_run(
    recipe: Recipe, logs: Sequence[LogPath], folder: Path, cache_dir: Path | None, start: Path
) -> Run:
    """Begin a run whose world model and planner are those of another run, unchanged.

    Raises:
        InputError: `start` has not finished or is of another recipe; `folder` holds another run.
    """
    other = open_run(start)
    if other.recipe.tasks is not None:
        raise InputError(
            f"{start}: its heads were trained with its world model, so there is nothing to probe"
        )
    if dataclasses.replace(recipe, name=other.recipe.name) != other.recipe:
        raise InputError(
            f"{start}: its recipe is not {recipe.name}. A probe keeps the world model as it is: "
            f"name {start / CONFIG} as the recipe"
        )
    weights = other.weights
    run = begin_run(other.recipe, logs, folder, cache_dir, start)
    place = folder / weights.parent.name / WEIGHTS
    if not place.is_file():
        with atomic_path(place) as temporary:
            shutil.copyfile(weights, temporary)
    return run


def train_heads(run: Run, heads: TaskHeadsRecipe) -> TrainedHeads:
    """Train heads on the frozen world model of a run, or continue. Volumes are computed once and kept.

    Raises:
        InputError: the run holds other heads, has not finished, a log cannot be read, or no log has the truth
            of a task.
    """
    from foredrive.engine.fabric import make_fabric  # the import takes seconds

    folder = run.folder / TASKS
    if (folder / CONFIG).is_file() and load_task_heads(folder / CONFIG) != heads:
        raise InputError(f"{folder}: holds other heads; choose another folder for the run")
    if not (folder / WEIGHTS).is_file():
        check_instances(run.recipe, heads)
        check_truth(heads.heads, run.logs)
        agent = load_agent(run)
        clips = dataclasses.replace(run.recipe.clips, tasks=heads.truth, now_stride_s=heads.now_stride_s)
        sizes = heads.heads
        dataset = KeptVolumes(agent, run.logs, clips, sizes.volumes, run.cache_dir, sizes.later)
        if not (folder / CONFIG).is_file():
            save_recipe(heads, folder / CONFIG)
        torch.manual_seed(heads.schedule.seed)
        fresh = _build(run, heads)
        few = dataset.examples[:: -(-len(dataset) // SURVEYED)]
        place_map_elements(fresh, (example.truth for example in few), heads.schedule.seed)
        class_weight = semantic_weights(example.truth for example in dataset.examples)
        voxels = run.recipe.clips.voxels
        objective = ProbeObjective(fresh, voxels, heads.weights, class_weight, heads.mirror)
        keys = [key for example in dataset.examples for key in example.key]
        items, join, schedule = in_sequences(dataset, keys, collate_kept, heads.heads, heads.schedule)
        train(objective, items, join, schedule, folder, make_fabric("32-true"))
        save_priors(fit_task_priors(example.truth for example in dataset.examples), folder / PRIORS)
        with atomic_path(folder / WEIGHTS) as temporary:
            save_weights(fresh, temporary)
    trained = load_heads(run)
    assert trained is not None
    return trained


def load_heads(run: Run) -> TrainedHeads | None:
    """Return the trained heads of a run, those of its agent or a probe's; None if it has none.

    Raises:
        InputError: they cannot be read.
    """
    folder = run.folder / TASKS
    if run.recipe.tasks is not None:
        return _heads_of_agent(run)
    if not (folder / WEIGHTS).is_file():
        return None
    recipe = load_task_heads(folder / CONFIG)
    heads = _build(run, recipe)
    load_weights(heads, folder / WEIGHTS)
    return TrainedHeads(heads.eval(), recipe, load_priors(folder / PRIORS))


def _heads_of_agent(run: Run) -> TrainedHeads | None:
    recipe, heads = run.recipe, load_agent(run).heads
    if heads is None or recipe.tasks is None or recipe.clips.tasks is None:
        return None
    settings = TaskHeadsRecipe(
        recipe.tasks.heads, recipe.clips.tasks, recipe.finetune.schedule, recipe.tasks.weights
    )
    return TrainedHeads(heads, settings, load_priors(run.folder / TASKS / PRIORS))


def _build(run: Run, recipe: TaskHeadsRecipe) -> TaskHeads:
    return TaskHeads(
        recipe.heads,
        run.recipe.clips.voxels,
        channels=run.recipe.model.channels,
        raster=recipe.truth.raster,
        instance_grid=recipe.truth.instances,
    )
