"""`foredrive train`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from foredrive.cli.arguments import OptionalPath, Settings, SomePaths, check_out_folder, check_run, rank
from foredrive.cli.progress import job_progress
from foredrive.data.log_paths import find_all_logs
from foredrive.errors import InputError
from foredrive.lazy import importing

if TYPE_CHECKING:
    from foredrive.data.log_paths import LogPath
    from foredrive.driver.recipes import DriverRecipe
    from foredrive.methods.recipe import Recipe
    from foredrive.runs.recipes.task_heads import TaskHeadsRecipe

Occupancy = Literal["lidar", "accumulated", "recorded"]
Strategy = Literal["ddp", "fsdp"]


def train(
    recipe: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RECIPE")],
    logs: SomePaths,
    out: Path,
    cache: OptionalPath = None,
    occupancy: Occupancy | None = None,
    start: OptionalPath = None,
    tasks: str = "",
    probe: bool = False,
    strategy: Strategy = "ddp",
    set: Settings = (),
) -> None:
    """Train a recipe on logs, or continue an interrupted run.

    Args:
        recipe: Name of the recipe, such as nemo_tiny (`foredrive recipes` lists all), or a YAML file.
        logs: 123D logs, splits or data roots to train on.
        out: Folder of the run. If it holds this run already, training continues from the last checkpoint.
        cache: Folder for voxel labels and shrunk images; by default "cache" in the run's folder.
        occupancy: Source of the voxel labels: "lidar", the voxels that beams of the frame's sweep hit and
            passed through; "accumulated", those of sweeps within 3 s too; or "recorded", the exact occupancy
            that towns record, visible or not. A run with recorded labels is evaluated with them, others with
            those of the frame's sweep.
        start: Another run's folder, or a model that comes with the package (embedded:nemo_town): use its
            pre-trained weights and begin with fine-tuning. For a driver, the run of another driver: continue
            from its weights, and draw clips in which it is wrong more often than others. With --probe, use
            its world model and planner unchanged. With --set transfer=perception, use its last world model
            and its heads, and keep its encoder unchanged. With transfer=frozen, keep its world model and its
            heads unchanged and train only the planner.
        tasks: Tasks to train heads for, separated by commas: detection, tracking, map, motion, occupancy, or
            instances, the vehicles' cells now and in imagined key frames. Fine-tuning trains them together
            with the world model.
        probe: Train the heads of --tasks on the frozen world model instead. Its volumes are computed once and
            kept.
        strategy: How the processes that torchrun started, or the GPUs of this machine, share the training:
            "ddp", each holds the whole model; "fsdp", each holds a shard of its weights, gradients and
            optimizer state.
        set: Entries of the recipe to replace, such as finetune.schedule.lr=1e-3; `foredrive recipes RECIPE`
            prints every entry with its meaning. With --tasks, tasks.weights.raster=2 and others for the
            heads; with --probe, tasks.schedule.steps=100 too (tasks/config.yaml in the run's folder has all).
    """
    check_out_folder(out)
    if start is not None:
        start = check_run(start)
    if probe and not tasks:
        raise InputError("--probe trains the heads of --tasks: name the tasks too")
    if probe and rank() is not None:
        raise InputError("--probe trains in one process: start it without torchrun")
    log_paths = find_all_logs(logs)

    with importing():
        from foredrive.driver.recipes import DriverRecipe
        from foredrive.methods.recipe import Recipe
        from foredrive.runs.recipes.known import find_recipe

    if isinstance(find_recipe(recipe, (), Recipe, DriverRecipe), DriverRecipe):
        if tasks or rank() is not None:
            raise InputError(f"{recipe} trains a driver: leave out --tasks and torchrun")
        _train_driver(find_recipe(recipe, set, DriverRecipe), log_paths, out, cache, start)
    elif probe:
        chosen, heads = _with_heads(recipe, occupancy, tasks, set)
        _probe(chosen, heads, tasks, log_paths, out, cache, start)
    elif tasks:
        _train_agent(_jointly(recipe, occupancy, tasks, set), log_paths, out, cache, start, strategy)
    else:
        _train_agent(_plain(recipe, occupancy, set), log_paths, out, cache, start, strategy)


def _train_driver(
    recipe: "DriverRecipe", logs: "Sequence[LogPath]", out: Path, cache: Path | None, start: Path | None
) -> None:
    """Train a driver by sight."""
    with importing():
        from foredrive.runs.train.driver import train_driver

    train_driver(recipe, logs, out, cache, start, job_progress)
    print(f"trained {recipe.name}: {out}")
    print(f"next: foredrive drive --agent {out} --routes town05-short --out {out / 'short'}")


def _train_agent(
    recipe: "Recipe[Any, Any]",
    logs: "Sequence[LogPath]",
    out: Path,
    cache: Path | None,
    start: Path | None,
    strategy: Strategy,
) -> None:
    """Train a world model and its planner, with the heads of the recipe if it has any."""
    with importing():
        from foredrive.runs import train_run

    run = train_run(recipe, logs, out, cache, start, strategy)
    # Without torchrun, or in its first process
    if not rank():
        print(f"trained {run.recipe.name}: {run.weights}")
        print(f"next: foredrive evaluate {out} --logs ...")


def _probe(
    recipe: "Recipe[Any, Any]",
    heads: "TaskHeadsRecipe",
    tasks: str,
    logs: "Sequence[LogPath]",
    out: Path,
    cache: Path | None,
    start: Path | None,
) -> None:
    """Train heads on a frozen world model, either of another run or of a run that is trained first."""
    with importing():
        from foredrive.runs import train_run
        from foredrive.runs.train.tasks import TASKS, probe_run, train_heads

    if start is not None:
        run = probe_run(recipe, logs, out, cache, start)
    else:
        run = train_run(recipe, logs, out, cache)
    train_heads(run, heads)
    print(f"trained heads of {tasks}: {out / TASKS}")
    print(f"trained {run.recipe.name}: {run.weights}")
    print(f"next: foredrive evaluate {out} --logs ...")


def _plain(recipe: str, occupancy: Occupancy | None, settings: Settings) -> "Recipe[Any, Any]":
    """Return the recipe of a name."""
    with importing():
        from foredrive.methods.recipe import with_occupancy_source
        from foredrive.runs.recipes.known import find_recipe

    chosen = find_recipe(recipe, settings)
    return chosen if occupancy is None else with_occupancy_source(chosen, occupancy)


def _with_heads(
    recipe: str, occupancy: Occupancy | None, tasks: str, settings: Settings
) -> "tuple[Recipe[Any, Any], TaskHeadsRecipe]":
    """Return the recipe of a name and the recipe of its heads. Settings with `tasks.` belong to the heads."""
    with importing():
        from foredrive.runs.recipes.task_heads import heads_for, with_settings

    # Settings of the heads apply to the recipe of the heads, which depends on the chosen recipe
    of_recipe, of_heads = _split(settings)
    chosen = _plain(recipe, occupancy, of_recipe)
    return chosen, with_settings(heads_for(chosen, tasks.split(",")), of_heads)


def _jointly(recipe: str, occupancy: Occupancy | None, tasks: str, settings: Settings) -> "Recipe[Any, Any]":
    """Return the recipe with heads that fine-tuning trains together with the world model."""
    with importing():
        from foredrive.runs.recipes.task_heads import heads_for, with_joint_heads

    of_recipe, of_heads = _split(settings)
    chosen = _plain(recipe, occupancy, of_recipe)
    return with_joint_heads(chosen, heads_for(chosen, tasks.split(",")), of_heads)


def _split(settings: Settings) -> tuple[Settings, Settings]:
    """Return the settings of the recipe, and those of its heads without their prefix."""
    of_heads = tuple(entry for entry in settings if entry.startswith("tasks."))
    return (
        tuple(entry for entry in settings if entry not in of_heads),
        tuple(entry.removeprefix("tasks.") for entry in of_heads),
    )
