"""Does a planner gain by attending to what task heads find? `foredrive bench planner-attention`, an hour.

World model and heads are those of `task-probes` (`nemo_town`, seed 0), and stay as they are. Arms train the
planner alone, as long as `nemo-ablation` fine-tunes: from the volume alone, with the agents that the heads
find, and with agents and map elements, as VAD and UniAD do. Seeds are the planner's.
"""

import dataclasses
import functools
from typing import Any

from benchmarks import task_probes
from benchmarks.common.benchmark import Benchmark, study_identity
from benchmarks.common.study import run_arm
from benchmarks.common.world_models import DECIDED_BY, ROOT, of_the_study, study_logs
from foredrive.heads.scene_tokens import Attended
from foredrive.methods.recipe import Recipe

WORLD = "nemo_town"
ATTENDED: dict[str, tuple[Attended, ...]] = {
    "volume": (),
    "agents": ("agents",),
    "agents_and_map": ("agents", "map"),
}
CONFIG = {"probes": task_probes.CONFIG, "attended": ATTENDED}
IDENTITY = study_identity(CONFIG, DECIDED_BY)


def recipe_of(attends: tuple[Attended, ...], seed: int) -> Recipe[Any, Any]:
    """Return `nemo_town` with a planner that attends to outputs of the heads, and nothing else to train."""
    recipe = of_the_study(WORLD, seed, 0)
    planner = dataclasses.replace(recipe.planner, attends=attends)
    return dataclasses.replace(recipe, pretrain=None, transfer="frozen", planner=planner)


def attending(name: str, seed: int) -> dict[str, float]:
    """Train a planner and return its figures."""
    probe, _ = task_probes.probe(WORLD, task_probes.trained(WORLD, 0), 0)
    folder = ROOT / "planner_attention" / IDENTITY / f"{name}_seed{seed}"
    return run_arm(recipe_of(ATTENDED[name], seed), study_logs(), folder, task_probes.CACHE, probe.folder)


BENCHMARK = Benchmark(
    question="Does a planner gain by attending to the agents and map elements that task heads find?",
    arms={name: functools.partial(attending, name) for name in ATTENDED},
    config=CONFIG,
    decided_by=DECIDED_BY,
)
