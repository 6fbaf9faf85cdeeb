"""The rows of DriveWorld's Tables 1 and 2 at the scale of towns, beside NeMo.

`foredrive bench driveworld_ablation` takes hours. Drives, cache and runs are kept in runs/nemo_study/COMMIT,
beside those of nemo_pretraining. Both world models are trained on the same drives for equally many steps. The
steps are fewer than in their recipes, and in bfloat16, so that a run takes half an hour on one core.
Fine-tuning is as long as pre-training: in the rows of Table 1, all parts but the encoder start fresh.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

from benchmarks.common.study import (
    StudyLogs,
    StudyTowns,
    record_study,
    run_arm,
    seeded,
    share_of,
    shortened,
    work_folder,
)
from foredrive.engine.bench import Benchmark
from foredrive.methods.recipe import Recipe, rescheduled
from foredrive.runs.recipes.known import RECIPES

WORK = work_folder(Path("runs/nemo_study"))
TOWNS = StudyTowns()
FULL, NEMO = "driveworld_town", "nemo_town"
FINETUNING_STEPS = 300


def arm_recipe(name: str) -> Recipe:
    """Return a recipe as it is trained here."""
    recipe = shortened(RECIPES[name])
    return dataclasses.replace(recipe, finetune=rescheduled(recipe.finetune, steps=FINETUNING_STEPS))


ARMS = {name: arm_recipe(name) for name in RECIPES if name.startswith(FULL) or name == NEMO}


def row(name: str) -> Callable[[int], dict[str, float]]:
    """Return an arm that trains one recipe, both stages on all drives."""

    def measure(seed: int) -> dict[str, float]:
        return _arm(name, seed, _logs())

    return measure


def pretrained_on(share: float) -> Callable[[int], dict[str, float]]:
    """Return an arm: the full recipe, pre-trained on a share of the drives and fine-tuned on all."""

    def measure(seed: int) -> dict[str, float]:
        logs, first = _logs(), f"{FULL}_first_{100 * share:.0f}pct"
        _arm(FULL, seed, _part(logs, share), folder=first)
        return _arm(FULL, seed, logs, folder=f"{first}_then_all", start=first)

    return measure


def finetuned_on(share: float) -> Callable[[int], dict[str, float]]:
    """Return an arm: the full recipe, pre-trained on all drives and fine-tuned on a share of them."""

    def measure(seed: int) -> dict[str, float]:
        logs = _logs()
        _arm(FULL, seed, logs)
        return _arm(FULL, seed, _part(logs, share), folder=f"{FULL}_then_{100 * share:.0f}pct", start=FULL)

    return measure


def _logs() -> StudyLogs:
    return record_study(TOWNS, WORK / "towns", workers=2)


def _part(logs: StudyLogs, share: float) -> StudyLogs:
    return dataclasses.replace(logs, train=share_of(logs.train, share))


def _arm(
    name: str, seed: int, logs: StudyLogs, folder: str | None = None, start: str | None = None
) -> dict[str, float]:
    def place(run: str) -> Path:
        return WORK / "runs" / f"{run}_seed{seed}"

    begun = None if start is None else place(start)
    return run_arm(seeded(ARMS[name], seed), logs, place(folder or name), WORK / "cache", begun)


BENCHMARK = Benchmark(
    question="What does each part of DriveWorld add, in the rows of its Tables 1 and 2?",
    arms={name: row(name) for name in ARMS}
    | {"pretrained_50pct": pretrained_on(0.5), "finetuned_75pct": finetuned_on(0.75)},
    config={
        "recipes": {name: dataclasses.asdict(recipe) for name, recipe in ARMS.items()},
        "towns": dataclasses.asdict(TOWNS),
    },
)
