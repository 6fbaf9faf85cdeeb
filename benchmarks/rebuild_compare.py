"""Compare representations of reconstructed logs, by their whole recipes: `foredrive bench rebuild-compare`.

Each recipe reconstructs, from the front camera and the lidar of every second frame:

- PandaSet 002 (raw, in FOREDRIVE_REAL_DATA/pandaset). Beside the path, where there are no images, the lidar
  points in the colours of the held-out images are the truth (`points_aside`);
- drives of two towns, judged against the town's own camera and lidar at the held-out poses, beside them and
  turned;
- a drive of 16 s without boxes, 2011_09_26_drive_0005 (raw, in FOREDRIVE_REAL_DATA/kitti_raw).

`computing_minutes` are those of the training alone, on all threads. Runs are kept in runs/rebuild_compare, so
that an interrupted study continues where it stopped.
"""

import dataclasses
import functools
import math
from pathlib import Path
from statistics import fmean
from typing import Any

from benchmarks.common.benchmark import Benchmark, study_identity
from benchmarks.common.measuring import forget_peak
from benchmarks.common.points_aside import aside_figures
from benchmarks.common.reconstructed_towns import TownDrive, TownTruth
from benchmarks.common.study import RECONSTRUCTED_BY, kitti_drive, pandaset_log
from benchmarks.rebuild_pandaset import FIGURES
from foredrive.data import LogPath
from foredrive.methods.reconstruction.edits import ShiftEgo
from foredrive.methods.reconstruction.evaluation import evaluate_cameras, evaluate_sweeps
from foredrive.runs.recipes.reconstruction import (
    ReconstructionRecipe,
    field_tiny,
    gaussians_small,
    gaussians_tiny,
    rescheduled_recipe,
)
from foredrive.runs.reconstruction.reconstruct import Reconstruction, reconstruct

ROOT = Path("runs/rebuild_compare")
RECIPES: dict[str, ReconstructionRecipe[Any]] = {
    recipe.name: recipe for recipe in (gaussians_tiny(), gaussians_small(), field_tiny())
}
TOWNS = {drive.town: drive for drive in (TownDrive("Town10HD", seed=3), TownDrive("Town03", seed=4))}
ASIDE_M = (1.0, 2.0, 3.0)
TURNED_DEG = 5.0
JUDGED_EVERY = 8
"""Every eighth frame from the second on is judged: a quarter of the held-out frames."""
VIEWS = {
    **{
        f"{metres:g}m_aside": [ShiftEgo((0.0, metres, 0.0)), ShiftEgo((0.0, -metres, 0.0))]
        for metres in ASIDE_M
    },
    f"{TURNED_DEG:g}deg": [
        ShiftEgo((0.0, 0.0, 0.0), math.radians(TURNED_DEG)),
        ShiftEgo((0.0, 0.0, 0.0), -math.radians(TURNED_DEG)),
    ],
}
"""Views beside the logged ones, to the left and to the right; figures are means of both."""
KITTI_HW = (120, 400)
RENAMED = {"moving.psnr_db": "psnr_driving_db", "moving.nearest.psnr_db": "nearest.psnr_driving_db"}
DECIDED_BY = (
    "benchmarks.common.points_aside",
    "benchmarks.common.reconstructed_towns",
    *RECONSTRUCTED_BY,
)
CONFIG = {
    "recipes": {arm: dataclasses.asdict(recipe) for arm, recipe in RECIPES.items()},
    "drives": [dataclasses.asdict(drive) for drive in TOWNS.values()],
    "aside_m": ASIDE_M,
    "turned_deg": TURNED_DEG,
}
WORK = ROOT / study_identity(CONFIG, DECIDED_BY)


def on_pandaset(arm: str, seed: int) -> dict[str, float]:
    """Return the figures of PandaSet 002, with those of `aside_figures`."""
    recipe = dataclasses.replace(RECIPES[arm], cameras=("pcam_f0",))
    run, figures = reconstructed(recipe, pandaset_log(ROOT / "pandaset"), f"{arm}_pandaset", seed)
    return figures | aside_figures(run.scene, run.held_out, ASIDE_M)


def on_kitti(arm: str, seed: int) -> dict[str, float]:
    """Return the figures of KITTI's drive, with the left colour camera."""
    recipe = dataclasses.replace(RECIPES[arm], cameras=("image_02",), image_hw=KITTI_HW)
    return reconstructed(recipe, kitti_drive(ROOT / "kitti"), f"{arm}_kitti", seed)[1]


def in_town(arm: str, town: str, seed: int) -> dict[str, float]:
    """Return the figures of a town, with `psnr_VIEW_db` and `depth_median_sq_VIEW_m2` of `VIEWS`."""
    drive = TOWNS[town]
    recipe = dataclasses.replace(RECIPES[arm], cameras=tuple(drive.rig.cameras))
    run, figures = reconstructed(recipe, drive.recorded(ROOT / "towns"), f"{arm}_{town}", seed)
    truth = truth_of(town)
    for name, edits in VIEWS.items():
        images, depths = [], []
        for edit in edits:
            views = [truth.seen(frame, (edit,)) for frame in range(1, drive.frames, JUDGED_EVERY)]
            cameras = [camera for view in views for camera in view.cameras]
            images.append(evaluate_cameras(run.scene, cameras, run.train.cameras)["psnr_db"])
            sweeps = evaluate_sweeps(run.scene, [view.sweep for view in views])
            depths.append(sweeps["depth_median_sq_m2"])
        figures |= {f"psnr_{name}_db": fmean(images), f"depth_median_sq_{name}_m2": fmean(depths)}
    return figures


@functools.lru_cache(maxsize=1)
def truth_of(town: str) -> TownTruth:
    """Return the town of a drive; the next one replaces it."""
    return TownTruth(TOWNS[town])


def reconstructed(
    recipe: ReconstructionRecipe[Any], log: LogPath, name: str, seed: int
) -> tuple[Reconstruction, dict[str, float]]:
    """Return a reconstruction and its figures, with its peak memory."""
    forget_peak("cpu")
    run = reconstruct(rescheduled_recipe(recipe, seed=seed), log, WORK / f"{name}_seed{seed}", ROOT / "cache")
    values = {key: run.summary.get(key) for key in (*FIGURES, "peak_memory_gib")}
    return run, {
        RENAMED.get(key, key): float(value) for key, value in values.items() if isinstance(value, float | int)
    }


BENCHMARK = Benchmark(
    question="Which representation of a reconstructed log is better: for how much CPU time, and from where?",
    arms={
        **{f"pandaset_{arm}": functools.partial(on_pandaset, arm) for arm in RECIPES},
        **{f"{town}_{arm}": functools.partial(in_town, arm, town) for town in TOWNS for arm in RECIPES},
        **{f"kitti_{arm}": functools.partial(on_kitti, arm) for arm in RECIPES},
    },
    config=CONFIG,
    decided_by=DECIDED_BY,
)
