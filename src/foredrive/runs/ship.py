"""Making a trained run part of the package (`runs.shipped`)."""

import dataclasses
import json
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from foredrive.data import LogPath
from foredrive.errors import InputError
from foredrive.evaluation.summary import read_summary
from foredrive.files import atomic_path
from foredrive.recipes.config import save_recipe
from foredrive.runs.evaluate.run import evaluate_run
from foredrive.runs.folder import CONFIG, LOGS, SUMMARY
from foredrive.runs.model_card import ModelCard
from foredrive.runs.shipped import CARD, MODELS
from foredrive.runs.train.baselines import Baselines, baselines_file, run_baselines
from foredrive.runs.train.rigs import RIGS
from foredrive.runs.train.run import Run, load_agent
from foredrive.runs.train.task_priors import PRIORS, TASKS
from foredrive.training.small_weights import save_small

MAX_BYTES = 6_000_000
"""Maximum size of the weights of one model."""
FIGURES = {
    "IoU above the ground, now": "occupancy.above_ground.iou_now",
    "— occupancy prior": "occupancy.above_ground.iou_now.best_constant",
    "IoU above the ground, in 1 s": "occupancy.above_ground.iou_future_1s",
    "— ego-compensated persistence": "occupancy.above_ground.iou_future_1s.carried_copy",
    "recall of columns with a car within 20 m": "vehicles.car_recall_20m",
    "L2 of the plan by UniAD's protocol, m": "planning.uniad.l2_avg_m",
    "— ego-only MLP": "planning.ego_mlp.uniad.l2_avg_m",
    "collisions of the plan by UniAD's protocol, %": "planning.uniad.collision_avg_pct",
}
"""Rows of a card by their keys in a summary."""


def ship(run: Run, name: str, test: Sequence[LogPath], data: str, limits: str, models: Path = MODELS) -> Path:
    """Write a trained run as a model of the package and evaluate it; return its folder.

    Its card shows the figures of the run and of the model, whose weights have 8 bits.

    Args:
        name: name of the model.
        test: logs of the evaluation.
        data: the training and test data, in one sentence.
        limits: what the model cannot do, in a sentence or two.
        models: folder of all models.

    Raises:
        InputError: the run was not evaluated, or its weights are too large.
    """
    if not (run.folder / SUMMARY).is_file():
        raise InputError(f"{run.folder}: evaluate the run first; its figures are part of the card")
    past = run.recipe.clips.past_frames
    with atomic_path(models / name) as temporary:
        weights = temporary / run.weights.relative_to(run.folder)
        weights.parent.mkdir(parents=True)
        save_small(load_agent(run), weights)
        if weights.stat().st_size > MAX_BYTES:
            raise InputError(f"{run.folder}: {weights.stat().st_size} bytes of weights; {MAX_BYTES} at most")
        baselines = Baselines(*run_baselines(run.folder, run.logs, run.recipe, run.cache_dir, past))
        save_small(baselines, temporary / baselines_file(past))
        for file in (RIGS, f"{TASKS}/{PRIORS}"):
            if (run.folder / file).is_file():
                (temporary / file).parent.mkdir(exist_ok=True)
                shutil.copyfile(run.folder / file, temporary / file)
        save_recipe(run.recipe, temporary / CONFIG)
        (temporary / LOGS).write_text(json.dumps({"logs": [], "cache_dir": "cache", "start": None}))
        small = dataclasses.replace(run, folder=temporary, logs=())
        with tempfile.TemporaryDirectory() as folder:
            evaluate_run(small, test, Path(folder), views=False)
            shipped = read_summary(Path(folder) / SUMMARY)
        card = _card(name, run.recipe.name, read_summary(run.folder / SUMMARY), shipped, data, limits)
        (temporary / CARD).write_text(card.markdown())
    return models / name


def _card(
    name: str, recipe: str, trained: Mapping[str, Any], shipped: Mapping[str, Any], data: str, limits: str
) -> ModelCard:
    figures = {
        title: (float(trained[key]), float(shipped[key]))
        for title, key in FIGURES.items()
        if trained.get(key) is not None and shipped.get(key) is not None
    }
    clips, failed, commit = shipped["items"], shipped["failed"], str(trained.get("commit"))
    return ModelCard(name, recipe, commit, data, clips, failed, figures, limits)
