"""NeMo on a grid that holds what is judged, with heads: `foredrive bench wide-grid`, two hours of a core.

The recipe `nemo_wide` goes on from its pre-training (benchmarks/nemo_wide) together with heads of the six
tasks. It learns from virtual egos of planner_reads in six towns, with exact occupancy and flow, and is judged
by those of Town03 and Town05, which nothing was trained in. Its run is kept in runs/wide_grid.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import DataLoader

from benchmarks.common.benchmark import Benchmark, study_identity
from benchmarks.common.study import seeded
from benchmarks.common.world_models import LEARNED_BY, LEARNED_BY_BOTH, TASKS_DECIDED_BY
from benchmarks.planner_reads import TEST_SEEDS, TEST_TOWNS, TRAIN_SEEDS, TRAIN_TOWNS, recorded
from benchmarks.task_probes import JUDGED_EVERY_S, heads_recipe, joint_recipe, judged
from foredrive.data import ClipDataset, collate
from foredrive.engine.summary import numbers
from foredrive.methods.nemo.sampling import ImaginationSampling
from foredrive.methods.recipe import Recipe, rescheduled
from foredrive.runs.evaluate.predict import AgentPredictor
from foredrive.runs.recipes.known import find_recipe
from foredrive.runs.train.run import Run, load_agent, train_run
from foredrive.runs.train.tasks import load_heads
from foredrive.tasks.evaluation.run import evaluate
from foredrive.tasks.occupancy.occupancy_metric import OccupancyMetric

ROOT = Path("runs/wide_grid")
START = Path(__file__).with_name("nemo_wide")
"""Weights of the recipe of that name, after 18,400 clips."""
STEPS, LR = 1450, 2e-3
"""Steps of eight clips, and their learning rate: an hour and a half of a core."""
SEEDS, JUDGED_SEEDS = TRAIN_SEEDS[:2], TEST_SEEDS[:2]
"""Seeds of the traffic to learn from and to judge by, of 80 egos in each town."""
FUTURES = ("occupancy.above_ground.", "occupancy.moving.", "occupancy.standing.")
"""Beginnings of the keys of a summary that are kept of the futures."""


@functools.cache
def trained(seed: int) -> Run:
    """Return the run of world model and heads; train what is missing."""
    folder = ROOT / IDENTITY / f"seed{seed}"
    return train_run(wide_recipe(seed), recorded(TRAIN_TOWNS, SEEDS), folder, ROOT / "cache", START)


def wide_recipe(seed: int) -> Recipe[Any, Any]:
    """Return nemo_wide with heads. One item of each step is imagined."""
    heads = heads_recipe(seed)
    schedule = dataclasses.replace(heads.schedule, steps=STEPS)
    heads = dataclasses.replace(heads, schedule=schedule, now_stride_s=JUDGED_EVERY_S)
    recipe = joint_recipe(seeded(find_recipe(START.name), seed), heads)
    imagined = ImaginationSampling(items=1, past_gradient=False)
    finetune = dataclasses.replace(recipe.finetune, imagined=imagined)
    return dataclasses.replace(recipe, finetune=rescheduled(finetune, lr=LR, warmup_steps=60))


def in_town(town: str, seed: int) -> dict[str, float]:
    """Return the figures on the virtual egos of one town."""
    run = trained(seed)
    heads = load_heads(run)
    assert heads is not None
    return judged(run, heads, recorded((town,), JUDGED_SEEDS))


def foreseen(town: str, seed: int) -> dict[str, float]:
    """Return the figures of the occupancy now and of the imagined frames on the same egos."""
    torch.set_num_threads(1)
    run = trained(seed)
    clips = dataclasses.replace(
        run.recipe.clips, future_images=False, now_stride_s=JUDGED_EVERY_S, tasks=None
    )
    dataset = ClipDataset(recorded((town,), JUDGED_SEEDS), clips, None)
    result = evaluate(
        AgentPredictor(load_agent(run), clips.future_frames, ray_stride=0),
        DataLoader(dataset, batch_size=4, collate_fn=collate),
        frame_dt_s=clips.frame_dt_s,
        metrics=[OccupancyMetric],
    )
    summary = numbers(result.summary)
    return {key: value for key, value in summary.items() if key.startswith(FUTURES)} | {
        "clips": summary["items"],
        "failed": summary["failed"],
    }


ARMS: Mapping[str, Callable[[int], Mapping[str, float]]] = {
    **{town: functools.partial(in_town, town) for town in TEST_TOWNS},
    **{f"{town}_futures": functools.partial(foreseen, town) for town in TEST_TOWNS},
}
CONFIG = {
    "recipe": dataclasses.asdict(wide_recipe(0)),
    "towns": [TRAIN_TOWNS, TEST_TOWNS, SEEDS, JUDGED_SEEDS],
    "judged_every_s": JUDGED_EVERY_S,
}
DECIDED_BY = (*LEARNED_BY_BOTH, *LEARNED_BY["nemo"], *TASKS_DECIDED_BY, "foredrive.towns.virtual_egos")
IDENTITY = study_identity(CONFIG, DECIDED_BY)
BENCHMARK = Benchmark(
    question="What does NeMo see, foresee and find on a grid that holds what is judged?",
    arms=ARMS,
    seeds=(0,),
    config=CONFIG,
    decided_by=DECIDED_BY,
)
