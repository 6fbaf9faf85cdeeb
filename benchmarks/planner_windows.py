"""Gain of perfect sight by the traffic that a planner learns from: `foredrive bench planner-windows`.

The planners of planner_reads that see the true map, boxes and lights learn from more windows of traffic, of
which few egos are taken, without images. Each number of windows has an ego-only MLP of its own, which its
planner corrects and is judged against.
"""

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from pathlib import Path

import torch

from benchmarks.common.benchmark import Benchmark, study_identity
from benchmarks.common.true_planes import TruePlanes, kept, read_planes
from benchmarks.planner_reads import (
    EGO_FIT,
    READ,
    READ_FIT,
    RECIPE,
    TEST_TOWNS,
    TRAIN_TOWNS,
    PathStudy,
    fitted_mlp,
    read_along,
    study_of,
)
from foredrive.data import LogPath
from foredrive.errors import InputError
from foredrive.runs.drive.recording import EgosPlan, record_egos
from foredrive.sensors.rigs import SURROUND, RigPlan

SEEDS, JUDGED_SEED, EGOS, PER_WINDOW = (2100, 2101), 3100, 240, 4
"""Seeds of traffic, to learn from and to judge by; egos of each town and seed; those of the same time."""
WINDOWS = (90, 240, 720)
STEPS = {90: READ_FIT.steps, 240: 2500, 720: 4000}
"""Steps of a fit, by the number of windows."""
CONFIG = {
    "towns": [TRAIN_TOWNS, TEST_TOWNS, SEEDS, JUDGED_SEED, EGOS, PER_WINDOW],
    "fits": [dataclasses.asdict(value) for value in (EGO_FIT, READ, READ_FIT)],
    "steps": [STEPS[windows] for windows in WINDOWS],
}
DECIDED_BY = (
    "benchmarks.common.true_planes",
    "benchmarks.planner_reads",
    "benchmarks.planner_windows",
    "foredrive.methods.planner",
    "foredrive.towns.traffic",
    "foredrive.towns.virtual_egos",
)
WORK = Path("runs/planner_windows") / study_identity(CONFIG, DECIDED_BY)


def recorded(towns: Sequence[str], seeds: Sequence[int], workers: int = 1) -> tuple[LogPath, ...]:
    """Record the virtual egos that are missing; return them."""
    plans = [EgosPlan(town, seed, EGOS, per_window=PER_WINDOW) for seed in seeds for town in towns]
    # A log has images: these have eight pixels, which nobody reads
    rig = RigPlan((2, 4), dict(itertools.islice(SURROUND.cameras.items(), 1)))
    logs, failed = record_egos(plans, WORK / "egos", rig, workers)
    if failed:
        raise InputError(f"{len(failed)} recordings failed: {next(iter(failed.values()))}")
    return tuple(logs)


@functools.cache
def egos_to_learn() -> TruePlanes:
    """Return the true surroundings of the egos to learn from."""
    logs = functools.partial(recorded, TRAIN_TOWNS, SEEDS)
    return kept(TruePlanes, WORK / "train.safetensors", lambda: read_planes(logs(), RECIPE.clips))


@functools.cache
def egos_to_judge() -> TruePlanes:
    """Return the true surroundings of the egos to judge by."""
    logs = functools.partial(recorded, TEST_TOWNS, (JUDGED_SEED,))
    return kept(TruePlanes, WORK / "test.safetensors", lambda: read_planes(logs(), RECIPE.clips))


@functools.cache
def study(windows: int, *, blind: bool) -> PathStudy:
    """Return demonstrations of the egos of some windows, drawn at random from all towns and seeds."""
    egos = egos_to_learn()
    order = torch.randperm(int(egos.window.max()) + 1, generator=torch.Generator().manual_seed(0))
    chosen = egos[torch.isin(egos.window, order[:windows])]
    demonstrations = study_of(chosen, egos_to_judge(), fitted_mlp(chosen), blind=blind)
    return demonstrations._replace(judged_egos=EGOS)


BENCHMARK = Benchmark(
    question="How much more does perfect sight gain a planner that has learned from more traffic?",
    arms={
        f"{'blind' if blind else 'true'}_{windows}": read_along(
            functools.partial(study, windows, blind=blind),
            dataclasses.replace(READ_FIT, steps=STEPS[windows]),
        )
        for windows in WINDOWS
        for blind in (False, True)
    },
    config=CONFIG,
    decided_by=DECIDED_BY,
)
