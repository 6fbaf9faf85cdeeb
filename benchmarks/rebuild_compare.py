"""Compare representations of reconstructed logs, in quality over CPU time: `foredrive bench rebuild-compare`.

Each representation reconstructs PandaSet 002 (raw, in FOREDRIVE_REAL_DATA/pandaset) from the front camera and
the lidar of every second frame, and the drive of `rebuild_town.py`, which is judged at the held-out poses,
2 m and 3 m beside them, and after edits. ARM@kitti reconstructs a drive of 16 s without boxes,
2011_09_26_drive_0005 (raw, in FOREDRIVE_REAL_DATA/kitti_raw). An arm ARM@LENGTH is one point of a curve: a
whole training of a share of the recipe's steps, with its own schedule. CPU time is that of the training
alone, on all threads.

Runs are kept in runs/rebuild_compare, so that an interrupted study continues where it stopped.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.common.measuring import forget_peak
from benchmarks.common.study import kitti_drive, pandaset_log
from benchmarks.rebuild_pandaset import FIGURES
from benchmarks.rebuild_town import DRIVE, judged_town
from foredrive.data import LogPath
from foredrive.engine.bench import Benchmark, study_identity
from foredrive.runs.recipes.reconstruction import (
    ReconstructionRecipe,
    field_tiny,
    gaussians_tiny,
    rescheduled_recipe,
)
from foredrive.runs.reconstruction.reconstruct import reconstruct

ROOT = Path("runs/rebuild_compare")
RECIPES: dict[str, ReconstructionRecipe[Any]] = {"gaussians": gaussians_tiny(), "field": field_tiny()}
"""The smallest recipe of each representation, by the name of its arm."""
LENGTHS = {"eighth": 1 / 8, "third": 1 / 3, "whole": 1.0}
"""Shares of a recipe's steps."""
STEP_COUNTS = ("steps", "shrink_steps", "grow_from", "grow_until", "grow_every")
"""Entries of a schedule that are numbers of steps; a shorter training has as many rounds of growth."""
KITTI_HW = (120, 400)
RENAMED = {"moving.psnr_db": "psnr_driving_db", "moving.nearest.psnr_db": "nearest.psnr_driving_db"}
DECIDED_BY = (
    "benchmarks.rebuild_town",
    "benchmarks.common.reconstructed_towns",
    "foredrive.geometry",
    "foredrive.methods.neurad.losses",
    "foredrive.methods.splatad.losses",
    "foredrive.ops.hash_grid",
    "foredrive.ops.hash_grid_kernels",
    "foredrive.ops.ray_box_kernels",
    "foredrive.ops.ray_boxes",
    "foredrive.ops.splatting",
    "foredrive.ops.splatting_back_kernels",
    "foredrive.ops.splatting_kernels",
    "foredrive.methods.neurad.recipes",
    "foredrive.methods.splatad.recipes",
    "foredrive.methods.reconstruction",
    "foredrive.methods.neurad.training",
    "foredrive.methods.splatad.training",
    "foredrive.methods.splatad.training",
)
CONFIG = {
    "recipes": {arm: dataclasses.asdict(recipe) for arm, recipe in RECIPES.items()},
    "lengths": LENGTHS,
    "drive": dataclasses.asdict(DRIVE),
}
WORK = ROOT / study_identity(CONFIG, DECIDED_BY)


def shortened(recipe: ReconstructionRecipe[Any], share: float) -> ReconstructionRecipe[Any]:
    """Return a recipe of a share of the steps, with as many rounds of growth."""
    schedule = recipe.representation.schedule

    def scaled(value: int | tuple[int, ...]) -> int | tuple[int, ...]:
        if isinstance(value, tuple):
            return tuple(max(round(share * step), 1) for step in value)
        return max(round(share * value), 1)

    counts = {name: scaled(getattr(schedule, name)) for name in STEP_COUNTS if hasattr(schedule, name)}
    return rescheduled_recipe(recipe, **counts)


def on_pandaset(arm: str, length: str) -> Callable[[int], dict[str, float]]:
    """Return the measurement of one point: figures KEY_LENGTH, or KEY for the whole training."""
    end = "" if length == "whole" else f"_{length}"

    def measure(seed: int) -> dict[str, float]:
        recipe = dataclasses.replace(shortened(RECIPES[arm], LENGTHS[length]), cameras=("pcam_f0",))
        log, folder = pandaset_log(ROOT / "pandaset"), WORK / f"{arm}_{length}_seed{seed}"
        return {name + end: value for name, value in reconstructed(recipe, log, folder, seed).items()}

    return measure


def on_kitti(arm: str) -> Callable[[int], dict[str, float]]:
    """Return the measurement of KITTI's drive, with the left colour camera: figures kitti.KEY."""

    def measure(seed: int) -> dict[str, float]:
        recipe = dataclasses.replace(RECIPES[arm], cameras=("image_02",), image_hw=KITTI_HW)
        found = reconstructed(recipe, kitti_drive(ROOT / "kitti"), WORK / f"{arm}_kitti_seed{seed}", seed)
        return {f"kitti.{name}": value for name, value in found.items()}

    return measure


def reconstructed(
    recipe: ReconstructionRecipe[Any], log: LogPath, folder: Path, seed: int
) -> dict[str, float]:
    """Return the figures of a reconstruction, with its peak memory."""
    forget_peak("cpu")
    summary = reconstruct(rescheduled_recipe(recipe, seed=seed), log, folder, ROOT / "cache").summary
    names = (*FIGURES, "peak_memory_gib")
    known = {name: float(value) for name in names if isinstance(value := summary.get(name), float | int)}
    return {RENAMED.get(name, name): value for name, value in known.items()}


def in_town(arm: str) -> Callable[[int], dict[str, float]]:
    """Return the measurement of the views of a reconstructed town: figures VIEWS.KEY."""

    def measure(seed: int) -> dict[str, float]:
        recipe = rescheduled_recipe(RECIPES[arm], seed=seed)
        recipe = dataclasses.replace(
            recipe, cameras=tuple(DRIVE.rig.cameras), moves_m=0.0
        )  # the edited car may stand
        log, folder = DRIVE.recorded(ROOT / "town"), WORK / f"{arm}_town_seed{seed}"
        return judged_town(reconstruct(recipe, log, folder, ROOT / "cache"))

    return measure


BENCHMARK = Benchmark(
    question="Which representation of a reconstructed log is better: for how much CPU time, and from where?",
    arms={f"{arm}@{length}": on_pandaset(arm, length) for length in LENGTHS for arm in RECIPES}
    | {
        f"{arm}@{where}": of(arm) for where, of in (("town", in_town), ("kitti", on_kitti)) for arm in RECIPES
    },
    config=CONFIG,
    decided_by=DECIDED_BY,
)
