"""Closed-loop driving on Town05: `foredrive bench drive-nemo`, days on two cores; `--arms` measures some.

Demonstrations with the rig of `nemo_drive_tele` are driven in the training towns in all weathers: first by
the disturbed expert, then in rounds of DAgger by the student of the round before. Every arm learns from
them and drives the same routes in the same traffic, three repetitions by day. All is kept in
runs/drive_nemo/COMMIT. An interrupted benchmark continues with the next drive, and `foredrive compare`
reads the folders of drives.
"""

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.study import HEADLINE, JUDGED_EVERY_S, seeded, work_folder
from foredrive.data import LogPath, find_all_logs
from foredrive.errors import InputError
from foredrive.evaluation.bench import Benchmark
from foredrive.evaluation.summary import read_summary
from foredrive.metrics.bootstrap import bootstrap_mean
from foredrive.recipes import Recipe, find_recipe
from foredrive.runs.drive.agents import IDM, IDM_BY_SIGHT
from foredrive.runs.drive.compare import values_of
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.recording import record_drives
from foredrive.runs.drive.suite import DriveSuite, SuiteResult, drive_suite
from foredrive.runs.evaluate.run import SUMMARY, evaluate_run
from foredrive.runs.train.run import Run, train_run
from foredrive.sensors.rigs import DRIVING
from foredrive.simulation.drive_record import DriveRecord
from foredrive.towns.campaign import Campaign, plan_drives

WORK = work_folder(Path("runs/drive_nemo"))
FULL = "nemo_drive_tele"
RECIPES = {
    "pretrained": FULL,
    "present": f"{FULL}_present",
    "scorer": f"{FULL}_scorer",
    "scorer_present": f"{FULL}_scorer_present",
    "driveworld": "driveworld_drive_tele",
}
"""Arms that are pre-trained on the demonstrations. The first four are 2 x 2: scorer, futures."""
ROUNDS = 2
"""Rounds of DAgger after the demonstrations of the disturbed expert."""
DEMONSTRATIONS = ("training-short", "training-long")
JUDGED = {"short": "town05-short", "long": "town05-long"}
REPETITIONS = 3
OPEN_LOOP = Campaign(("Town05",), seeds=tuple(range(1, 7)), seconds=60.0, rate_hz=2.0)
CORES = len(os.sched_getaffinity(0))


def _driven(suite: DriveSuite, out: Path) -> SuiteResult:
    driven = drive_suite(suite, out, CORES)
    if driven.broken:
        job, why = next(iter(driven.broken.items()))
        raise InputError(f"{len(driven.broken)} drives failed, {job.name}: {why}")
    return driven


def demonstrations(rounds: int) -> tuple[LogPath, ...]:
    """Return the logs of the disturbed expert and of the first rounds of DAgger; drive what is missing.

    The student of a round is trained on the rounds before, with seed 0.
    """
    folders = []
    for number in range(rounds + 1):
        student = "disturbed" if number == 0 else f"student:{_student(number - 1).folder.absolute()}"
        for name in DEMONSTRATIONS if number == 0 else DEMONSTRATIONS[:1]:
            folder = WORK / "demonstrations" / f"round{number}_{name}"
            source = TownRoutes(name, seed=number, conditions="any", rig=DRIVING)
            _driven(DriveSuite(student, source), folder)
            folders.append(folder)
    return find_all_logs(folders)


def _student(rounds: int) -> Run:
    return trained(seeded(find_recipe(FULL), 0), f"dagger_{rounds}_seed0", rounds)


def trained(recipe: Recipe[Any, Any], name: str, rounds: int = ROUNDS) -> Run:
    """Return a run on the demonstrations of some rounds, and train what is missing."""
    return train_run(recipe, demonstrations(rounds), WORK / "runs" / name, WORK / "cache")


def scores(agent: str, name: str) -> dict[str, float]:
    """Return the figures of an agent on each set of routes, with 95 % intervals over routes."""
    figures = {}
    for short, routes in JUDGED.items():
        source = TownRoutes(routes, repetitions=REPETITIONS, rig=DRIVING)
        drives = _driven(DriveSuite(agent, source, sensors=False), WORK / "drives" / f"{name}_{short}").drives
        figures |= {f"{key}_{short}": value for key, value in _figures(list(drives.values())).items()}
    return figures


def _figures(drives: Sequence[DriveRecord]) -> dict[str, float]:
    """Return means over drives. Infractions are those of one repetition of all routes."""
    values = [values_of(drive) for drive in drives]
    routes = [drive.score.route for drive in drives]
    found = bootstrap_mean(
        np.array([value["driving_score_1_0"] for value in values]), routes, np.random.default_rng(0)
    )
    count = len(set(routes))

    def mean(key: str) -> float:
        return float(np.mean([value[key] for value in values]))

    return {
        "ds": found.mean,
        "ds_low": found.low,
        "ds_high": found.high,
        "ds_2_1": mean("driving_score_2_1"),
        "rc": mean("completion"),
        "red_lights": count * mean("red_lights"),
        "collisions": count * mean("collisions"),
        "stop_signs": count * mean("stop_signs"),
        "failed": float(sum(drive.score.failed for drive in drives)),
    }


def learned(
    name: str, recipe: str, rounds: int = ROUNDS, pretrained: bool = True
) -> Callable[[int], Mapping[str, float]]:
    """Return an arm of a recipe that learns from the demonstrations."""

    def measure(seed: int) -> Mapping[str, float]:
        chosen = seeded(find_recipe(recipe), seed)
        chosen = chosen if pretrained else dataclasses.replace(chosen, pretrain=None)
        run = trained(chosen, f"{name}_seed{seed}", rounds)
        return {**_open_loop(run), **scores(str(run.folder.absolute()), f"{name}_seed{seed}")}

    return measure


def _open_loop(run: Run) -> dict[str, float]:
    """Return L2 and the accuracy of the affordances on recorded drives in Town05."""
    if not (run.folder / SUMMARY).is_file():
        recorded = record_drives(plan_drives(OPEN_LOOP), WORK / "towns", DRIVING, CORES)
        evaluate_run(
            run, tuple(recorded.logs.values()), run.folder, batch_size=8, views=False, stride_s=JUDGED_EVERY_S
        )
    summary = read_summary(run.folder / SUMMARY)
    keys = {
        "l2_avg_m": f"planning.{HEADLINE}.l2_avg_m",
        "light_accuracy_40m": "affordances.light_accuracy_40m",
        "lead_error_m": "affordances.lead_error_m",
        "crossing_recall_20m": "affordances.crossing_recall_20m",
    }
    return {name: float(value) for name, key in keys.items() if (value := summary.get(key)) is not None}


def blind_mlp(seed: int) -> Mapping[str, float]:
    """Score the MLP that is told the same and sees nothing, fitted to the same demonstrations."""
    run = trained(seeded(find_recipe(FULL), seed), f"pretrained_seed{seed}")
    return scores(f"ego-mlp:{run.folder.absolute()}", f"blind_mlp_seed{seed}")


def idm_by_sight(seed: int) -> Mapping[str, float]:
    """Score the rule-based agent with what a run tells of lights, lead vehicle and people."""
    run = trained(seeded(find_recipe(FULL), seed), f"pretrained_seed{seed}")
    return scores(f"{IDM_BY_SIGHT}{run.folder.absolute()}", f"idm_by_sight_seed{seed}")


def without_training(agent: str, name: str) -> Callable[[int], Mapping[str, float]]:
    """Return an arm of an agent that learns nothing: all seeds are the same drives."""
    return lambda seed: scores(agent, name)


BENCHMARK = Benchmark(
    question="How well does NeMo drive Town05's routes by sight, and what does each part bring?",
    arms={
        "expert": without_training("expert", "expert"),
        "constant_velocity": without_training("constant-velocity", "constant_velocity"),
        "idm": without_training(IDM, "idm"),
        **{f"dagger_{k}": learned(f"dagger_{k}", FULL, k) for k in range(ROUNDS)},
        **{name: learned(name, recipe) for name, recipe in RECIPES.items()},
        "scratch": learned("scratch", FULL, pretrained=False),
        "blind_mlp": blind_mlp,
        "idm_by_sight": idm_by_sight,
    },
    config={
        "recipes": {name: dataclasses.asdict(find_recipe(recipe)) for name, recipe in RECIPES.items()},
        "demonstrations": DEMONSTRATIONS,
        "rounds": ROUNDS,
        "routes": JUDGED,
        "repetitions": REPETITIONS,
    },
    decided_by=(
        "foredrive.simulation",
        "foredrive.towns",
        "foredrive.models",
        "foredrive.losses",
        "foredrive.training",
        "foredrive.data",
    ),
)
