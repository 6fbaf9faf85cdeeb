"""Closed-loop driving by sight: `foredrive bench drive-nemo`, about 40 core hours; `--arms` measures some.

**NeMo's claim**: `same_small`, `same_nemo`, `same_nemo_scratch` and `same_nemo_blind` learn from the same
virtual egos of the training towns for the same number of visits, and drive with the same planner and rules.
`same_small` is `driver_small`. The others have NeMo's volume as their eyes: from the world model that comes
with the package, from scratch, and with black images. `gain` compares the two first of these, paired over
routes and seeds.

`left_out_TOWN` has learned as `same_small` from all other towns, and drives the training routes of this one,
beside `same_small` itself.

**Rounds of DAgger**: `small_K` has learned from more egos and from K rounds of what it met when it drove the
training routes itself, in all weathers, driven by the driver of the round before with seed 0. `small_blind`
learned from all of them with black images. `taught_K` is the shipped driver, which learned on with stop
signs, from fewer egos and K rounds of its own. `rules_by_sight` has the rule in place of the planner of
`small`, `true*` is told road users, lights or both as they are. `regressing` is NeMo's own planner, which
learns from an expert's demonstrations.

`shipped` is the driver that comes with the package, `shipped_*` has parts of it, or drives through the
interface of CARLA's leaderboards.

All drive the same routes in the same traffic by day: those of Town05, on which rules were chosen, and those
of the unseen towns, for which nothing was chosen. The short ones of Town05 are driven twice. ARM@long,
ARM@unseen_short and ARM@unseen_long are parts of ARM. An interrupted benchmark goes on with the next drive.
Seeds are those of training. All is kept in runs/drive_nemo, and `foredrive compare` reads the folders of
drives.
"""

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.common.benchmark import Benchmark, study_identity
from benchmarks.common.driver_study import (
    EGOS,
    PRETRAINED,
    SIGN_TILES,
    egos,
    figures_on_its_way,
    recipe_of,
    sight_figures,
    test_egos,
    trained,
)
from benchmarks.common.leaderboard_door import LeaderboardDoor
from benchmarks.common.study import seeded
from foredrive.data import LogPath, find_all_logs
from foredrive.driver.recipes import DRIVER_RECIPES, DriverRecipe
from foredrive.driving.drive_record import DriveRecord
from foredrive.driving.route_sets import load_route_set
from foredrive.errors import InputError
from foredrive.methods.recipe import rescheduled
from foredrive.runs.drive.agent_inputs import rig_of
from foredrive.runs.drive.agents import CONSTANT_VELOCITY, EXPERT, IDM, STOP
from foredrive.runs.drive.compare import compare, read_agent, values_of
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.suite import DriveSuite, SuiteResult, drive_suite
from foredrive.runs.recipes.known import find_recipe
from foredrive.runs.shipped import run_folder
from foredrive.runs.train.driver import DriverRun
from foredrive.runs.train.run import train_run
from foredrive.sensors.rigs import FRONT_TELE, SURROUND
from foredrive.tasks.bootstrap import bootstrap_mean

EGO_SEEDS, SAME_EGO_SEEDS, SAME_EPOCHS, TAUGHT_SIGN_SEEDS = 8, 3, 2, 4
"""Seeds of the towns from which the small driver learns; those from which all drivers of NeMo's claim do, and
how often; those of the tiles with stop signs from which the shipped driver learns on."""
SEEDS = (0, 1, 2)
ROUNDS = 2
ROUND_ROUTES, ROUND_LR, ROUND_EPOCHS = "training-short", 1e-3, 2
"""Routes of a round, and the learning rate and the epochs in which a driver goes on."""
SHIPPED, PARTS = "embedded:driver", ("true", "true-lights", "true-users", "idm")
"""The driver that comes with the package, and agents of which it is a part."""
LEFT_OUT = ("Town03", "Town07", "Town10HD")
REGRESSING, REGRESSING_STEPS = "nemo_drive", 600
DEMONSTRATED, ROUTES_A_TOWN = ("Town01", "Town02", "Town03", "Town04", "Town06"), 4
"""Towns of the demonstrations, and the routes in each."""
JUDGED = {
    "short": "town05-short",
    "long": "town05-long",
    "unseen_short": "unseen-short",
    "unseen_long": "unseen-long",
}
REPETITIONS = {"short": 2}
CORES = len(os.sched_getaffinity(0))
CONFIG = {
    "recipes": {name: dataclasses.asdict(recipe) for name, recipe in DRIVER_RECIPES.items()}
    | {REGRESSING: dataclasses.asdict(find_recipe(REGRESSING))},
    "egos": [EGOS, EGO_SEEDS, SIGN_TILES, SAME_EGO_SEEDS, SAME_EPOCHS, TAUGHT_SIGN_SEEDS],
    "rounds": [ROUNDS, ROUND_ROUTES, ROUND_LR, ROUND_EPOCHS],
    "demonstrations": [*DEMONSTRATED, ROUTES_A_TOWN, REGRESSING_STEPS],
    "routes": JUDGED,
    "repetitions": REPETITIONS,
}
DECIDED_BY = (
    "foredrive.driving",
    "foredrive.towns",
    "foredrive.methods",
    "foredrive.tasks",
    "foredrive.engine",
    "foredrive.data",
)
WORK = Path("runs/drive_nemo") / study_identity(CONFIG, DECIDED_BY)


def _driven(suite: DriveSuite, out: Path) -> SuiteResult:
    driven = drive_suite(suite, out, CORES)
    if driven.broken:
        job, why = next(iter(driven.broken.items()))
        raise InputError(f"{len(driven.broken)} drives failed, {job.name}: {why}")
    return driven


def _agent(run: DriverRun) -> str:
    return str(run.folder.absolute())


def small(rounds: int, seed: int) -> DriverRun:
    """Return the small driver after some rounds of DAgger; train and drive what is missing."""
    recipe, folder = recipe_of("driver_small", seed), WORK / "runs" / f"small_{rounds}_seed{seed}"
    if rounds == 0:
        return trained(recipe, _all_egos(), folder, WORK / "cache")
    start = small(rounds - 1, seed).folder
    logs = [*_all_egos(), *rounds_until(rounds, small, "round")]
    return trained(_once(recipe), logs, folder, WORK / "cache", start)


def taught(rounds: int, seed: int) -> DriverRun:
    """Return the shipped driver, which has learned on with stop signs and some rounds of DAgger."""
    start = run_folder(Path(SHIPPED)) if rounds == 0 else taught(rounds - 1, seed).folder
    logs = [
        *_egos(SAME_EGO_SEEDS),
        *_sign_egos(TAUGHT_SIGN_SEEDS),
        *rounds_until(rounds, taught, "taught_round"),
    ]
    folder = WORK / "runs" / f"taught_{rounds}_seed{seed}"
    return trained(_once(recipe_of("driver_small", seed)), logs, folder, WORK / "cache", start)


def _once(recipe: DriverRecipe) -> DriverRecipe:
    see = dataclasses.replace(recipe.see, epochs=ROUND_EPOCHS, lr=ROUND_LR)
    return dataclasses.replace(recipe, see=see)


def rounds_until(last: int, driver: Callable[[int, int], DriverRun], name: str) -> list[LogPath]:
    """Return the logs of the rounds of DAgger up to one; drive what is missing.

    Args:
        driver: gives the driver after some rounds, of a seed.
        name: of the rounds' folders.
    """
    folders = []
    for number in range(1, last + 1):
        source = TownRoutes(ROUND_ROUTES, seed=number, conditions="any", rig=FRONT_TELE)
        folder = WORK / "rounds" / f"{name}{number}"
        _driven(DriveSuite(_agent(driver(number - 1, 0)), source, lidar=False), folder)
        folders.append(folder)
    return list(find_all_logs(folders))


def _egos(seeds: int) -> list[LogPath]:
    return egos(range(seeds), WORK / "egos", CORES)


def _sign_egos(seeds: int) -> list[LogPath]:
    return egos(range(seeds), WORK / "egos", CORES, towns=SIGN_TILES)


def _all_egos() -> list[LogPath]:
    """Return the egos of all seeds, with those of tiles that have many stop signs."""
    return [*_egos(EGO_SEEDS), *_sign_egos(EGO_SEEDS)]


def blind(seed: int) -> DriverRun:
    """Return the small driver that sees black images and learned from the same clips."""
    recipe = recipe_of("driver_small", seed)
    recipe = dataclasses.replace(recipe, eyes=dataclasses.replace(recipe.eyes, blind=True))
    logs = [*_all_egos(), *rounds_until(ROUNDS, small, "round")]
    return trained(recipe, logs, WORK / "runs" / f"small_blind_seed{seed}", WORK / "cache")


def same(name: str, recipe: str, seed: int, start: Path | None = None, *, blind: bool = False) -> DriverRun:
    """Return a driver of NeMo's claim."""
    chosen = _same_recipe(recipe, seed)
    chosen = dataclasses.replace(chosen, eyes=dataclasses.replace(chosen.eyes, blind=blind))
    folder = WORK / "runs" / f"{name}_seed{seed}"
    return trained(chosen, _egos(SAME_EGO_SEEDS), folder, WORK / "cache", start)


def _same_recipe(recipe: str, seed: int) -> DriverRecipe:
    chosen = recipe_of(recipe, seed)
    return dataclasses.replace(chosen, see=dataclasses.replace(chosen.see, epochs=SAME_EPOCHS))


def regressing(seed: int) -> Path:
    """Return the run of NeMo's own planner, trained on drives of the disturbed expert."""
    recipe = seeded(find_recipe(REGRESSING), seed)
    recipe = dataclasses.replace(recipe, finetune=rescheduled(recipe.finetune, steps=REGRESSING_STEPS))
    source = TownRoutes(ROUND_ROUTES, conditions="any", rig=SURROUND)
    shown = [
        job.route
        for town in DEMONSTRATED
        for job in [job for job in source.jobs(EXPERT) if source.route_of(job).town == town][:ROUTES_A_TOWN]
    ]
    folder = WORK / "demonstrations"
    _driven(DriveSuite("disturbed", dataclasses.replace(source, only=tuple(shown))), folder)
    run = train_run(
        recipe,
        find_all_logs([folder]),
        WORK / "runs" / f"regressing_seed{seed}",
        WORK / "cache",
        run_folder(Path(PRETRAINED)),
    )
    return run.folder.absolute()


def scores(agent: str, name: str, routes: str) -> dict[str, float]:
    """Return the figures of an agent on a set of routes, with 95 % intervals over routes."""
    drives = _judged(agent, name, routes).drives
    return {f"{key}_{routes}": value for key, value in _figures(list(drives.values())).items()}


def _judged(agent: str, name: str, routes: str) -> SuiteResult:
    source = TownRoutes(JUDGED[routes], repetitions=REPETITIONS.get(routes, 1), rig=rig_of(agent))
    return _driven(DriveSuite(agent, source, sensors=False), _folder(name, routes))


def _folder(name: str, routes: str) -> Path:
    return WORK / "drives" / f"{name}_{routes}"


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


def by_sight(name: str, run_of: Callable[[int], DriverRun], prefix: str = "") -> Arm:
    """Return an arm of a driver, or of an agent that is named by a prefix before the driver's run.

    A driver is also judged by what it saw of virtual egos and on its own way.
    """

    def measure(seed: int, routes: str) -> Mapping[str, float]:
        run, arm = run_of(seed), f"{name}_seed{seed}"
        figures = scores(prefix + _agent(run), arm, routes)
        if prefix:
            return figures
        cache, drives = WORK / "cache", _judged(_agent(run), arm, routes).drives
        met = figures_on_its_way(
            run, {job.name: drive for job, drive in drives.items()}, _folder(arm, routes), cache
        )
        seen = sight_figures(run, test_egos(WORK / "egos", CORES), cache)
        return {**seen, **{f"{key}_{routes}": value for key, value in met.items()}, **figures}

    return measure


def untrained(agent: str, name: str) -> Arm:
    """Return an arm of an agent that learns nothing: all seeds are the same drives."""
    return lambda seed, routes: scores(agent, name, routes)


def _best(seed: int) -> DriverRun:
    return small(ROUNDS, seed)


def by_leaderboard(seed: int, routes: str) -> Mapping[str, float]:
    """Return the figures of the shipped driver through the interface of CARLA's leaderboards."""
    source = LeaderboardDoor(JUDGED[routes], rig=rig_of(SHIPPED))
    drives = _driven(
        DriveSuite(SHIPPED, source, sensors=False), _folder("shipped_by_leaderboard", routes)
    ).drives
    return {f"{key}_{routes}": value for key, value in _figures(list(drives.values())).items()}


WITH_NEMO: Mapping[str, Callable[[int], DriverRun]] = {
    "same_small": lambda seed: same("same_small", "driver_small", seed),
    "same_nemo": lambda seed: same("same_nemo", "driver_nemo", seed, run_folder(Path(PRETRAINED))),
    "same_nemo_scratch": lambda seed: same("same_nemo_scratch", "driver_nemo", seed),
    "same_nemo_blind": lambda seed: same("same_nemo_blind", "driver_nemo", seed, blind=True),
}


def left_out(town: str, seed: int) -> Mapping[str, float]:
    """Return the scores in a town of a driver that never was there, and of one that was."""
    logs = [log for log in _egos(SAME_EGO_SEEDS) if not log.folder.name.startswith(f"{town}_")]
    name = f"left_out_{town}_seed{seed}"
    runs = {
        "": trained(_same_recipe("driver_small", seed), logs, WORK / "runs" / name, WORK / "cache"),
        "_seen": WITH_NEMO["same_small"](seed),
    }
    routes = tuple(route.id for route in load_route_set(ROUND_ROUTES) if route.town == town)
    figures: dict[str, float] = {}
    for ending, run in runs.items():
        source = TownRoutes(ROUND_ROUTES, repetitions=2, rig=FRONT_TELE, only=routes)
        drives = _driven(DriveSuite(_agent(run), source, sensors=False), _folder(name, f"town{ending}"))
        found = _figures(list(drives.drives.values()))
        figures |= {f"{key}_town{ending}": found[key] for key in ("ds", "rc", "red_lights", "collisions")}
    return figures


def gain(seed: int, routes: str) -> Mapping[str, float]:
    """Return what pre-training gains, with 95 % intervals over routes and trainings.

    All seeds are compared at once, so the seed of the benchmark only seeds the bootstrap.
    """
    names = ("same_nemo_scratch", "same_nemo")
    for name in names:
        for trained_with in SEEDS:
            _judged(_agent(WITH_NEMO[name](trained_with)), f"{name}_seed{trained_with}", routes)
    folders = [",".join(str(_folder(f"{name}_seed{of}", routes)) for of in SEEDS) for name in names]
    agents = [read_agent(f"{name}={folder}") for name, folder in zip(names, folders, strict=True)]
    differences = compare(agents, seed).differences
    return {
        f"{metric}_{bound}_{routes}": getattr(differences[metric]["same_nemo"], bound)
        for metric in ("driving_score_1_0", "red_lights", "collisions")
        for bound in ("mean", "low", "high")
    }


ARMS: Mapping[str, Arm] = {
    "shipped": untrained(SHIPPED, "shipped"),
    "shipped_by_leaderboard": by_leaderboard,
    **{
        f"shipped_{part.replace('-', '_')}": untrained(f"{part}:{SHIPPED}", f"shipped_{part}")
        for part in PARTS
    },
    "expert": untrained(EXPERT, "expert"),
    "idm": untrained(IDM, "idm"),
    "stop": untrained(STOP, "stop"),
    "constant_velocity": untrained(CONSTANT_VELOCITY, "constant_velocity"),
    **{
        f"small_{rounds}": by_sight(f"small_{rounds}", partial(small, rounds)) for rounds in range(ROUNDS + 1)
    },
    **{
        f"taught_{rounds}": by_sight(f"taught_{rounds}", partial(taught, rounds))
        for rounds in range(ROUNDS + 1)
    },
    "small_blind": by_sight("small_blind", blind),
    **{name: by_sight(name, run_of) for name, run_of in WITH_NEMO.items()},
    "rules_by_sight": by_sight("rules_by_sight", _best, "idm:"),
    "true": by_sight("true", _best, "true:"),
    "true_lights": by_sight("true_lights", _best, "true-lights:"),
    "true_users": by_sight("true_users", _best, "true-users:"),
    "regressing": lambda seed, routes: scores(str(regressing(seed)), f"regressing_seed{seed}", routes),
}


def _of_routes(arm: Arm, routes: str) -> Callable[[int], Mapping[str, float]]:
    return lambda seed: arm(seed, routes)


BENCHMARK = Benchmark(
    question="How well do drivers drive by sight, in Town05 and in towns that nothing was chosen for?",
    arms={
        name if routes == "short" else f"{name}@{routes}": _of_routes(arm, routes)
        for routes in JUDGED
        for name, arm in {**ARMS, "gain": gain}.items()
    }
    | {f"left_out_{town}": partial(left_out, town) for town in LEFT_OUT},
    seeds=SEEDS,
    config=CONFIG,
    decided_by=DECIDED_BY,
)
