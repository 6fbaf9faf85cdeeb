"""The real-to-sim gap: what the shipped NeMo sees and plans on recorded and on rendered images of one log.

`foredrive bench real-to-sim`, with the raw PandaSet log in FOREDRIVE_REAL_DATA/pandaset. Six cameras and
the lidar are reconstructed from every second frame; figures are of the other frames (`foredrive evaluate
--in`). A seed is another drive of Town05 and another seed of the reconstruction; of PandaSet the
reconstruction alone. Runs are kept in runs/real_to_sim/COMMIT, where an interrupted study continues.
"""

import dataclasses
import functools
from pathlib import Path

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.reconstructed_towns import TownDrive
from benchmarks.common.study import pandaset_log, work_folder
from foredrive.data import LogPath
from foredrive.engine.summary import numbers
from foredrive.runs.evaluate.real_to_sim_gap import measure_gap
from foredrive.runs.recipes.reconstruction import gaussians_tiny, rescheduled_recipe
from foredrive.runs.reconstruction.reconstruct import reconstruct
from foredrive.runs.shipped import run_folder
from foredrive.runs.train.run import open_run
from foredrive.sensors.rigs import SURROUND

WORK = work_folder(Path("runs/real_to_sim"))
MODEL = "embedded:nemo_town"
TOWN_HW, REAL_HW = (96, 160), (108, 192)
"""Size of the images: of the model, and at least that in the camera's own proportions."""
DRIVE = TownDrive("Town05", seed=101, seconds=10.0, rig=SURROUND.of_size(TOWN_HW))
RECIPE = dataclasses.replace(gaussians_tiny(), cameras=None)


def town(seed: int) -> tuple[LogPath, tuple[int, int]]:
    """Return a drive of the test town and the size of its images."""
    drive = dataclasses.replace(DRIVE, seed=DRIVE.seed + seed)
    return drive.recorded(WORK / f"town_seed{seed}"), TOWN_HW


def pandaset(_: int) -> tuple[LogPath, tuple[int, int]]:
    """Return the real log and the size to which its images are read."""
    return pandaset_log(WORK / "pandaset"), REAL_HW


LOGS = {"town05": town, "pandaset": pandaset}


def gap(name: str, seed: int) -> dict[str, float]:
    """Reconstruct a log; return the figures of `measure_gap`, and what the reconstruction took."""
    log, image_hw = LOGS[name](seed)
    recipe = rescheduled_recipe(dataclasses.replace(RECIPE, image_hw=image_hw), seed=seed)
    folder = WORK / f"{name}_seed{seed}"
    summary = reconstruct(recipe, log, folder, WORK / "cache").summary
    figures = measure_gap(open_run(run_folder(Path(MODEL), WORK)), folder, folder)
    took = {key: summary[key] for key in ("minutes", "computing_minutes", "gaussians", "peak_memory_gib")}
    kept = {**figures, **{f"rebuilt.{key}": value for key, value in took.items()}}
    return numbers(kept)


BENCHMARK = Benchmark(
    question="How far are predictions and plans on rendered images from those on the recorded ones?",
    arms={name: functools.partial(gap, name) for name in LOGS},
    config={"model": MODEL, "drive": dataclasses.asdict(DRIVE), "recipe": dataclasses.asdict(RECIPE)},
)
