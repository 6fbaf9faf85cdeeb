"""Add an evaluated run to the models of the package (`runs.shipped`).

`python -m benchmarks.common.shipping RUN NAME --test LOGS ...` adds a world model.
"""

import dataclasses
import json
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import tyro
from torch import nn

from foredrive.data import LogPath, find_all_logs
from foredrive.driver.judging import judge_sight
from foredrive.driver.packed import PackedClips
from foredrive.engine.checkpoints import save_small
from foredrive.engine.config import save_recipe
from foredrive.engine.folder import CONFIG, LOGS, SUMMARY
from foredrive.engine.provenance import collect_provenance
from foredrive.engine.summary import read_summary
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.runs.drive.compare import values_of
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.suite import DriveSuite, drive_suite
from foredrive.runs.evaluate.run import evaluate_run
from foredrive.runs.model_card import ModelCard
from foredrive.runs.open_clips import open_clips
from foredrive.runs.shipped import CARD, MODELS
from foredrive.runs.train.baselines import Baselines, baselines_file, run_baselines
from foredrive.runs.train.driver import DriverRun, load_driver
from foredrive.runs.train.rigs import RIGS
from foredrive.runs.train.run import Run, load_agent, open_run
from foredrive.runs.train.task_priors import PRIORS, TASKS

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
SIGHT_FIGURES = {
    "state of the light within 40 m": "light_accuracy_40m",
    "red lights missed within 40 m": "red_missed_40m",
    "recall of conflicts ahead": "conflict_recall",
    "— false ones": "conflict_false",
    "error of the first obstacle, m": "first_obstacle_error_m",
}
DRIVE_FIGURES = {
    "driving score of leaderboard 1.0": ("driving_score_1_0", 1),
    "completion of routes, %": ("completion", 1),
    "red lights in 100 routes": ("red_lights", 100),
    "collisions in 100 routes": ("collisions", 100),
}
"""Rows of a driver's card by their keys: those of its perception, and those of its drives with a factor."""


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
        _save(load_agent(run), weights)
        # The baselines are shipped, because they are fitted to training logs, which are not
        baselines = Baselines(*run_baselines(run.folder, run.logs, run.recipe, run.cache_dir, past))
        save_small(baselines, temporary / baselines_file(past))
        for file in (RIGS, f"{TASKS}/{PRIORS}"):
            if (run.folder / file).is_file():
                (temporary / file).parent.mkdir(exist_ok=True)
                shutil.copyfile(run.folder / file, temporary / file)
        save_recipe(run.recipe, temporary / CONFIG)
        (temporary / LOGS).write_text(json.dumps({"logs": [], "cache_dir": "cache", "start": None}))
        # Evaluate the model from the files that are shipped, before they appear in the package
        small = dataclasses.replace(run, folder=temporary, logs=())
        with tempfile.TemporaryDirectory() as folder:
            evaluate_run(small, test, Path(folder), views=False)
            shipped = read_summary(Path(folder) / SUMMARY)
        card = _card(name, run.recipe.name, read_summary(run.folder / SUMMARY), shipped, data, limits)
        (temporary / CARD).write_text(card.markdown())
    return models / name


def ship_driver(
    run: DriverRun,
    name: str,
    test: Sequence[LogPath],
    routes: TownRoutes,
    work: Path,
    data: str,
    limits: str,
    models: Path = MODELS,
) -> Path:
    """Write a trained driver as a model of the package; return its folder.

    Both the run and the model, whose weights have 8 bits, are evaluated on the test logs and drive the
    routes. The card shows the figures of both.

    Args:
        name: name of the model.
        test: logs with lights and boxes.
        routes: the routes to drive.
        work: folder of drives and caches, from which an interrupted call continues.
        data: the training and test data, in one sentence.
        limits: what the driver cannot do, in a sentence or two.
        models: folder of all models.

    Raises:
        InputError: the weights are too large, or a drive failed.
    """
    small = dataclasses.replace(run, folder=work / name, logs=(), start=None)
    _save(load_driver(run), work / name / run.weights.relative_to(run.folder))
    shutil.copyfile(run.folder / RIGS, small.folder / RIGS)
    save_recipe(run.recipe, small.folder / CONFIG)
    (small.folder / LOGS).write_text(json.dumps({"logs": [], "start": None}))
    clips = PackedClips(open_clips(test, run.recipe.clips, work / "cache"), work / "cache" / "packed")
    clips.pack()
    both = []
    for one, folder in ((run, work / "drives"), (small, work / "drives_in_8_bits")):
        driven = drive_suite(DriveSuite(str(one.folder.absolute()), routes, lidar=False), folder)
        if driven.broken:
            raise InputError(f"{folder}: {len(driven.broken)} drives failed")
        values = [values_of(drive) for drive in driven.drives.values()]
        seen = judge_sight(load_driver(one), clips)
        both.append(
            {title: seen[key] for title, key in SIGHT_FIGURES.items()}
            | {
                title: count * sum(value[key] for value in values) / len(values)
                for title, (key, count) in DRIVE_FIGURES.items()
            }
        )
    # Per figure: the run as trained, then the model as shipped
    figures = {title: (both[0][title], both[1][title]) for title in both[0]}
    commit = str(collect_provenance()["commit"])
    card = ModelCard(name, run.recipe.name, commit, data, len(clips), 0, figures, limits)
    (small.folder / CARD).write_text(card.markdown())
    with atomic_path(models / name) as temporary:
        shutil.copytree(small.folder, temporary)
    return models / name


def _save(model: nn.Module, weights: Path) -> None:
    """Write weights in 8 bits.

    Raises:
        InputError: they are too large for the package.
    """
    weights.parent.mkdir(parents=True, exist_ok=True)
    save_small(model, weights)
    if weights.stat().st_size > MAX_BYTES:
        raise InputError(f"{weights}: {weights.stat().st_size} bytes of weights; {MAX_BYTES} at most")


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


def main(
    run: tyro.conf.Positional[Path], name: tyro.conf.Positional[str], test: list[Path], data: str, limits: str
) -> None:
    """Write src/foredrive/runs/models/NAME.

    Args:
        run: run folder.
        name: name of the model.
        test: logs of the evaluation whose figures the card shows.
        data: the training and test data, in one sentence.
        limits: what the model cannot do.
    """
    print(ship(open_run(run), name, find_all_logs(test), data, limits))


if __name__ == "__main__":
    tyro.cli(main)
