"""`foredrive train`."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from foredrive.cli.arguments import OptionalPath, Settings, SomePaths, check_out_folder, check_run, rank
from foredrive.cli.progress import job_progress
from foredrive.data.log_paths import find_all_logs
from foredrive.errors import InputError
from foredrive.lazy import importing


def train(
    recipe: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RECIPE")],
    logs: SomePaths,
    out: Path,
    cache: OptionalPath = None,
    occupancy: Literal["lidar", "accumulated", "recorded"] = "lidar",
    start: OptionalPath = None,
    tasks: str = "",
    probe: bool = False,
    strategy: Literal["ddp", "fsdp"] = "ddp",
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
            pre-trained weights and begin with fine-tuning. For a driver, the run of another: go on from its
            weights, and draw clips in which it is wrong more often. With --probe, use its world model and
            planner as they are. With --set transfer=frozen, keep its world model and its heads as they are
            and train the planner alone.
        tasks: Tasks to train heads for, separated by commas: detection, tracking, map, motion, occupancy.
            Fine-tuning trains them together with the world model. With --probe also instances: the vehicles'
            cells now and in imagined key frames.
        probe: Train the heads of --tasks on the frozen world model instead. Its volumes are computed once and
            kept.
        strategy: How the processes that torchrun started, or the GPUs of this machine, share the training:
            "ddp", each holds the whole model; "fsdp", each holds a shard of its weights, gradients and
            optimizer state.
        set: Entries of the recipe to replace, such as finetune.schedule.lr=1e-3; `foredrive recipes RECIPE`
            prints all entries. With --tasks, tasks.weights.raster=2 and others for the heads; with
            --probe, tasks.schedule.steps=100 too (tasks/config.yaml in the run's folder has all).
    """
    check_out_folder(out)
    if start is not None:
        start = check_run(start)
    if probe and not tasks:
        raise InputError("--probe trains the heads of --tasks: name the tasks too")
    if probe and rank() is not None:
        raise InputError("--probe trains in one process: start it without torchrun")
    found = find_all_logs(logs)

    with importing():
        from foredrive.methods.recipe import with_occupancy_source
        from foredrive.runs import train_run
        from foredrive.runs.recipes.known import find_driver_recipe, find_recipe
        from foredrive.runs.recipes.task_heads import heads_for, with_joint_heads, with_settings
        from foredrive.runs.train.driver import train_driver
        from foredrive.runs.train.tasks import TASKS, probe_run, train_heads

    driver = find_driver_recipe(recipe, set)
    if driver is not None:
        if tasks or rank() is not None:
            raise InputError(f"{driver.name} trains a driver: leave out --tasks and torchrun")
        train_driver(driver, found, out, cache, start, job_progress)
        print(f"trained {driver.name}: {out}")
        print(f"next: foredrive drive --agent {out} --routes town05-short --out {out / 'short'}")
        return
    of_heads = tuple(entry.removeprefix(TASKS + ".") for entry in set if entry.startswith(TASKS + "."))
    others = tuple(entry for entry in set if not entry.startswith(TASKS + ".")) if tasks else set
    chosen = with_occupancy_source(find_recipe(recipe, others), occupancy)
    heads = heads_for(chosen, tasks.split(",")) if tasks else None
    if heads is not None and not probe:
        chosen = with_joint_heads(chosen, heads, of_heads)
    elif heads is not None:
        heads = with_settings(heads, of_heads)
    if probe and start is not None:
        run = probe_run(chosen, found, out, cache, start)
    else:
        run = train_run(chosen, found, out, cache, start, strategy)
    if heads is not None and probe:
        train_heads(run, heads)
        print(f"trained heads of {tasks}: {out / TASKS}")
    if not rank():
        print(f"trained {run.recipe.name}: {run.weights}")
        print(f"next: foredrive evaluate {out} --logs ...")
