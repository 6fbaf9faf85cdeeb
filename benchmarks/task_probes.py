"""Heads of the six tasks on world models: `foredrive bench task-probes`, hours on two cores.

A probe keeps the world model as it is: its volumes are computed once and kept, and the same heads are trained
on them with the same clips, steps and seeds. Heads on a world model without any training show what they learn
from places and shapes alone. In a joint arm they are trained together with the world model, on as many clips.
World models are the pre-trainings of nemo_ablation and driveworld_ablation (common/world_models.py); heads
learn from a part of their virtual egos, whose volumes fit on a disk. Runs are kept in runs/world_models.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch.utils.data import DataLoader

from benchmarks import learning
from benchmarks.common.benchmark import Benchmark, study_identity
from benchmarks.common.study import seeded
from benchmarks.common.world_models import (
    DECIDED_BY,
    ROOT,
    TASKS_DECIDED_BY,
    config_of,
    of_the_study,
    pretrained,
    study_logs,
)
from foredrive.data import ClipDataset, LogPath, collate
from foredrive.engine.summary import Summary, numbers
from foredrive.methods.recipe import Recipe, rescheduled
from foredrive.runs.evaluate.predict import AgentPredictor
from foredrive.runs.recipes.task_heads import (
    HEADED,
    INSTANCES,
    TaskHeadsRecipe,
    town_heads,
    with_joint_heads,
)
from foredrive.runs.train.run import Run, load_agent, train_run
from foredrive.runs.train.tasks import TrainedHeads, load_heads, probe_run, train_heads
from foredrive.tasks.evaluation.metrics import METRICS
from foredrive.tasks.evaluation.run import evaluate, parts_needed

SHARE = 0.2
"""Part of the egos that heads learn from."""
STEPS, BATCH = 1200, 8
"""Steps of the heads, and clips of a step."""
JUDGED_EVERY_S = 0.5
"""Time between judged key frames, s: that of the key frames, because tracks are judged too."""
TASKS = (*HEADED, INSTANCES)
WORLDS = ("nemo_town", "driveworld_town")
JUDGED_PARTS = frozenset({"agents", "map_lines", "map_layers", "semantics", "instances"})
KEPT = (
    "detection.car_ap", "detection.nuscenes.", "tracking.nuscenes.", "tracking.car_", "motion.uniad.",
    "motion.sparsedrive.", "map.uniad", "map.maptr.", "map.streammapnet.", "occupancy.",
)  # fmt: skip
"""Beginnings of the keys of a summary that are kept."""


def heads_recipe(seed: int = 0) -> TaskHeadsRecipe:
    """Return the heads of every arm."""
    recipe = town_heads(TASKS)
    schedule = dataclasses.replace(recipe.schedule, steps=STEPS, batch_size=BATCH, seed=seed)
    return dataclasses.replace(recipe, schedule=schedule)


def untrained(name: str, seed: int) -> Run:
    """Return a run of fresh weights."""
    recipe = of_the_study(name, seed, seed)
    assert recipe.pretrain is not None
    alone = seeded(learning.pretraining_alone(dataclasses.replace(recipe, pretrained_model=None), 0), seed)
    return train_run(alone, study_logs(SHARE).train, ROOT / "untrained" / f"{name}_seed{seed}", CACHE)


def trained(name: str, seed: int) -> Run:
    """Return the run of the recipe's pre-training."""
    return pretrained(of_the_study(name, seed, seed))


def probe(name: str, world: Run, seed: int) -> tuple[Run, TrainedHeads]:
    """Return heads that are trained on a frozen world model, and their run; train what is missing.

    Args:
        name: of the arm.
        world: run of the world model.
        seed: of the heads.
    """
    folder = ROOT / "task_probes" / IDENTITY / f"{name}_seed{seed}"
    run = probe_run(world.recipe, study_logs(SHARE).train, folder, CACHE, world.folder)
    return run, train_heads(run, heads_recipe(seed))


def probed(name: str, world_of: Callable[[str, int], Run], arm: str, seed: int) -> dict[str, float]:
    """Probe a world model, and return the figures of the heads in the test town."""
    return judged(*probe(arm, world_of(name, seed), seed), study_logs().test)


def joint(name: str, seed: int) -> dict[str, float]:
    """Train heads and world model together, without a planner, and return the figures of the heads."""
    recipe = joint_recipe(of_the_study(name, seed, seed), heads_recipe(seed))
    start, folder = trained(name, seed).folder, ROOT / "task_probes" / IDENTITY / f"{name}_joint_seed{seed}"
    run = train_run(recipe, study_logs(SHARE).train, folder, CACHE, start)
    heads = load_heads(run)
    assert heads is not None
    return judged(run, heads, study_logs().test)


def joint_recipe(recipe: Recipe[Any, Any], heads: TaskHeadsRecipe) -> Recipe[Any, Any]:
    """Return a recipe that goes on with its pre-training, together with heads, for as long as they learn."""
    assert recipe.pretrain is not None
    schedule = dataclasses.replace(
        recipe.finetune.schedule, steps=heads.schedule.steps, batch_size=heads.schedule.batch_size
    )
    recipe = dataclasses.replace(
        recipe,
        planner=dataclasses.replace(recipe.planner, ego_mlp=None, path=None),
        path=None,
        finetune=rescheduled(dataclasses.replace(recipe.pretrain, schedule=schedule), workers=0),
        clips=dataclasses.replace(recipe.clips, now_stride_s=heads.now_stride_s),
    )
    return with_joint_heads(recipe, heads)


def judged(run: Run, heads: TrainedHeads, logs: Sequence[LogPath]) -> dict[str, float]:
    """Return the figures of heads on some logs, and those of the baselines."""
    torch.set_num_threads(1)
    clips = run.recipe.clips
    read = dataclasses.replace(
        clips, future_images=False, now_stride_s=JUDGED_EVERY_S, tasks=heads.recipe.truth
    )
    result = evaluate(
        AgentPredictor(load_agent(run), clips.future_frames, ray_stride=0, heads=heads.heads),
        DataLoader(ClipDataset(logs, read, run.cache_dir), batch_size=4, collate_fn=collate),
        frame_dt_s=clips.frame_dt_s,
        metrics=[metric for metric in METRICS if parts_needed([metric]) & JUDGED_PARTS],
        task_priors=heads.priors,
    )
    summary = numbers(result.summary)
    return kept_figures(summary) | {"clips": summary["items"], "failed": summary["failed"]}


def kept_figures(summary: Summary) -> dict[str, float]:
    """Return the figures of the tasks, and the baselines' beside them; those that are known."""
    return {key: value for key, value in numbers(summary).items() if key.startswith(KEPT)}


CACHE = learning.ROOT / "cache"
CONFIG = {
    name: {**config_of(name), "heads": dataclasses.asdict(heads_recipe()), "share": SHARE} for name in WORLDS
} | {"judged_every_s": JUDGED_EVERY_S}
IDENTITY = study_identity(CONFIG, (*DECIDED_BY, *TASKS_DECIDED_BY))
ARMS: Mapping[str, Callable[[int], Mapping[str, float]]] = {
    **{name: functools.partial(probed, name, trained, name) for name in WORLDS},
    **{
        f"{name}_untrained": functools.partial(probed, name, untrained, f"{name}_untrained")
        for name in WORLDS
    },
    **{f"{name}_joint": functools.partial(joint, name) for name in WORLDS},
}
BENCHMARK = Benchmark(
    question="What do heads of the six tasks learn on a world model, frozen and with it?",
    arms=ARMS,
    config=CONFIG,
    decided_by=(*DECIDED_BY, *TASKS_DECIDED_BY),
)
