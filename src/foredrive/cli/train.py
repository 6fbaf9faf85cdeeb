"""`foredrive train`."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from foredrive.cli.arguments import OptionalPath, Settings, SomePaths, check_out_folder, check_run
from foredrive.data.log_paths import find_all_logs
from foredrive.lazy import importing


def train(
    recipe: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RECIPE")],
    logs: SomePaths,
    out: Path,
    cache: OptionalPath = None,
    occupancy: Literal["lidar", "accumulated", "recorded"] = "lidar",
    start: OptionalPath = None,
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
        start: Another run's folder: use its pre-trained weights and begin with fine-tuning.
        set: Entries of the recipe to replace, such as finetune.schedule.lr=1e-3; `foredrive recipes RECIPE`
            prints all entries.
    """
    check_out_folder(out)
    if start is not None:
        start = check_run(start)
    found = find_all_logs(logs)

    with importing():
        from foredrive.recipes import find_recipe, with_occupancy_source
        from foredrive.runs import train_run

    chosen = with_occupancy_source(find_recipe(recipe, set), occupancy)
    run = train_run(chosen, found, out, cache, start)
    print(f"trained {run.recipe.name}: {run.weights}")
    print(f"next: foredrive evaluate {out} --logs ...")
