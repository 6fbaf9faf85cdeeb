"""Fine-tunings of NeMo that share one pre-training: drives and steps are those of `learning`'s 30 minutes.

Runs are kept in runs/nemo_fine_tuning, where an interrupted study continues. Arms with the same pre-training
share one, of one seed; seeds are those of the fine-tuning. The shared one is in nemo_town_pretraining, where
the run of `learning` can be put.
"""

import dataclasses
from pathlib import Path
from typing import Any

from benchmarks import learning
from benchmarks.common.study import StudyLogs, run_arm, seeded, share_of
from benchmarks.learning_towns import DIGEST
from foredrive.engine.bench import study_identity
from foredrive.engine.folder import WEIGHTS
from foredrive.methods.planner.path_fit import PathFit
from foredrive.methods.recipe import Recipe, rescheduled
from foredrive.runs.recipes.known import RECIPES, find_recipe
from foredrive.runs.train.run import train_run

ROOT = Path("runs/nemo_fine_tuning")
BUDGET = "30min"
PRETRAINED = "nemo_town"
PRETRAINING_SEED = 0
STEPS, WARMUP_STEPS = 600, 50
PATH_STRIDE_S = 2.0
"""Time between the clips on which the head along the path is fitted."""
CONFIG = {
    "recipes": {name: dataclasses.asdict(RECIPES[name]) for name in RECIPES if name.startswith("nemo_town")},
    "budget": dataclasses.asdict(learning.BUDGETS[BUDGET]),
    "pretraining_seed": PRETRAINING_SEED,
    "steps": STEPS,
    "path_stride_s": PATH_STRIDE_S,
    "drives": DIGEST,
}
DECIDED_BY = (
    "foredrive.tasks.planning.scores",
    "foredrive.tasks.planning.protocols",
    "foredrive.methods.planner.planner",
    "foredrive.runs.train.path_features",
    "foredrive.methods.planner.path_fit",
)
IDENTITY = study_identity(CONFIG, DECIDED_BY)


def fine_tuned(name: str, seed: int, *, pretrained: bool = True, share: float = 1.0) -> dict[str, float]:
    """Fine-tune a recipe, evaluate it on the test drives, and return its metrics.

    Args:
        name: of the recipe.
        seed: of the fine-tuning.
        pretrained: whether the recipe's pre-training comes first, if it has one.
        share: part of the training drives. Pre-training has them all.
    """
    logs = _logs()
    few = dataclasses.replace(logs, train=share_of(logs.train, share))
    recipe = _of_the_study(find_recipe(name), seed)
    start = None
    if recipe.pretrain is None or not pretrained:
        recipe = dataclasses.replace(recipe, pretrain=None)
    else:
        start = pretraining(name)
    arm = f"{name}{'' if pretrained else '_from_scratch'}_{100 * share:.0f}pct_seed{seed}"
    return run_arm(recipe, few, ROOT / IDENTITY / arm, learning.ROOT / "cache", start)


def _of_the_study(recipe: Recipe[Any, Any], seed: int) -> Recipe[Any, Any]:
    """Return the recipe with the study's lengths: pre-training as in `learning`, then fine-tuning."""
    recipe = dataclasses.replace(recipe, path=PathFit(stride_s=PATH_STRIDE_S) if recipe.path else None)
    finetune = rescheduled(recipe.finetune, steps=STEPS, warmup_steps=WARMUP_STEPS, seed=seed)
    if recipe.pretrain is None:
        return dataclasses.replace(recipe, finetune=finetune)
    pretrain = _pretraining_recipe(recipe).pretrain
    return dataclasses.replace(recipe, pretrain=pretrain, finetune=finetune)


def _pretraining_recipe(recipe: Recipe[Any, Any]) -> Recipe[Any, Any]:
    steps = learning.BUDGETS[BUDGET].steps[PRETRAINED]
    return seeded(learning.pretraining_alone(recipe, steps), PRETRAINING_SEED)


def pretraining(name: str = PRETRAINED) -> Path:
    """Return the run folder with the pre-training of a recipe of `nemo_town`, which may be there already."""
    recipe, usual = find_recipe(name), find_recipe(PRETRAINED)
    if (recipe.pretrain, recipe.model, recipe.clips) == (usual.pretrain, usual.model, usual.clips):
        name, recipe = PRETRAINED, usual
    folder = ROOT / f"{name}_pretraining"
    if not (folder / "pretrain" / WEIGHTS).is_file():
        train_run(_pretraining_recipe(recipe), _logs().train, folder, learning.ROOT / "cache")
    return folder


def _logs() -> StudyLogs:
    return StudyLogs(*learning.logs_of(learning.BUDGETS[BUDGET].drives))
