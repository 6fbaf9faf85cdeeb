"""The rows of DriveWorld's Tables 1 and 2 at the scale of towns: `foredrive bench driveworld-ablation`.

All rows learn from the same virtual egos for equally many steps (common/world_models.py), and have the same
fine-tuning: world model, planner, and heads of detection and map together. As in the paper, the rows of
Table 1 carry backbone and encoder over to it, and all other parts start fresh. The planner has no head along
the path, which is not the paper's. Every seed has its own pre-training. `pretrained_50` and `finetuned_75`
are rows of Table 2, the full recipe on parts of the egos.
"""

import dataclasses
import functools

from benchmarks.common.benchmark import Benchmark, study_identity
from benchmarks.common.world_models import (
    DECIDED_BY,
    ROOT,
    TASKS_DECIDED_BY,
    config_of,
    fine_tuned,
    of_the_study,
)
from foredrive.runs.recipes.known import RECIPES

FULL, PROMPTS = "driveworld_town", "driveworld_town_prompts"
TASKS = ("detection", "map")
CONFIG = config_of(FULL) | {"tasks": TASKS, "path": None}
IDENTITY = study_identity(CONFIG, (*DECIDED_BY, *TASKS_DECIDED_BY))


def arm(name: str, seed: int, *, pretraining_share: float = 1.0, share: float = 1.0) -> dict[str, float]:
    """Train a row and return its figures on the test drives.

    Args:
        name: of the recipe.
        seed: of pre-training and fine-tuning.
        pretraining_share, share: parts of the egos that they learn from.
    """
    recipe = of_the_study(name, seed, pretraining_seed=seed)
    recipe = dataclasses.replace(recipe, path=None, planner=dataclasses.replace(recipe.planner, path=None))
    run = f"{name}_{100 * pretraining_share:.0f}pct_then_{100 * share:.0f}pct_seed{seed}"
    return fine_tuned(
        recipe,
        ROOT / "driveworld_ablation" / IDENTITY / run,
        share=share,
        pretraining_share=pretraining_share,
        tasks=TASKS,
    )


BENCHMARK = Benchmark(
    question="What does each part of DriveWorld add, in the rows of its Tables 1 and 2?",
    arms={name: functools.partial(arm, name) for name in RECIPES if name.startswith(FULL)}
    | {
        "pretrained_50": functools.partial(arm, PROMPTS, pretraining_share=0.5),
        "finetuned_75": functools.partial(arm, PROMPTS, share=0.75),
    },
    config=CONFIG,
    decided_by=(*DECIDED_BY, *TASKS_DECIDED_BY),
)
