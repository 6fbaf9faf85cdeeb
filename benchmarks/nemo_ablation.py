"""The rows of NeMo's Tables 1 and 3 at the scale of towns: `foredrive bench nemo_ablation` takes hours.

Drives, cache and runs are kept in runs/nemo_study/COMMIT, beside those of nemo_pretraining.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

from benchmarks.common.study import StudyTowns, record_study, run_arm, seeded, work_folder
from foredrive.evaluation.bench import Benchmark
from foredrive.recipes import RECIPES

WORK = work_folder(Path("runs/nemo_study"))
TOWNS = StudyTowns()
ROWS = [name for name in RECIPES if name.startswith("nemo_town")]


def row(name: str) -> Callable[[int], dict[str, float]]:
    """Return an arm that trains a recipe on all drives; rows with the same pre-training share that stage."""

    def measure(seed: int) -> dict[str, float]:
        logs = record_study(TOWNS, WORK / "towns", workers=2)
        recipe, first = seeded(RECIPES[name], seed), seeded(RECIPES[_alike(name)], seed)
        start = WORK / "runs" / f"{first.name}_seed{seed}"
        if name == first.name or recipe.pretrain is None:
            return run_arm(recipe, logs, WORK / "runs" / f"{name}_seed{seed}", WORK / "cache")
        run_arm(first, logs, start, WORK / "cache")
        return run_arm(recipe, logs, WORK / "runs" / f"{name}_seed{seed}", WORK / "cache", start)

    return measure


def _alike(name: str) -> str:
    """Return the first row with the same pre-training of the same world model."""

    def world(row: str) -> tuple[object, ...]:
        return RECIPES[row].pretrain, RECIPES[row].model, RECIPES[row].clips

    return next(row for row in ROWS if world(row) == world(name))


BENCHMARK = Benchmark(
    question="What does each part of NeMo add, in the rows of its Tables 1 and 3?",
    arms={name: row(name) for name in ROWS},
    config={
        "recipes": {name: dataclasses.asdict(RECIPES[name]) for name in ROWS},
        "towns": dataclasses.asdict(TOWNS),
    },
)
