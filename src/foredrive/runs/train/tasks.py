"""Task heads of a run: trained on its frozen world model, kept in its folder."""

import dataclasses
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from foredrive.data import LogPath
from foredrive.errors import InputError
from foredrive.evaluation.task_priors import TaskPriors, fit_task_priors
from foredrive.files import atomic_path
from foredrive.losses.semantics import class_weights
from foredrive.models.tasks.heads import TaskHeads
from foredrive.recipes.config import Recipe, save_recipe
from foredrive.recipes.task_heads import TaskHeadsRecipe, load_task_heads
from foredrive.runs.folder import CONFIG, WEIGHTS
from foredrive.runs.train.kept_volumes import KeptVolumes, collate_kept
from foredrive.runs.train.run import Run, begin_run, load_agent, open_run
from foredrive.scene.semantics import VOXEL_CLASSES
from foredrive.training import load_weights, save_weights, train
from foredrive.training.task_probe import ProbeObjective

TASKS = "tasks"
"""Folder of the heads in the folder of a run."""
PRIORS = "priors.safetensors"
"""File of the baselines beside the heads."""


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
        InputError: the run holds other heads, has not finished, or a log cannot be read.
    """
    from foredrive.training import make_fabric  # the import takes seconds

    folder = run.folder / TASKS
    if (folder / CONFIG).is_file() and load_task_heads(folder / CONFIG) != heads:
        raise InputError(f"{folder}: holds other heads; choose another folder for the run")
    if not (folder / WEIGHTS).is_file():
        agent = load_agent(run)
        clips = dataclasses.replace(run.recipe.clips, tasks=heads.truth, now_stride_s=heads.now_stride_s)
        dataset = KeptVolumes(agent, run.logs, clips, heads.heads.tasks, run.cache_dir)
        if not (folder / CONFIG).is_file():
            save_recipe(heads, folder / CONFIG)
        torch.manual_seed(heads.schedule.seed)
        fresh = _build(run, heads)
        objective = ProbeObjective(fresh, run.recipe.clips.voxels, heads.weights, _class_weight(dataset))
        fabric = make_fabric("32-true")
        fabric.launch()
        train(objective, dataset, collate_kept, heads.schedule, folder, fabric)
        if fabric.is_global_zero:
            _save_priors(fit_task_priors(example.truth for example in dataset.examples), folder / PRIORS)
            with atomic_path(folder / WEIGHTS) as temporary:
                save_weights(fresh, temporary)
        fabric.barrier()
    found = load_heads(run)
    assert found is not None
    return found


def load_heads(run: Run) -> TrainedHeads | None:
    """Return the trained heads of a run, or None if it has none.

    Raises:
        InputError: they cannot be read.
    """
    folder = run.folder / TASKS
    if not (folder / WEIGHTS).is_file():
        return None
    recipe = load_task_heads(folder / CONFIG)
    heads = _build(run, recipe)
    load_weights(heads, folder / WEIGHTS)
    return TrainedHeads(heads.eval(), recipe, _load_priors(folder / PRIORS))


def _build(run: Run, recipe: TaskHeadsRecipe) -> TaskHeads:
    return TaskHeads(
        recipe.heads,
        run.recipe.clips.voxels,
        channels=run.recipe.model.channels,
        raster=recipe.truth.raster,
    )


def _save_priors(priors: TaskPriors, path: Path) -> None:
    known = {name: value.contiguous() for name, value in vars(priors).items() if value is not None}
    with atomic_path(path) as temporary:
        save_file(known, temporary)


def _load_priors(path: Path) -> TaskPriors:
    try:
        return TaskPriors(**load_file(path))
    except (OSError, SafetensorError, TypeError) as error:
        raise InputError(f"{path}: cannot be read as baselines: {error}") from error


def _class_weight(dataset: KeptVolumes) -> Float[Tensor, "C"] | None:
    """Return the weights of the semantic classes from their shares in the training set."""
    truths = [example.truth.semantics for example in dataset.examples]
    voxels = [truth for truth in truths if truth is not None]
    if not voxels:
        return None
    classes = len(VOXEL_CLASSES[voxels[0].taxonomy])
    counts = [torch.bincount(truth.index[truth.known].long(), minlength=classes) for truth in voxels]
    return class_weights(torch.stack(counts).sum(dim=0))
