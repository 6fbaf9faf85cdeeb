"""Compare what chooses data: `foredrive bench improve`, a round of `foredrive improve` by each strategy.

A driver is trained on few virtual egos of the training towns (one seed, three epochs). It drives training
routes in all weathers; then each strategy chooses as many moments of a pool of two other seeds, or makes
them anew, and the driver goes on learning. Arms of one seed have the same beginning and the same failures.

`begin` is the driver before the round, and `same_logs` trains for as many epochs on its own logs alone. Arms
are judged by what they see of virtual egos in the held-out town in all weathers; ARM@driven by every second
of the short routes there. Seeds are those of the first training, of the traffic in which failures are looked
for, and of the choice.
"""

import dataclasses
import os
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.common.benchmark import Benchmark, study_identity
from benchmarks.common.driver_study import (
    EGOS,
    TRAINING_TOWNS,
    egos,
    recipe_of,
    recorded,
    sight_figures,
    trained,
)
from foredrive.data import LogPath
from foredrive.driver.recipes import DriverRecipe
from foredrive.driving.drive_record import DriveRecord
from foredrive.runs.drive.compare import values_of
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.recording import EgosPlan
from foredrive.runs.improve.choosing import STRATEGIES
from foredrive.runs.improve.drivers import ROUND
from foredrive.runs.improve.loop import INDEX, RUN, Loop
from foredrive.runs.improve.records import Improvement, Round
from foredrive.runs.train.driver import open_driver
from foredrive.scene.conditions import ANY_CONDITIONS, CONDITIONS
from foredrive.sensors.rigs import FRONT_TELE
from foredrive.tasks.bootstrap import bootstrap_mean
from foredrive.towns.map.names import TEST_TOWNS

EPOCHS = 3
POOL_SEEDS, HELD_SEEDS, HELD_EGOS = range(100, 102), range(3), 100
SEARCHED = "training-short"
ROUTES = tuple(f"{town}-{number}" for town in TRAINING_TOWNS for number in range(3))
JUDGED, HELD_ROUTES = "town05-short", tuple(str(number) for number in range(0, 32, 2))
BUDGET, SETTINGS = 500, ROUND
CORES = len(os.sched_getaffinity(0))
CONFIG = {
    "recipe": dataclasses.asdict(recipe_of("driver_small", 0)),
    "epochs": EPOCHS,
    "egos": [EGOS, list(POOL_SEEDS), list(HELD_SEEDS), HELD_EGOS],
    "routes": [SEARCHED, *ROUTES, JUDGED, *HELD_ROUTES],
    "round": [BUDGET, *SETTINGS],
}
DECIDED_BY = (
    "foredrive.driving",
    "foredrive.driver",
    "foredrive.towns",
    "foredrive.runs.improve",
    "foredrive.search",
    "foredrive.data",
)
WORK = Path("runs/improve") / study_identity(CONFIG, DECIDED_BY)


def _short(recipe: DriverRecipe) -> DriverRecipe:
    return dataclasses.replace(recipe, see=dataclasses.replace(recipe.see, epochs=EPOCHS))


def _base() -> list[LogPath]:
    return egos(range(1), WORK / "egos", CORES, tuple(CONDITIONS))


def _held() -> list[LogPath]:
    plans = [EgosPlan(town, seed, HELD_EGOS, tuple(CONDITIONS)) for town in TEST_TOWNS for seed in HELD_SEEDS]
    return recorded(plans, WORK / "held", CORES)


def _loop(strategy: str, seed: int) -> Loop:
    """Return the loop of a strategy. What is common to all is there once."""
    start = trained(
        recipe_of("driver_small", seed, _short), _base(), WORK / f"begin_seed{seed}", WORK / "cache"
    )
    pool = egos(POOL_SEEDS, WORK / "pool", CORES, tuple(CONDITIONS))
    routes = TownRoutes(SEARCHED, seed=seed, conditions=ANY_CONDITIONS, rig=FRONT_TELE, only=ROUTES)
    judged = TownRoutes(JUDGED, seed=0, conditions=ANY_CONDITIONS, rig=FRONT_TELE, only=HELD_ROUTES)
    improvement = Improvement(
        start.folder.absolute(),
        tuple(pool),
        tuple(_base()),
        routes,
        judged,
        strategy,
        BUDGET,
        SETTINGS,
        seed=seed,
    )
    improvement.check()
    out = WORK / f"{strategy}_seed{seed}"
    for own, common in (
        (out / INDEX, WORK / INDEX),
        (out / "cache", WORK / "cache"),
        (out / "round_0", WORK / f"round_0_seed{seed}"),
    ):
        common.mkdir(parents=True, exist_ok=True)
        own.parent.mkdir(parents=True, exist_ok=True)
        if not own.is_symlink():
            own.symlink_to(common.absolute(), target_is_directory=True)
    return Loop(improvement, out, CORES, say=print)


def _round(strategy: str, seed: int) -> tuple[Loop, Round]:
    loop = _loop(strategy, seed)
    learned = loop.learned(1, [loop.begin])
    assert isinstance(learned, Round), learned
    return loop, learned


def begin(seed: int) -> tuple[Loop, Round]:
    """Return the loop and the run that it begins with."""
    loop = _loop(STRATEGIES[0], seed)
    return loop, loop.begin


def same_logs(seed: int) -> tuple[Loop, Round]:
    """Return the loop and a run that goes on with the driver's own logs alone."""
    loop, folder = _loop(STRATEGIES[0], seed), WORK / f"same_logs_seed{seed}"
    run = folder / RUN
    loop.pupil.learn(loop.of.logs, run, loop.of.start)
    return loop, Round(1, folder, run)


def seen(round_of: Callable[[int], tuple[Loop, Round]], seed: int) -> Mapping[str, float]:
    """Return how well the driver of a round sees the held-out town."""
    _, learned = round_of(seed)
    figures = sight_figures(open_driver(learned.run), _held(), WORK / "cache")
    counts = {"failures": len(learned.failures), "moments": len(learned.hits)}
    return figures | {name: float(count) for name, count in counts.items()}


def driven(round_of: Callable[[int], tuple[Loop, Round]], seed: int) -> Mapping[str, float]:
    """Return the driving score in the held-out town with its interval over routes, and infractions."""
    loop, learned = round_of(seed)
    judged = loop.judged(learned).judged.values()
    drives = [drive for drive in judged if isinstance(drive, DriveRecord)]
    values = [values_of(drive) for drive in drives]
    score = bootstrap_mean(
        np.array([value["driving_score_1_0"] for value in values]),
        [drive.score.route for drive in drives],
        np.random.default_rng(0),
    )
    means = {key: float(np.mean([value[key] for value in values])) for key in values[0]}
    return means | {"ds": score.mean, "ds_low": score.low, "ds_high": score.high}


ROUNDS: Mapping[str, Callable[[int], tuple[Loop, Round]]] = {
    "begin": begin,
    "same_logs": same_logs,
    **{strategy.replace("-", "_"): partial(_round, strategy) for strategy in STRATEGIES},
}
BENCHMARK = Benchmark(
    question="Which moments help a driver most: random, uncertain, diverse, or those like its failures?",
    arms={name: partial(seen, round_of) for name, round_of in ROUNDS.items()}
    | {f"{name}@driven": partial(driven, round_of) for name, round_of in ROUNDS.items()},
    config=CONFIG,
    decided_by=DECIDED_BY,
)
