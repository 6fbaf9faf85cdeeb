"""Score the privileged expert on Town05, as the upper bound of students: `foredrive bench drive-expert`.

Drives are kept in runs/drive_expert/COMMIT, so that an interrupted benchmark continues with the next route.
"""

import functools
import os
from collections.abc import Mapping
from pathlib import Path

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.study import work_folder
from foredrive.engine.summary import numbers
from foredrive.errors import InputError
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.records import summarise
from foredrive.runs.drive.suite import DriveSuite, drive_suite

WORK = work_folder(Path("runs/drive_expert"))
SETS = {"short": "town05-short", "long": "town05-long"}
FIGURES = (
    "driving_score_1_0",
    "driving_score_2_1",
    "completion",
    "comfortable_share",
    "near_collision_share",
)


def scores(seed: int, name: str) -> Mapping[str, float]:
    """Return the metrics of one repetition of a set of routes."""
    suite = DriveSuite("expert", TownRoutes(SETS[name], seed=seed), sensors=False)
    driven = drive_suite(suite, WORK / f"{name}_seed{seed}", workers=len(os.sched_getaffinity(0)))
    if driven.broken:
        job, why = next(iter(driven.broken.items()))
        raise InputError(f"{len(driven.broken)} drives failed, {job.name}: {why}")
    summary = numbers(summarise(list(driven.drives.values())))
    kept = [key for key in summary if key in FIGURES or key.startswith(("infractions.", "endings."))]
    short = {"driving_score_1_0": "ds", "driving_score_2_1": "ds_2_1", "completion": "rc"}
    return {f"{short.get(key, key)}_{name}": summary[key] for key in kept}


BENCHMARK = Benchmark(
    question="How well does the privileged expert drive Town05's routes?",
    arms={name: functools.partial(scores, name=name) for name in SETS},
    config={"sets": SETS},
)
