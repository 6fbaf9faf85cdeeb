"""Does a planner gain by attending to what task heads find? `foredrive bench planner-attention`, an hour.

World model and heads are those of `task-probes` (the shipped `nemo_town`, heads of seed 0), and stay as they
are. Arms train the planner alone: from the volume alone, with the agents that the heads find, and with agents
and map elements, as VAD and UniAD do. Seeds are the planner's.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks import learning, task_probes
from benchmarks.common.study import StudyLogs, run_arm
from benchmarks.common.world_models import PATH_STRIDE_S
from foredrive.engine.bench import Benchmark, study_identity
from foredrive.methods.planner.path_fit import PathFit
from foredrive.methods.recipe import Recipe, rescheduled
from foredrive.runs.recipes.known import find_recipe
from foredrive.tasks.heads.scene_tokens import Attended

ATTENDED: dict[str, tuple[Attended, ...]] = {
    "volume": (),
    "agents": ("agents",),
    "agents_and_map": ("agents", "map"),
}
STEPS, WARMUP_STEPS = 600, 50
DRIVES = 56
"""Training drives: eight of each town."""
CONFIG = {
    "probes": task_probes.CONFIG,
    "attended": ATTENDED,
    "drives": DRIVES,
    "steps": STEPS,
    "path_stride_s": PATH_STRIDE_S,
}
DECIDED_BY = (
    "foredrive.tasks.planning.scores",
    "foredrive.tasks.planning.protocols",
    "foredrive.methods.planner.planner",
    "foredrive.runs.train.kept_parts",
    "foredrive.methods.planner.path_fit",
    "foredrive.methods.planner.objective",
)
WORK = Path("runs/planner_attention") / study_identity(CONFIG, DECIDED_BY)


def recipe_of(attends: tuple[Attended, ...], seed: int) -> Recipe[Any, Any]:
    """Return `nemo_town` with a planner that attends to outputs of the heads, and nothing else to train."""
    recipe = find_recipe(task_probes.NEMO)
    return dataclasses.replace(
        recipe,
        pretrain=None,
        transfer="frozen",
        planner=dataclasses.replace(recipe.planner, attends=attends),
        path=PathFit(stride_s=PATH_STRIDE_S),
        finetune=rescheduled(recipe.finetune, steps=STEPS, warmup_steps=WARMUP_STEPS, seed=seed),
    )


def attending(name: str) -> Callable[[int], dict[str, float]]:
    """Return an arm."""

    def measure(seed: int) -> dict[str, float]:
        probe, _ = task_probes.probe(task_probes.NEMO, task_probes.shipped, 0)
        logs = StudyLogs(*learning.logs_of(DRIVES))
        folder = WORK / f"{name}_seed{seed}"
        return run_arm(recipe_of(ATTENDED[name], seed), logs, folder, learning.ROOT / "cache", probe.folder)

    return measure


BENCHMARK = Benchmark(
    question="Does a planner gain by attending to the agents and map elements that task heads find?",
    arms={name: attending(name) for name in ATTENDED},
    config=CONFIG,
    decided_by=DECIDED_BY,
)
