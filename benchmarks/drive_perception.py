"""Measures what drivers see of Town05 before any planning: `foredrive bench drive-perception`, hours.

Virtual egos of the seven training towns teach the eyes of a driver; 1,500 clips of Town05 judge them, by day.
`N_seeds` is the learning curve: 2,100 clips for each seed of the towns, and as many epochs. `history_K` reads
K key frames, `blind` black images. `nemo`, `nemo_frozen` and `nemo_scratch` have NeMo's volume as their eyes:
pre-trained and trained on, kept as it is, or from fresh weights.

Recordings, packed clips and runs are kept in runs/drive_perception, where an interrupted arm goes on.
"""

import dataclasses
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from benchmarks.common.benchmark import Benchmark, study_identity
from benchmarks.common.driver_study import (
    EGOS,
    PRETRAINED,
    TEST_EGOS,
    egos,
    recipe_of,
    sight_figures,
    test_egos,
    trained,
)
from foredrive.driver.recipes import DRIVER_RECIPES, DriverRecipe
from foredrive.runs.shipped import run_folder
from foredrive.sensors.rigs import FRONT_TELE

CURVE = (1, 2, 5, 10, 19)
"""Seeds of the towns that each point of the learning curve learns from: 2,100 to 40,000 clips."""
SEEDS_OF_ARMS = 5
"""Seeds of the towns that the other arms learn from."""
CORES = len(os.sched_getaffinity(0))
DECIDED_BY = (
    "foredrive.driver",
    "foredrive.data.truth.affordances",
    "foredrive.geometry",
    "foredrive.towns",
)
CONFIG = {
    "recipes": {name: dataclasses.asdict(recipe) for name, recipe in DRIVER_RECIPES.items()},
    "egos": [EGOS, TEST_EGOS],
    "rig": dataclasses.asdict(FRONT_TELE),
    "seeds": [*CURVE, SEEDS_OF_ARMS],
}
WORK = Path("runs/drive_perception") / study_identity(CONFIG, DECIDED_BY)
Change = Callable[[DriverRecipe], DriverRecipe]


def sees(
    arm: str,
    seed: int,
    towns: int = SEEDS_OF_ARMS,
    recipe: str = "driver_small",
    change: Change = lambda recipe: recipe,
    pretrained: bool = False,
) -> Mapping[str, float]:
    """Return the figures of an arm; its driver is kept for other benchmarks."""
    logs = egos(range(towns), WORK / "egos", CORES)
    run = trained(
        recipe_of(recipe, seed, change),
        logs,
        WORK / "runs" / f"{arm}_seed{seed}",
        WORK / "cache",
        run_folder(Path(PRETRAINED)) if pretrained else None,
    )
    return {**sight_figures(run, test_egos(WORK / "egos", CORES), WORK / "cache"), "logs": float(len(logs))}


def with_frames(frames: int) -> Change:
    """Return the change of a recipe to another number of key frames."""
    return lambda recipe: dataclasses.replace(
        recipe,
        eyes=dataclasses.replace(recipe.eyes, frames=frames),
        clips=dataclasses.replace(recipe.clips, past_frames=frames - 1),
    )


def with_eyes(**changes: Any) -> Change:
    """Return the change of entries of a recipe's eyes."""
    return lambda recipe: dataclasses.replace(recipe, eyes=dataclasses.replace(recipe.eyes, **changes))


def arm(name: str, **choices: Any) -> Callable[[int], Mapping[str, float]]:
    """Return an arm; the choices are those of `sees`."""
    return lambda seed: sees(name, seed, **choices)


BENCHMARK = Benchmark(
    question="What do drivers see of lights and road users on their route, and what would more data bring?",
    arms={
        **{f"{count}_seeds": arm(f"{count}_seeds", towns=count) for count in CURVE},
        **{f"history_{k}": arm(f"history_{k}", change=with_frames(k)) for k in (1, 3)},
        "blind": arm("blind", change=with_eyes(blind=True)),
        "nemo": arm("nemo", recipe="driver_nemo", pretrained=True),
        "nemo_frozen": arm(
            "nemo_frozen", recipe="driver_nemo", change=with_eyes(frozen=True), pretrained=True
        ),
        "nemo_scratch": arm("nemo_scratch", recipe="driver_nemo"),
    },
    config=CONFIG,
    decided_by=DECIDED_BY,
)
