"""Occupancy forecasts compared with persistence, in towns and on a real log.

`foredrive bench driveworld_forecast`, with the raw PandaSet log in FOREDRIVE_REAL_DATA/pandaset. Drives,
cache and runs are kept in runs/nemo_study/COMMIT, beside those of nemo_pretraining and driveworld_ablation.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

from benchmarks.common.forecast import forecasting, judge_forecast
from benchmarks.common.study import (
    StudyTowns,
    pandaset_log,
    record_study,
    run_arm,
    seeded,
    shortened,
    work_folder,
)
from foredrive.engine.bench import Benchmark
from foredrive.runs.recipes.known import RECIPES
from foredrive.runs.train.run import train_run

WORK = work_folder(Path("runs/nemo_study"))
TOWNS = StudyTowns()
DRIVEWORLD, CARRIED, NEMO = "driveworld_town", "driveworld_town_carried", "nemo_town"
RECIPE = {name: shortened(RECIPES[name]) for name in (DRIVEWORLD, CARRIED, NEMO)}
"""Recipes as in driveworld_ablation, so that its runs are used again."""
LEARNED_S, STRIDE_S = 3.95, 0.1
"""End of the training part, s (the first 40 frames of a log at 10 Hz), and time between nows, s (every
frame).
"""
FRAMES = 2
"""Number of imagined frames, 1 s: the log has 56 frames, and no clip of 2 s begins after the first 40."""
WHOLE_S = 1e6


def in_towns(name: str) -> Callable[[int], dict[str, float]]:
    """Return an arm that evaluates an unchanged recipe on the drives of Town05."""

    def measure(seed: int) -> dict[str, float]:
        logs = record_study(TOWNS, WORK / "towns", workers=2)
        figures = run_arm(seeded(RECIPE[name], seed), logs, _folder(name, seed), WORK / "cache")
        return {key: value for key, value in figures.items() if "l2" not in key and "collision" not in key}

    return measure


def on_pandaset(name: str, *, pretrained: bool) -> Callable[[int], dict[str, float]]:
    """Return an arm that trains a recipe's world model on the first frames of the real log, and tests on the
    rest.
    """

    def measure(seed: int) -> dict[str, float]:
        log, recipe = pandaset_log(WORK / "pandaset"), seeded(RECIPE[name], seed)
        start = None
        if pretrained:
            logs = record_study(TOWNS, WORK / "towns", workers=2)
            start = train_run(recipe, logs.train, _folder(name, seed), WORK / "cache").folder
        arm = f"pandaset_{name}_{'pretrained' if pretrained else 'scratch'}"
        learned = forecasting(recipe, (0.0, LEARNED_S), STRIDE_S, FRAMES)
        run = train_run(learned, [log], _folder(arm, seed), WORK / "cache", start)
        return judge_forecast(run, [log], (LEARNED_S, WHOLE_S))

    return measure


def _folder(arm: str, seed: int) -> Path:
    return WORK / "runs" / f"{arm}_seed{seed}"


BENCHMARK = Benchmark(
    question="Does DriveWorld foresee occupancy better than copies of the present do?",
    arms={f"towns_{name}": in_towns(name) for name in RECIPE}
    | {
        f"pandaset_{name}_{begun}": on_pandaset(name, pretrained=begun == "pretrained")
        for name in RECIPE
        for begun in ("pretrained", "scratch")
    },
    config={
        "recipes": {name: dataclasses.asdict(recipe) for name, recipe in RECIPE.items()},
        "towns": dataclasses.asdict(TOWNS),
        "learned_s": LEARNED_S,
        "stride_s": STRIDE_S,
        "pandaset_frames": FRAMES,
    },
)
