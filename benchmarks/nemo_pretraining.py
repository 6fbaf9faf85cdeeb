"""Effect of NeMo's self-supervised pre-training: `foredrive bench nemo_pretraining`, hours on two cores.

Drives, the cache of labels, and a run folder for every arm and seed are kept in runs/nemo_study/COMMIT, so
that an interrupted study continues where it stopped.
"""

import dataclasses
import statistics
from collections.abc import Callable
from pathlib import Path

from benchmarks.common.study import (
    StudyLogs,
    StudyTowns,
    occupancy_alone,
    record_study,
    run_arm,
    seeded,
    share_of,
    work_folder,
)
from foredrive.evaluation.bench import Benchmark
from foredrive.models.averaging import AveragingConfig
from foredrive.recipes import find_recipe
from foredrive.recipes.config import Recipe
from foredrive.runs.train.run import train_run
from foredrive.training import read_metrics

WORK = work_folder(Path("runs/nemo_study"))
SHARES = (0.1, 0.3, 1.0)
TOWNS = StudyTowns()
RECIPE = "nemo_town"
AVERAGING = AveragingConfig(hidden=128)
OCCUPANCY_STEPS, PROBE_STEPS = 300, 30


def _logs() -> StudyLogs:
    return record_study(TOWNS, WORK / "towns", workers=2)


def _folder(arm: str, seed: int) -> Path:
    return WORK / "runs" / f"{arm}_seed{seed}"


def planned(pretrained: bool, share: float) -> Callable[[int], dict[str, float]]:
    """Return an arm: the full recipe, fine-tuned on a share of the drives, pre-trained on all or on none."""

    def measure(seed: int) -> dict[str, float]:
        logs, recipe = _logs(), seeded(find_recipe(RECIPE), seed)
        few = dataclasses.replace(logs, train=share_of(logs.train, share))
        folder = _folder(_name(pretrained, share), seed)
        if not pretrained:
            recipe = dataclasses.replace(recipe, pretrain=None)
            return run_arm(recipe, few, folder, WORK / "cache")
        whole = _folder(RECIPE, seed)
        figures = run_arm(recipe, logs, whole, WORK / "cache")
        return figures if share == 1.0 else run_arm(recipe, few, folder, WORK / "cache", start=whole)

    return measure


def _name(pretrained: bool, share: float) -> str:
    return f"{'pretrained' if pretrained else 'scratch'}_{100 * share:.0f}pct"


def occupancy(seed: int) -> dict[str, float]:
    """Train NeMo's encoder on the present occupancy alone."""
    recipe = _of_steps(occupancy_alone(seeded(find_recipe(RECIPE), seed)), OCCUPANCY_STEPS)
    return _seen(run_arm(recipe, _logs(), _folder("occupancy", seed), WORK / "cache"))


def occupancy_averaging(seed: int) -> dict[str, float]:
    """Train the averaging encoder on the same, for the same time as NeMo's encoder.

    The number of steps follows from step times measured in turns.
    """
    nemo = seeded(find_recipe(RECIPE), seed)
    averaging = dataclasses.replace(nemo, model=dataclasses.replace(nemo.model, encoder=AVERAGING))
    logs, took_s = _logs(), {}
    for name, recipe in (("nemo", nemo), ("averaging", averaging)):
        probe = WORK / "probes" / f"{name}_seed{seed}"
        train_run(_of_steps(occupancy_alone(recipe), PROBE_STEPS), logs.train, probe, WORK / "cache")
        lines = read_metrics(probe / "finetune" / "metrics.jsonl")
        took_s[name] = statistics.median(line["step_s"] for line in lines)
    steps = round(OCCUPANCY_STEPS * took_s["nemo"] / took_s["averaging"])
    folder = _folder("occupancy_averaging", seed)
    figures = run_arm(_of_steps(occupancy_alone(averaging), steps), logs, folder, WORK / "cache")
    return _seen(figures) | {"steps": float(steps)}


def _of_steps(recipe: Recipe, steps: int) -> Recipe:
    schedule = dataclasses.replace(recipe.finetune.schedule, steps=steps)
    return dataclasses.replace(recipe, finetune=dataclasses.replace(recipe.finetune, schedule=schedule))


def _seen(figures: dict[str, float]) -> dict[str, float]:
    """Remove the metrics of the untrained planner."""
    return {name: value for name, value in figures.items() if "l2" not in name and "collision" not in name}


BENCHMARK = Benchmark(
    question="Does pre-training help NeMo to see and to plan in a town it has not seen?",
    arms={
        _name(pretrained, share): planned(pretrained, share)
        for pretrained in (True, False)
        for share in SHARES
    }
    | {"occupancy": occupancy, "occupancy_averaging": occupancy_averaging},
    config={
        "recipe": dataclasses.asdict(find_recipe(RECIPE)),
        "averaging": dataclasses.asdict(AVERAGING),
        "towns": dataclasses.asdict(TOWNS),
    },
)
