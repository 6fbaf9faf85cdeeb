"""Test whether five times as many steps of pre-training make DriveWorld's futures better than persistence.

`foredrive bench driveworld_longer`. Drives, cache and runs are kept in runs/nemo_study/COMMIT, beside those
of driveworld_ablation, whose recipes take 300 steps.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

from benchmarks.common.forecast import forecasting, judge_forecast
from benchmarks.common.study import StudyTowns, record_study, seeded, shortened, work_folder
from foredrive.engine.bench import Benchmark
from foredrive.methods.recipe import Recipe
from foredrive.runs.recipes.known import RECIPES
from foredrive.runs.train.run import train_run

WORK = work_folder(Path("runs/nemo_study"))
TOWNS = StudyTowns()
WHOLE_S = (0.0, 1e6)
STEPS = 1500


def longer(name: str) -> Recipe:
    """Return a recipe of pre-training alone, with more steps of the same schedule."""
    short = shortened(RECIPES[name])
    stage = short.pretrain
    assert stage is not None
    long = dataclasses.replace(
        short.finetune, schedule=dataclasses.replace(stage.schedule, steps=STEPS, warmup_steps=50)
    )
    return forecasting(dataclasses.replace(short, finetune=long), WHOLE_S, short.clips.now_stride_s)


ARMS = {name: longer(name) for name in ("driveworld_town_carried", "driveworld_town")}


def pretrained(name: str) -> Callable[[int], dict[str, float]]:
    def measure(seed: int) -> dict[str, float]:
        logs = record_study(TOWNS, WORK / "towns", workers=2)
        folder = WORK / "runs" / f"{name}_{STEPS}_seed{seed}"
        run = train_run(seeded(ARMS[name], seed), logs.train, folder, WORK / "cache")
        return judge_forecast(run, logs.test, WHOLE_S)

    return measure


BENCHMARK = Benchmark(
    question="Does DriveWorld foresee occupancy better than copies do once it has learned for longer?",
    arms={name: pretrained(name) for name in ARMS},
    seeds=(0,),
    config={
        "recipes": {name: dataclasses.asdict(recipe) for name, recipe in ARMS.items()},
        "towns": dataclasses.asdict(TOWNS),
    },
)
