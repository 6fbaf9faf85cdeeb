"""Measure NeMo's learning per CPU second: `foredrive bench learning`, many hours on two cores.

The recipe `nemo_town` and the one of commit 9544e57 are pre-trained for the same CPU time and judged on the
test drives of `learning_towns.py`, which are recorded first. Drives, cache and run folders are kept in
runs/learning, so that an interrupted study continues where it stopped.

`nemo_town_egos` and `nemo_town_egos_exact` learn from virtual egos in place of drives: many cars of one
traffic, six key frames of each, with labels from lidar or exact occupancy. All arms are judged by either.

An arm ARM@BUDGET is one point of a curve: a whole training with its own learning rate schedule. Its length is
a number of steps, chosen by `ARM@speed` on one machine: CPU time is that of one process with one thread which
also loads the data.
"""

import dataclasses
import statistics
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch.utils.data import DataLoader

from benchmarks.common.benchmark import Benchmark, study_identity
from benchmarks.common.study import seeded
from benchmarks.learning_towns import DIGEST, TEST_TOWNS, TRAIN_TOWNS, plan_learning, record_missing
from foredrive.data import ClipDataset, LogPath, collate
from foredrive.data.clip_config import OccupancySource
from foredrive.engine.metrics_log import read_metrics
from foredrive.engine.summary import numbers
from foredrive.errors import InputError
from foredrive.methods.recipe import Recipe, rescheduled, with_occupancy_source
from foredrive.runs.drive.recording import EgosPlan, log_of, record_egos
from foredrive.runs.evaluate.predict import AgentPredictor
from foredrive.runs.recipes.known import find_recipe
from foredrive.runs.recipes.world_models import load_recipe
from foredrive.runs.train.run import Run, load_agent, train_run
from foredrive.scene.conditions import CONDITIONS
from foredrive.sensors.rigs import SURROUND
from foredrive.tasks.evaluation.run import evaluate
from foredrive.tasks.occupancy.occupancy_metric import CONTINUED, EGO_COMPENSATED, OccupancyMetric
from foredrive.tasks.occupancy.vehicles_metric import VehicleMetric

ROOT = Path("runs/learning")
DRIVES = ROOT / "drives"
RECIPES: Mapping[str, Recipe[Any, Any]] = {
    "nemo_town": find_recipe("nemo_town"),
    "nemo_town_9544e57": load_recipe(Path(__file__).with_name("nemo_town_9544e57.yaml")),
}
JUDGED_EVERY_S = 1.0
PROBE_STEPS, PROBE_DRIVES = 40, 2
DECIDED_BY = (
    "foredrive.data.label_store",
    "foredrive.data.clips",
    "foredrive.data.labels",
    "foredrive.geometry",
    "foredrive.tasks",
    "foredrive.methods.blocks.averaging",
    "foredrive.methods.blocks.backbone",
    "foredrive.methods.blocks.lifting",
    "foredrive.methods.nemo",
    "foredrive.methods.blocks.plane_context",
    "foredrive.data.augmentation",
    "foredrive.engine.loop",
    "foredrive.engine.parameter_groups",
    "foredrive.methods.blocks.training_rays",
)


@dataclass(frozen=True)
class Budget:
    """CPU seconds of a training, the steps that take them, and the number of drives it may see."""

    cpu_s: float
    drives: int
    steps: Mapping[str, int]
    """By recipe."""
    egos: tuple[int, int] = (0, 0)
    """Seeds of each town, and virtual egos of each seed."""


BUDGETS = {
    "10min": Budget(1200.0, 56, {"nemo_town": 3200, "nemo_town_9544e57": 600}, (2, 140)),
    "30min": Budget(3600.0, 98, {"nemo_town": 9600, "nemo_town_9544e57": 1800}, (4, 200)),
    "1h": Budget(7200.0, 252, {"nemo_town": 19200, "nemo_town_9544e57": 3600}, (4, 240)),
    "best": Budget(28800.0, 252, {"nemo_town": 76800}),
}
"""Minutes and hours of two cores."""
Egos = Literal["none", "lidar", "exact"]
EGO_ARMS: tuple[tuple[Egos, str], ...] = (("lidar", ""), ("exact", "_exact"))
EGO_HW = (96, 160)
"""Size of the images of virtual egos, px: that of the recipe, so that none are resized."""


def pretraining_alone(recipe: Recipe[Any, Any], steps: int) -> Recipe[Any, Any]:
    """Return the recipe with `steps` steps of pre-training and no fine-tuning; the process loads its data."""
    assert recipe.pretrain is not None
    warmup = max(1, round(0.08 * steps))
    pretrain = rescheduled(recipe.pretrain, steps=steps, warmup_steps=warmup, workers=0)
    return dataclasses.replace(
        recipe,
        planner=dataclasses.replace(recipe.planner, ego_mlp=None, path=None),
        path=None,
        pretrain=pretrain,
        finetune=rescheduled(recipe.finetune, steps=0, workers=0),
    )


def logs_of(drives: int) -> tuple[tuple[LogPath, ...], tuple[LogPath, ...]]:
    """Record the drives that are missing; return the first training drives and all test drives."""
    plans = plan_learning()
    test = [plan for plan in plans if plan.town in TEST_TOWNS]
    train = [plan for plan in plans if plan.town not in TEST_TOWNS][:drives]
    record_missing([*test, *train], DRIVES)
    return tuple(log_of(plan, DRIVES) for plan in train), tuple(log_of(plan, DRIVES) for plan in test)


def egos_of(seeds: int, count: int, *, lidar: bool = False) -> tuple[LogPath, ...]:
    """Record the virtual egos that are missing; return them. Every other seed has all conditions."""
    plans = [
        EgosPlan(town, seed, count, tuple(CONDITIONS) if seed % 2 else (), occupancy=True, lidar=lidar)
        for seed in range(seeds)
        for town in TRAIN_TOWNS
    ]
    rig = dataclasses.replace(SURROUND, image_hw=EGO_HW)
    out = ROOT / ("egos_with_lidar" if lidar else "egos")
    logs, failed = record_egos(plans, out, rig, workers=1)
    if failed:
        raise InputError(f"{len(failed)} recordings failed: {next(iter(failed.values()))}")
    return tuple(logs)


def learned(name: str, budget_name: str, egos: Egos = "none") -> Callable[[int], dict[str, float]]:
    """Return an arm that trains a recipe for a budget and judges it in the town of the test drives.

    Args:
        name: of the recipe.
        budget_name: of `BUDGETS`.
        egos: labels of the virtual egos that it learns from; none: it learns from drives.
    """

    def measure(seed: int) -> dict[str, float]:
        torch.set_num_threads(1)
        budget = BUDGETS[budget_name]
        train_logs, test_logs = logs_of(budget.drives if egos == "none" else 0)
        recipe = seeded(pretraining_alone(RECIPES[name], budget.steps[name]), seed)
        folder = ROOT / IDENTITY / f"{name}_{budget_name}_seed{seed}"
        if egos != "none":
            train_logs = egos_of(*budget.egos, lidar=egos == "lidar")
            folder = folder.with_name(f"egos_{egos}_{folder.name}")
            recipe = with_occupancy_source(recipe, "recorded" if egos == "exact" else "lidar")
        run = train_run(recipe, train_logs, folder, ROOT / "cache")
        lines = read_metrics(folder / "pretrain" / "metrics.jsonl")
        cpu_s = sum(float(line["cpu_s"]) for line in lines)
        assert recipe.pretrain is not None
        samples = len(lines) * recipe.pretrain.schedule.batch_size
        return judge(run, test_logs, budget_name) | {
            f"cpu_s_{budget_name}": cpu_s,
            f"samples_{budget_name}": float(samples),
            f"samples_per_cpu_s_{budget_name}": samples / cpu_s,
        }

    return measure


def judge(run: Run, logs: Sequence[LogPath], budget_name: str) -> dict[str, float]:
    """Return the figures by labels from lidar, and `exact_…`, those by exact occupancy."""
    return _judged(run, logs, budget_name, "lidar") | {
        f"exact_{key}": value
        for key, value in _judged(run, logs, budget_name, "recorded").items()
        if key.startswith("iou")
    }


def _judged(run: Run, logs: Sequence[LogPath], budget_name: str, source: OccupancySource) -> dict[str, float]:
    """Return IoU above the ground now and later, ego-compensated persistence, and the recall of cars."""
    clips = dataclasses.replace(
        run.recipe.clips, future_images=False, now_stride_s=JUDGED_EVERY_S, occupancy_source=source
    )
    dataset = ClipDataset(logs, clips, run.cache_dir)
    result = evaluate(
        AgentPredictor(load_agent(run), clips.future_frames, ray_stride=0),
        DataLoader(dataset, batch_size=4, collate_fn=collate),
        frame_dt_s=clips.frame_dt_s,
        metrics=(OccupancyMetric, VehicleMetric),
    )
    summary = numbers(result.summary)
    above = "occupancy.above_ground.iou"
    figures = {"iou": f"{above}_now"} | {
        name: f"vehicles.{name}" for name in ("car_recall_20m", "column_precision_20m")
    }
    for when in ("future_500ms", "future_1s"):
        figures |= {
            f"iou_{when}": f"{above}_{when}",
            f"iou_{when}_persistence": f"{above}_{when}{EGO_COMPENSATED}",
            f"iou_{when}_continued": f"{above}_{when}{CONTINUED}",
        }
    figures |= {"clips": "items", "failed": "failed"}
    return {f"{key}_{budget_name}": summary[name] for key, name in figures.items() if name in summary}


def speed(seed: int) -> dict[str, float]:
    """Measure steps of both recipes in turns on one thread; return samples per CPU second and their ratio."""
    torch.set_num_threads(1)
    train_logs, _ = logs_of(PROBE_DRIVES)
    rate = {}
    for name in RECIPES:
        recipe = seeded(pretraining_alone(RECIPES[name], PROBE_STEPS), seed)
        with tempfile.TemporaryDirectory(prefix="learning_speed_") as folder:
            train_run(recipe, train_logs, Path(folder), ROOT / "cache")
            lines = read_metrics(Path(folder) / "pretrain" / "metrics.jsonl")
        took_s = statistics.mean(float(line["cpu_s"]) for line in lines[PROBE_STEPS // 4 :])
        assert recipe.pretrain is not None
        rate[name] = recipe.pretrain.schedule.batch_size / took_s
    today, before = rate.values()
    return {
        "samples_per_cpu_s": today,
        "samples_per_cpu_s_9544e57": before,
        "samples_per_cpu_s_ratio": today / before,
    }


CONFIG = {
    "recipes": {name: dataclasses.asdict(recipe) for name, recipe in RECIPES.items()},
    "budgets": {name: dataclasses.asdict(budget) for name, budget in BUDGETS.items()},
    "drives": DIGEST,
    "judged_every_s": JUDGED_EVERY_S,
}
IDENTITY = study_identity(CONFIG, DECIDED_BY)
BENCHMARK = Benchmark(
    question="How much does NeMo learn per CPU second, beside the recipe of commit 9544e57?",
    arms={"nemo_town@speed": speed}
    | {
        f"{name}@{budget_name}": learned(name, budget_name)
        for budget_name, budget in BUDGETS.items()
        for name in budget.steps
    }
    | {
        f"nemo_town_egos{suffix}@{budget_name}": learned("nemo_town", budget_name, egos)
        for budget_name, budget in BUDGETS.items()
        if budget.egos[0]
        for egos, suffix in EGO_ARMS
    },
    config=CONFIG,
    decided_by=DECIDED_BY,
)
