"""Closed-loop driving on Town05: `foredrive bench drive-nemo`, days on two cores; `--arms` measures some.

Demonstrations with the rig of `nemo_drive_tele` are driven in the training towns in all weathers: first by
the disturbed expert, then in rounds of DAgger by the student of the round before. NeMo starts from the world
model that comes with the package, which was trained with surround cameras. Arms ending in a number learn from
the rounds up to it; the others learn from all. All drive the same routes in the same traffic by day; ARM@long
drives the long routes. Seeds are those of fine-tuning.

All is kept in runs/drive_nemo, where an interrupted benchmark continues with the next drive, and
`foredrive compare` reads the folders of drives.
"""

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.common.study import HEADLINE, JUDGED_EVERY_S, seeded
from foredrive.data import LogPath, find_all_logs
from foredrive.errors import InputError
from foredrive.evaluation.bench import Benchmark, study_identity
from foredrive.evaluation.summary import read_summary
from foredrive.metrics.bootstrap import bootstrap_mean
from foredrive.recipes import find_recipe
from foredrive.recipes.config import rescheduled
from foredrive.runs.drive.agents import IDM
from foredrive.runs.drive.compare import values_of
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.recording import record_drives
from foredrive.runs.drive.suite import DriveSuite, SuiteResult, drive_suite
from foredrive.runs.evaluate.run import SUMMARY, evaluate_run
from foredrive.runs.shipped import run_folder
from foredrive.runs.train.run import Run, train_run
from foredrive.sensors.rigs import DRIVING
from foredrive.simulation.drive_record import DriveRecord
from foredrive.simulation.route_sets import load_route_set
from foredrive.towns.campaign import Campaign, plan_drives

FULL = "nemo_drive_tele"
RECIPES = {
    "present": f"{FULL}_present",
    "scorer": f"{FULL}_scorer",
    "scorer_present": f"{FULL}_scorer_present",
    "driveworld": "driveworld_drive_tele",
}
"""With the last round's arm of `FULL`, the first three are 2 x 2: scorer, futures."""
PRETRAINED = Path("embedded:nemo_town")
FINETUNE_STEPS = 600
"""Steps of fine-tuning, where the recipes have 1,500: they take half an hour on one core."""
ROUNDS = 1
"""Rounds of DAgger after the demonstrations of the disturbed expert."""
DEMONSTRATIONS = "training-short"
DEMONSTRATED = ("Town01", "Town02", "Town03", "Town04", "Town06")
ROUTES_A_TOWN = 4
"""Number of routes that are demonstrated in each of these towns, of eight. The others take hours more."""
JUDGED = {"short": "town05-short", "long": "town05-long"}
REPETITIONS = 1
OPEN_LOOP = Campaign(("Town05",), seeds=(1, 2), seconds=60.0, rate_hz=2.0)
CORES = len(os.sched_getaffinity(0))
CONFIG = {
    "recipes": {name: dataclasses.asdict(find_recipe(name)) for name in (FULL, *RECIPES.values())},
    "pretraining": str(PRETRAINED),
    "finetune_steps": FINETUNE_STEPS,
    "demonstrations": [DEMONSTRATIONS, *DEMONSTRATED, ROUTES_A_TOWN],
    "rounds": ROUNDS,
    "routes": JUDGED,
    "repetitions": REPETITIONS,
}
DECIDED_BY = (
    "foredrive.simulation",
    "foredrive.towns",
    "foredrive.models",
    "foredrive.losses",
    "foredrive.training",
    "foredrive.data",
)
WORK = Path("runs/drive_nemo") / study_identity(CONFIG, DECIDED_BY)


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
        folder = WORK / "demonstrations" / f"round{number}"
        source = TownRoutes(
            DEMONSTRATIONS, seed=number, conditions="any", rig=DRIVING, only=demonstrated_routes()
        )
        _driven(DriveSuite(student, source), folder)
        folders.append(folder)
    return find_all_logs(folders)


def demonstrated_routes() -> tuple[str, ...]:
    """Return the ids of the first routes of each town."""
    routes = load_route_set(DEMONSTRATIONS)
    return tuple(
        route.id
        for town in DEMONSTRATED
        for route in [route for route in routes if route.town == town][:ROUTES_A_TOWN]
    )


def _student(rounds: int) -> Run:
    return trained(FULL, f"dagger_{rounds}", 0, rounds)


def trained(recipe: str, name: str, seed: int, rounds: int = ROUNDS, pretrained: bool = True) -> Run:
    """Return a run on the demonstrations of some rounds, and train what is missing."""
    chosen = seeded(find_recipe(recipe), seed)
    chosen = dataclasses.replace(chosen, finetune=rescheduled(chosen.finetune, steps=FINETUNE_STEPS))
    start = run_folder(PRETRAINED) if pretrained and recipe.startswith("nemo") else None
    chosen = chosen if pretrained else dataclasses.replace(chosen, pretrain=None)
    folder = WORK / "runs" / f"{name}_seed{seed}"
    return train_run(chosen, demonstrations(rounds), folder, WORK / "cache", start)


def scores(agent: str, name: str, routes: str) -> dict[str, float]:
    """Return the figures of an agent on a set of routes, with 95 % intervals over routes."""
    source = TownRoutes(JUDGED[routes], repetitions=REPETITIONS, rig=DRIVING)
    drives = _driven(DriveSuite(agent, source, sensors=False), WORK / "drives" / f"{name}_{routes}").drives
    return {f"{key}_{routes}": value for key, value in _figures(list(drives.values())).items()}


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


Arm = Callable[[int, str], Mapping[str, float]]
"""An arm, of a seed and a set of routes."""


def learned(name: str, recipe: str, rounds: int = ROUNDS, pretrained: bool = True) -> Arm:
    """Return an arm of a recipe that learns from the demonstrations."""

    def measure(seed: int, routes: str) -> Mapping[str, float]:
        run = trained(recipe, name, seed, rounds, pretrained)
        return {**_open_loop(run), **scores(str(run.folder.absolute()), f"{name}_seed{seed}", routes)}

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


def blind_mlp(rounds: int) -> Arm:
    """Return an arm of the MLP that is told the same as NeMo after a round, and sees nothing."""

    def measure(seed: int, routes: str) -> Mapping[str, float]:
        run = trained(FULL, f"dagger_{rounds}", seed, rounds)
        return scores(f"ego-mlp:{run.folder.absolute()}", f"blind_mlp_{rounds}_seed{seed}", routes)

    return measure


def without_training(agent: str, name: str) -> Arm:
    """Return an arm of an agent that learns nothing: all seeds are the same drives."""
    return lambda seed, routes: scores(agent, name, routes)


ARMS: Mapping[str, Arm] = {
    "expert": without_training("expert", "expert"),
    "constant_velocity": without_training("constant-velocity", "constant_velocity"),
    "idm": without_training(IDM, "idm"),
    **{
        f"{name}_{rounds}": arm
        for rounds in range(ROUNDS + 1)
        for name, arm in (
            ("dagger", learned(f"dagger_{rounds}", FULL, rounds)),
            ("blind_mlp", blind_mlp(rounds)),
        )
    },
    **{name: learned(name, recipe) for name, recipe in RECIPES.items()},
    "scratch": learned("scratch", FULL, pretrained=False),
}


def _of_routes(arm: Arm, routes: str) -> Callable[[int], Mapping[str, float]]:
    return lambda seed: arm(seed, routes)


BENCHMARK = Benchmark(
    question="How well does NeMo drive Town05's routes by sight, and what does each part bring?",
    arms={name: _of_routes(arm, "short") for name, arm in ARMS.items()}
    | {f"{name}@long": _of_routes(arm, "long") for name, arm in ARMS.items()},
    config=CONFIG,
    decided_by=DECIDED_BY,
)
