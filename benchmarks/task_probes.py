"""Probe frozen world models with task heads: `foredrive bench task-probes`, hours on two cores.

An arm is a world model. Its weights stay as they are, its volumes are computed once and kept, and the same
heads are trained on them with the same data, steps and seeds. Heads of an arm without any training show what
the heads learn from places and shapes alone. Drives are those of `learning`, which are recorded first.

`nemo_town` is the model that comes with the package. The rows of DriveWorld's Table 1 are pre-trained here,
or taken from the run folders runs/task_probes/RECIPE_seedN if they are there. Each row's own world model is
probed, not its encoder in a fresh model. Volumes and runs are kept in runs/task_probes, where an interrupted
study continues.
"""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import DataLoader

from benchmarks.common.study import seeded
from benchmarks.learning import logs_of
from benchmarks.learning_towns import DIGEST
from foredrive.data import ClipDataset, collate
from foredrive.engine.bench import Benchmark, study_identity
from foredrive.engine.summary import Summary, numbers
from foredrive.methods.recipe import Recipe, rescheduled
from foredrive.runs.evaluate.predict import AgentPredictor
from foredrive.runs.recipes.known import find_recipe
from foredrive.runs.recipes.task_heads import HEADED, INSTANCES, TaskHeadsRecipe, town_heads
from foredrive.runs.shipped import run_folder
from foredrive.runs.train.run import Run, load_agent, open_run, train_run
from foredrive.runs.train.tasks import TrainedHeads, probe_run, train_heads
from foredrive.tasks.evaluation.metrics import METRICS
from foredrive.tasks.evaluation.run import evaluate, parts_needed

ROOT = Path("runs/task_probes")
DRIVES = 14
"""Training drives: two of each town."""
STEPS = 600
"""Steps of the heads, of eight clips each."""
JUDGED_EVERY_S = 0.5
"""Time between judged key frames, s: that of the key frames, because tracks are judged too."""
TASKS = (*HEADED, INSTANCES)
NEMO, DRIVEWORLD = "nemo_town", "driveworld_town"
ROWS = ("occupancy", "rssm", "ssp", "dmb", "mln", "prompts")
"""Rows of Table 1 that pre-train: single frames (3-D), then one part of DriveWorld after the other (4-D)."""
JUDGED_PARTS = frozenset({"agents", "map_lines", "map_layers", "semantics", "instances"})
KEPT = (
    "detection.car_ap", "detection.nuscenes.", "tracking.nuscenes.", "motion.uniad.", "motion.sparsedrive.",
    "map.uniad", "map.maptr.", "map.streammapnet.", "occupancy.",
)  # fmt: skip
"""Beginnings of the keys of a summary that are kept."""
DECIDED_BY = (
    "foredrive.data.label_store",
    "foredrive.data.clips",
    "foredrive.geometry",
    "foredrive.tasks",
    "foredrive.methods.blocks.backbone",
    "foredrive.methods.driveworld",
    "foredrive.methods.blocks.lifting",
    "foredrive.methods.nemo",
    "foredrive.engine.loop",
)


def heads_recipe(seed: int = 0) -> TaskHeadsRecipe:
    """Return the heads of every arm."""
    recipe = town_heads(TASKS)
    return dataclasses.replace(recipe, schedule=dataclasses.replace(recipe.schedule, steps=STEPS, seed=seed))


def world_model_alone(recipe: Recipe[Any, Any]) -> Recipe[Any, Any]:
    """Return the recipe of the world model that a recipe pre-trains, as it is, without fine-tuning."""
    return dataclasses.replace(
        recipe,
        model=recipe.pretrained_model or recipe.model,
        pretrained_model=None,
        transfer="world_model",
        planner=dataclasses.replace(recipe.planner, ego_mlp=None, path=None),
        path=None,
        pretrain=None if recipe.pretrain is None else rescheduled(recipe.pretrain, workers=0),
        finetune=rescheduled(recipe.finetune, steps=0, workers=0),
    )


def shipped(seed: int) -> Run:
    """Return the run of the model that comes with the package; seeds differ in the heads alone."""
    return open_run(run_folder(Path(f"embedded:{NEMO}"), ROOT))


def trained(name: str, *, pretrained: bool = True) -> Callable[[int], Run]:
    """Return a function that pre-trains the world model of a recipe, or opens the run that is there."""

    def begin(seed: int) -> Run:
        recipe = find_recipe(name)
        recipe = recipe if pretrained else dataclasses.replace(recipe, pretrain=None)
        folder = ROOT / f"{name}_seed{seed}" if pretrained else ROOT / f"{name}_untrained_seed{seed}"
        if (folder / "finetune" / "model.safetensors").is_file():
            return open_run(folder)
        logs, _ = logs_of(DRIVES)
        return train_run(seeded(world_model_alone(recipe), seed), logs, folder, ROOT / "cache")

    return begin


def probe(name: str, world_of: Callable[[int], Run], seed: int) -> tuple[Run, TrainedHeads]:
    """Return heads that are trained on a frozen world model, and their run; train what is missing."""
    train_logs, _ = logs_of(DRIVES)
    world = world_of(seed)
    folder = ROOT / IDENTITY / f"{name}_seed{seed}"
    run = probe_run(world.recipe, train_logs, folder, ROOT / "cache", world.folder)
    return run, train_heads(run, heads_recipe(seed))


def probed(name: str, world_of: Callable[[int], Run]) -> Callable[[int], dict[str, float]]:
    """Return an arm that trains heads on a frozen world model and judges them in the test town."""

    def measure(seed: int) -> dict[str, float]:
        torch.set_num_threads(1)
        _, test_logs = logs_of(DRIVES)
        run, found = probe(name, world_of, seed)
        clips = run.recipe.clips
        read = dataclasses.replace(
            clips.judged, future_images=False, now_stride_s=JUDGED_EVERY_S, tasks=found.recipe.truth
        )
        result = evaluate(
            AgentPredictor(load_agent(run), clips.future_frames, ray_stride=0, heads=found.heads),
            DataLoader(ClipDataset(test_logs, read, run.cache_dir), batch_size=4, collate_fn=collate),
            frame_dt_s=clips.frame_dt_s,
            metrics=[metric for metric in METRICS if parts_needed([metric]) & JUDGED_PARTS],
            task_priors=found.priors,
        )
        summary = numbers(result.summary)
        return kept_figures(summary) | {"clips": summary["items"], "failed": summary["failed"]}

    return measure


def kept_figures(summary: Summary) -> dict[str, float]:
    """Return the figures of the tasks, and the baselines' beside them; those that are known."""
    return {key: value for key, value in numbers(summary).items() if key.startswith(KEPT)}


WORLDS: Mapping[str, Callable[[int], Run]] = {
    NEMO: shipped,
    f"{NEMO}_untrained": trained(NEMO, pretrained=False),
    DRIVEWORLD: trained(DRIVEWORLD),
    f"{DRIVEWORLD}_untrained": trained(DRIVEWORLD, pretrained=False),
    **{f"{DRIVEWORLD}_{row}": trained(f"{DRIVEWORLD}_{row}") for row in ROWS},
}
CONFIG = {
    "heads": dataclasses.asdict(heads_recipe()),
    "recipes": {name: dataclasses.asdict(find_recipe(name)) for name in (NEMO, DRIVEWORLD)},
    "training_drives": DRIVES,
    "drives": DIGEST,
    "judged_every_s": JUDGED_EVERY_S,
}
IDENTITY = study_identity(CONFIG, DECIDED_BY)
BENCHMARK = Benchmark(
    question="What do heads of the six tasks learn on a frozen world model, and what does its training add?",
    arms={name: probed(name, world) for name, world in WORLDS.items()},
    config=CONFIG,
    decided_by=DECIDED_BY,
)
