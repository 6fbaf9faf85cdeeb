"""Drivers of a study: the same virtual egos for all arms, training, and figures of what they see."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from foredrive.data import LogPath, find_all_logs
from foredrive.driver.judging import judge_sight, judge_sight_by
from foredrive.driver.packed import PackedClips
from foredrive.driver.recipes import DRIVER_RECIPES, DriverRecipe
from foredrive.driving.drive_record import DriveRecord
from foredrive.errors import InputError
from foredrive.runs.drive.recording import EgosPlan, record_egos
from foredrive.runs.open_clips import open_clips
from foredrive.runs.train.driver import DriverRun, load_driver, train_driver
from foredrive.sensors.rigs import FRONT_TELE
from foredrive.towns.map.names import TEST_TOWNS, TOWNS, is_held_out

TRAINING_TOWNS = tuple(town for town in TOWNS if not is_held_out(town))
SIGN_TILES = ("Town12_Tile_10_-6", "Town12_Tile_-3_-19", "Town12_Tile_5_-22")
"""Tiles with many stop signs, which are rare in the training towns."""
EGOS, TEST_EGOS = 60, 300
"""Logs of virtual egos of each training town and seed, and of Town05: five clips each."""
PRETRAINED = "embedded:nemo_town"
SCENARIO_S = 8.0
ON_ITS_WAY = ("light_accuracy_40m", "red_missed_40m", "conflict_recall", "conflict_false", "conflicts")


def egos(
    seeds: Sequence[int],
    folder: Path,
    workers: int,
    conditions: Sequence[str] = (),
    towns: Sequence[str] = TRAINING_TOWNS,
) -> list[LogPath]:
    """Return the virtual egos of the training towns, by seed and then by town; record those that are missing.

    Args:
        towns: of which towns and tiles.
        conditions: names of `CONDITIONS`, of which one is drawn for each ego; by default a bright day.

    Raises:
        InputError: some failed: all arms must have the same data.
    """
    return recorded(
        [EgosPlan(town, seed, EGOS, tuple(conditions)) for seed in seeds for town in towns],
        folder,
        workers,
    )


def test_egos(folder: Path, workers: int) -> list[LogPath]:
    """Return the virtual egos of the held-out town."""
    return recorded([EgosPlan(town, 0, TEST_EGOS, ()) for town in TEST_TOWNS], folder, workers)


def recorded(plans: list[EgosPlan], folder: Path, workers: int) -> list[LogPath]:
    """Return virtual egos, by seed and then by town; record those that are missing.

    Raises:
        InputError: some failed.
    """
    logs, failed = record_egos(plans, folder, FRONT_TELE, workers)
    if failed:
        raise InputError(f"{len(failed)} recordings failed: {next(iter(failed.values()))}")
    return sorted(logs, key=lambda log: _order(log.folder.name))


def _order(name: str) -> tuple[int, str]:
    """Return the seed of a log, then its name."""
    return int(name.split("_seed")[1].split("_")[0]), name


def recipe_of(
    name: str, seed: int, change: Callable[[DriverRecipe], DriverRecipe] = lambda recipe: recipe
) -> DriverRecipe:
    """Return a recipe of a driver with a seed and other changes."""
    recipe = change(DRIVER_RECIPES[name])
    return dataclasses.replace(recipe, see=dataclasses.replace(recipe.see, seed=seed))


def trained(
    recipe: DriverRecipe, logs: Sequence[LogPath], folder: Path, cache: Path, start: Path | None = None
) -> DriverRun:
    """Return a trained driver; train what is missing. `start` is a run to start from."""
    return train_driver(recipe, logs, folder, cache, start)


def sight_figures(run: DriverRun, logs: Sequence[LogPath], cache: Path) -> dict[str, float]:
    """Return how well a driver sees the clips of some logs."""
    clips = PackedClips(open_clips(logs, run.recipe.clips, cache), cache / "packed")
    clips.pack()
    return judge_sight(load_driver(run), clips)


def figures_on_its_way(
    run: DriverRun, drives: Mapping[str, DriveRecord], folder: Path, cache: Path
) -> dict[str, float]:
    """Return what a driver missed on its own way, in all drives and during each kind of scenario.

    A scenario counts for `SCENARIO_S` from its begin.

    Args:
        run: the driver.
        drives: its drives by name.
        folder: folder of the drives, with their logs.
        cache: folder of packed clips.
    """
    dataset = open_clips(find_all_logs([folder]), run.recipe.clips, cache)
    clips = PackedClips(dataset, cache / "packed")
    clips.pack()
    groups = []
    for index in range(len(dataset)):
        log = dataset.logs[dataset.frames_of(index)[0]]
        t_s = (dataset.now_us(index) - int(log.t_us[0])) * 1e-6
        scenarios = drives[log.path.folder.name].scenario_events
        begun = [event for event in scenarios if 0 <= t_s - event.t_s < SCENARIO_S]
        groups.append(begun[-1].what if begun else "no_scenario")
    driver = load_driver(run)
    by_group = judge_sight_by(driver, clips, groups) | {"way": judge_sight(driver, clips)}
    return {
        f"{group}_{name}": figures[name]
        for group, figures in by_group.items()
        for name in ON_ITS_WAY
        if math.isfinite(figures[name])
    }
