"""Reconstruct a real log, and measure the effect of each part of the sensor models.

`foredrive bench rebuild-pandaset`, with the raw PandaSet log in FOREDRIVE_REAL_DATA/pandaset. Training uses
the front camera (all six in one arm) and the lidar of every second frame; the others are for evaluation. Each
arm is a run in runs/rebuild, which continues where it stopped.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.common.benchmark import Benchmark, study_identity
from benchmarks.common.study import RECONSTRUCTED_BY, pandaset_log
from foredrive.runs.recipes.reconstruction import (
    ReconstructionRecipe,
    gaussians_small,
    gaussians_tiny,
    rescheduled_recipe,
)
from foredrive.runs.reconstruction.reconstruct import reconstruct

ROOT = Path("runs/rebuild")
RECIPE = dataclasses.replace(gaussians_tiny(), cameras=("pcam_f0",))
SHORTER = rescheduled_recipe(
    RECIPE, steps=150, shrink_steps=(15,), grow_from=15, grow_until=120, grow_every=15
)
"""Less than a third of the steps, with as much growth: the recipe that arms change in one thing each."""
ARMS: dict[str, ReconstructionRecipe[Any]] = {
    "gaussians_tiny": RECIPE,
    "deformed_people": dataclasses.replace(
        RECIPE,
        representation=dataclasses.replace(
            RECIPE.representation,
            scene=dataclasses.replace(RECIPE.representation.scene, deformed_people=True),
        ),
    ),
    "gaussians_small": dataclasses.replace(gaussians_small(), cameras=RECIPE.cameras),
    "six_cameras": dataclasses.replace(gaussians_small(), cameras=None),
    "shorter": SHORTER,
    "static_only": dataclasses.replace(SHORTER, actors=False),
    "no_rolling_shutter": dataclasses.replace(
        SHORTER,
        representation=dataclasses.replace(
            SHORTER.representation, scene=dataclasses.replace(SHORTER.representation.scene, rolling=False)
        ),
    ),
    "no_drop": dataclasses.replace(
        rescheduled_recipe(
            SHORTER, weights=dataclasses.replace(SHORTER.representation.schedule.weights, drop=0.0)
        ),
        drop=False,
    ),
    "published_lidar_losses": rescheduled_recipe(SHORTER, lidar_losses="published"),
}
CONFIG = {"arms": {arm: dataclasses.asdict(recipe) for arm, recipe in ARMS.items()}}
DECIDED_BY = (*RECONSTRUCTED_BY, "foredrive.methods.splatad.deformation")
WORK = ROOT / study_identity(CONFIG, DECIDED_BY)
FIGURES = (
    *("psnr_db", "ssim", "depth_median_sq_m2", "intensity_rmse", "drop_accuracy", "chamfer_m2"),
    *("minutes", "computing_minutes", "peak_memory_gib", "gaussians", "camera_mp_per_s", "lidar_mrays_per_s"),
    *("nearest.psnr_db", "nearest.ssim", "moving.psnr_db", "moving.nearest.psnr_db"),
    *("people.psnr_db", "vehicles.psnr_db"),
)
"""Metrics: `nearest` compares with the training image nearest in time; `moving` uses the frames in which the
ego vehicle drives.
"""


def reconstructed(arm: str) -> Callable[[int], dict[str, float]]:
    def measure(seed: int) -> dict[str, float]:
        recipe = rescheduled_recipe(ARMS[arm], seed=seed)
        log, folder = pandaset_log(ROOT / "pandaset"), WORK / f"{arm}_seed{seed}"
        summary = reconstruct(recipe, log, folder, ROOT / "cache").summary
        return {name: float(value) for name in FIGURES if isinstance(value := summary.get(name), float | int)}

    return measure


BENCHMARK = Benchmark(
    question="How well is a real log reconstructed, and what is each part of the sensor models worth?",
    arms={arm: reconstructed(arm) for arm in ARMS},
    config=CONFIG,
    decided_by=DECIDED_BY,
)
