"""World models that learn from virtual egos: pre-trainings, and fine-tunings from them.

All studies of NeMo and DriveWorld share the egos of `learning`'s ten minutes (six images of each of 1,960
cars in seven towns, exact occupancy), its test drives through Town05, and pre-trainings: one of the same
recipe, steps and seed is made once. All learn from exact occupancy and are judged by it. Runs are kept in
runs/world_models, where an interrupted study continues.
"""

import dataclasses
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks import learning
from benchmarks.common.benchmark import study_identity
from benchmarks.common.study import StudyLogs, run_arm, seeded, share_of
from foredrive.data import LogPath
from foredrive.engine.checkpoints import save_small
from foredrive.files import atomic_path
from foredrive.methods.planner.path_fit import PathFit
from foredrive.methods.recipe import Recipe, rescheduled, with_occupancy_source
from foredrive.runs.recipes.known import RECIPES, find_recipe
from foredrive.runs.recipes.task_heads import town_heads, with_joint_heads
from foredrive.runs.train.baselines import Baselines, baselines_file, fit_baselines
from foredrive.runs.train.run import Run, train_run

ROOT = Path("runs/world_models")
EGOS = learning.BUDGETS["10min"].egos
STEPS: Mapping[str, int] = {"nemo": 3200, "driveworld": 800}
"""Steps of pre-training by kind of world model, of four clips each: about 20 minutes on one core."""
FINETUNING_STEPS, WARMUP_STEPS = 300, 30
PATH_STRIDE_S = 2.0
"""Time between the clips on which the head along the path is fitted."""
LEARNED_BY: Mapping[str, tuple[str, ...]] = {
    "nemo": ("foredrive.methods.nemo", "foredrive.methods.blocks.plane_context"),
    "driveworld": ("foredrive.methods.driveworld", "foredrive.methods.blocks.pooled_lifting"),
}
"""The code that decides what each kind of world model learns, beside that of both."""
LEARNED_BY_BOTH = (
    "foredrive.data.recorded_labels",
    "foredrive.engine.parameter_groups",
    "foredrive.methods.blocks.averaging",
    "foredrive.methods.blocks.backbone",
    "foredrive.methods.blocks.lifting",
    "foredrive.heads.occupancy_losses",
)
DECIDED_BY = (
    *LEARNED_BY_BOTH,
    "foredrive.methods.planner.ego_mlp_fit",
    "foredrive.methods.planner.path_fit",
    "foredrive.methods.planner.planner",
    "foredrive.tasks.occupancy.occupancy_metric",
    "foredrive.tasks.planning.protocols",
    "foredrive.tasks.planning.scores",
    *LEARNED_BY["nemo"],
    *LEARNED_BY["driveworld"],
)

TASKS_DECIDED_BY = (
    "foredrive.heads.agent_losses",
    "foredrive.heads.agents_head",
    "foredrive.heads.proposals",
    "foredrive.heads",
    "foredrive.heads.map_head",
    "foredrive.heads.map_losses",
)
"""The code that decides what task heads learn."""


def config_of(*names: str) -> dict[str, Any]:
    """Return the configuration of a study of these recipes and of those whose names begin with theirs."""
    return {
        "recipes": {
            name: dataclasses.asdict(recipe) for name, recipe in RECIPES.items() if name.startswith(names)
        },
        "egos": EGOS,
        "steps": dict(STEPS),
        "finetuning_steps": FINETUNING_STEPS,
        "path_stride_s": PATH_STRIDE_S,
        "drives": learning.DIGEST,
    }


def study_logs(share: float = 1.0) -> StudyLogs:
    """Record what is missing; return the first part of the egos, from all towns, and the test drives."""
    _, test = learning.logs_of(0)

    def turn(log: LogPath) -> tuple[str, str]:
        town, ego = log.name.rsplit("_", 1)
        return ego, town

    return StudyLogs(share_of(sorted(learning.egos_of(*EGOS), key=turn), share), test)


def of_the_study(name: str, seed: int, pretraining_seed: int) -> Recipe[Any, Any]:
    """Return a recipe with the lengths and the labels of the studies.

    Args:
        name: of the recipe.
        seed: of the fine-tuning.
        pretraining_seed: of the pre-training, if the recipe has one.
    """
    recipe = with_occupancy_source(find_recipe(name), "recorded")
    pretrain = recipe.pretrain
    if pretrain is not None:
        steps = STEPS[recipe.model.kind]
        warmup = max(1, round(0.08 * steps))
        pretrain = rescheduled(pretrain, steps=steps, warmup_steps=warmup, seed=pretraining_seed, workers=0)
    return dataclasses.replace(
        recipe,
        path=PathFit(stride_s=PATH_STRIDE_S) if recipe.path else None,
        pretrain=pretrain,
        finetune=rescheduled(
            recipe.finetune, steps=FINETUNING_STEPS, warmup_steps=WARMUP_STEPS, seed=seed, workers=0
        ),
    )


def pretrained(recipe: Recipe[Any, Any], share: float = 1.0) -> Run:
    """Return the run with the pre-training of a recipe of the studies, and nothing after it; make it once.

    Args:
        recipe: has a pre-training.
        share: part of the egos that it learns from.
    """
    assert recipe.pretrain is not None
    kind, schedule = recipe.model.kind, recipe.pretrain.schedule
    usual = find_recipe(f"{kind}_town")
    # Rows that differ in what comes after share the pre-training
    alone = dataclasses.replace(
        recipe.of_pretraining,
        name=f"{usual.name}, pre-training",
        about="",
        planner=usual.planner,
        finetune=usual.finetune,
        pretrained_model=None,
        transfer="world_model",
    )
    alone = seeded(learning.pretraining_alone(alone, schedule.steps), schedule.seed)
    config = {"recipe": dataclasses.asdict(alone), "egos": EGOS, "share": share}
    folder = ROOT / "pretrained" / study_identity(config, (*LEARNED_BY_BOTH, *LEARNED_BY[kind]))
    return train_run(alone, study_logs(share).train, folder, learning.ROOT / "cache")


def fine_tuned(
    recipe: Recipe[Any, Any],
    folder: Path,
    *,
    share: float = 1.0,
    pretraining_share: float = 1.0,
    tasks: Sequence[str] = (),
) -> dict[str, float]:
    """Fine-tune a recipe of the studies, after its pre-training, and return its figures on the test drives.

    Args:
        recipe: one without pre-training starts from scratch.
        folder: folder of the fine-tuning's run.
        share: part of the egos that fine-tuning learns from.
        pretraining_share: part of them that pre-training learns from.
        tasks: tasks whose heads are trained in fine-tuning too.
    """
    start = None if recipe.pretrain is None else pretrained(recipe, pretraining_share).folder
    if tasks:
        recipe = with_joint_heads(recipe, town_heads(tasks))
    for past_frames in {recipe.planner.history, recipe.clips.past_frames}:
        share_baselines(recipe, past_frames, folder)
    return run_arm(recipe, study_logs(share), folder, learning.ROOT / "cache", start)


def share_baselines(recipe: Recipe[Any, Any], past_frames: int, folder: Path) -> None:
    """Put the baselines of the whole training data into the folder of a run: fitting them takes minutes."""
    clips = dataclasses.asdict(dataclasses.replace(recipe.clips, tasks=None))
    identity = study_identity({"clips": clips, "egos": EGOS}, ("foredrive.methods.planner.ego_mlp_fit",))
    file = ROOT / "baselines" / identity / baselines_file(past_frames)
    if not file.is_file():
        baselines = fit_baselines(study_logs().train, recipe, learning.ROOT / "cache", past_frames)
        with atomic_path(file) as temporary:
            save_small(Baselines(*baselines), temporary)
    with atomic_path(folder / file.name) as temporary:
        shutil.copyfile(file, temporary)
