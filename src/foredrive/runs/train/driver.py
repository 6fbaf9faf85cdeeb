"""Runs of drivers: the folder with the recipe, the eyes' training and the weights of the whole driver."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from safetensors.torch import save_file

from foredrive.data import ClipDataset, LogPath
from foredrive.driver.agent import Driver
from foredrive.driver.eyes import CameraEyes
from foredrive.driver.objective import SightObjective, fit_planner
from foredrive.driver.packed import PackedClips, join
from foredrive.driver.recipe import DriverRecipe
from foredrive.driver.speed_planner import SpeedPlanner
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.recipes.config import read_values, save_recipe, validated
from foredrive.runs.folder import CONFIG, LOGS, WEIGHTS, RunFolder
from foredrive.runs.open_clips import open_clips
from foredrive.runs.train.rigs import RIGS, trained_rigs, write_rigs
from foredrive.runs.train.run import read_log, written_log
from foredrive.training import load_weights, train

SEE, PLAN = "see", "plan"
"""Folders of the stages."""


@dataclass(frozen=True)
class DriverRun:
    """A driver on disk."""

    folder: Path
    recipe: DriverRecipe
    logs: tuple[LogPath, ...]


def is_driver(folder: Path) -> bool:
    """Return whether a folder holds the run of a driver."""
    if not (folder / CONFIG).is_file():
        return False
    values = read_values(folder / CONFIG)
    return isinstance(values, dict) and values.get("kind") == "driver"


def open_driver(folder: Path) -> DriverRun:
    """Open the folder of a driver's run.

    Raises:
        InputError: it is none, or cannot be read.
    """
    if not is_driver(folder):
        raise InputError(f"{folder}: not the run of a driver")
    recipe: DriverRecipe = validated(DriverRecipe, read_values(folder / CONFIG), str(folder / CONFIG))
    try:
        written = json.loads((folder / LOGS).read_text())
        return DriverRun(folder, recipe, tuple(read_log(entry) for entry in written["logs"]))
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise InputError(f"{folder / LOGS}: cannot be read as paths of logs: {error}") from error


def load_driver(run: DriverRun) -> Driver:
    """Return the trained driver in evaluation mode.

    Raises:
        InputError: its training has not finished.
    """
    driver = Driver(CameraEyes(run.recipe.eyes), SpeedPlanner(run.recipe.planner))
    weights = run.folder / PLAN / WEIGHTS
    if not weights.is_file():
        raise InputError(f"{run.folder}: training has not finished; continue it with `foredrive train`")
    load_weights(driver, weights)
    return driver.eval()


def train_driver(
    recipe: DriverRecipe, logs: Sequence[LogPath], folder: Path, cache_dir: Path | None = None
) -> DriverRun:
    """Train the eyes, then fit the planner. It continues where an earlier call stopped.

    Args:
        recipe: the recipe.
        logs: logs with boxes and routes, and with lights to learn them.
        folder: folder of the run.
        cache_dir: folder of packed clips; by default in `folder`.

    Raises:
        InputError: the folder holds another run, another process trains it, or a log cannot be read.
    """
    from foredrive.training import make_fabric  # the import takes seconds

    run = DriverRun(folder, recipe, tuple(log.absolute() for log in logs))
    claim = RunFolder(folder, _asked(run), lambda: _read(folder), lambda: _write(run))
    claim.check()
    dataset = open_clips(run.logs, recipe.clips, cache_dir or folder / "cache")
    clips = PackedClips(dataset, (cache_dir or folder / "cache") / "packed")
    with claim.claimed():
        _write_rigs(run, dataset)
        clips.pack()
        torch.manual_seed(recipe.see.seed)
        driver = Driver(CameraEyes(recipe.eyes), SpeedPlanner(recipe.planner))
        eyes = folder / SEE / WEIGHTS
        if not eyes.is_file():
            fabric = make_fabric(recipe.precision)
            objective = SightObjective(driver.eyes, recipe.weights)
            train(objective, clips, join, recipe.see, folder / SEE, fabric)
            with atomic_path(eyes) as temporary:
                save_file(driver.eyes.state_dict(), temporary)
        if not (folder / PLAN / WEIGHTS).is_file():
            load_weights(driver.eyes, eyes)
            driver.eval()
            fit_planner(driver, clips, recipe.plan, recipe.see.seed)
            with atomic_path(folder / PLAN / WEIGHTS) as temporary:
                save_file(driver.state_dict(), temporary)
    return run


def _write_rigs(run: DriverRun, dataset: ClipDataset) -> None:
    if not (run.folder / RIGS).is_file():
        rigs = trained_rigs(run.logs, dataset.camera_names)
        if rigs is not None:
            write_rigs(rigs, run.folder)


def _asked(run: DriverRun) -> dict[str, object]:
    return {
        "a run with another recipe": asdict(run.recipe) | {"about": ""},
        "a run with other logs": run.logs,
    }


def _read(folder: Path) -> dict[str, object] | None:
    return _asked(open_driver(folder)) if (folder / CONFIG).is_file() else None


def _write(run: DriverRun) -> None:
    with atomic_path(run.folder / LOGS) as temporary:
        temporary.write_text(json.dumps({"logs": [written_log(log) for log in run.logs]}, indent=1))
    save_recipe(run.recipe, run.folder / CONFIG)
