"""Safety tests after NeuroNCAP in reconstructed towns and in PandaSet 002: `foredrive bench ncap`, hours.

Three drives of 20 s are recorded with seven cameras and a lidar, and reconstructed in runs/safety_rebuilds,
for `ncap-transfer` too. In each reconstruction, up to four scenarios of each kind are driven four times by
each agent, under our rules, and by some under those of the paper and of its released code. `suite_minutes`
counts the drives of one suite alone, with the sensors that the agent needs. Intervals (`score_low`,
`score_high`) hold 95 % over the runs of a town; the figures of an arm are means over its towns. PandaSet
002 lasts 5.5 s, and a proposed scenario 6 s or more: its arm counts the scenarios that are feasible there.

An arm AGENT@TOWN is a suite of drives in runs/ncap; an interrupted one goes on with the next drive.
"""

import dataclasses
import functools
import os
from pathlib import Path

from benchmarks.common.benchmark import Benchmark, study_identity
from benchmarks.common.safety_suites import (
    DRIVES,
    RECONSTRUCTION,
    SuiteSize,
    driven_suite,
    reconstructed_town,
)
from benchmarks.common.study import pandaset_log
from foredrive.errors import InputError
from foredrive.runs.drive.in_ncap import propose_scenarios
from foredrive.runs.recipes.reconstruction import gaussians_tiny
from foredrive.runs.reconstruction.reconstruct import reconstruct

SIZE = SuiteSize(runs=4)
WORKERS = len(os.sched_getaffinity(0))
NEMO = "embedded:nemo_town"
AGENTS = {
    "stop": ("stop", "ours"),
    "constant_velocity": ("constant-velocity", "ours"),
    "log_replay": ("log", "ours"),
    "ego_mlp": (f"ego-mlp:{NEMO}", "ours"),
    "nemo_cameras": (NEMO, "ours"),
    "driver": ("embedded", "ours"),
    "idm_by_sight": ("idm:embedded", "ours"),
    "corridor_lidar": ("lidar-corridor", "ours"),
    "expert": ("expert", "ours"),
    "stop_paper": ("stop", "paper"),
    "nemo_cameras_paper": (NEMO, "paper"),
    "driver_paper": ("embedded", "paper"),
    "corridor_lidar_paper": ("lidar-corridor", "paper"),
    "nemo_cameras_released": (NEMO, "released"),
    "driver_released": ("embedded", "released"),
    "corridor_lidar_released": ("lidar-corridor", "released"),
}
"""Agent and rules of each arm."""
CONFIG = {
    "rebuilding": RECONSTRUCTION,
    "size": dataclasses.asdict(SIZE),
    "agents": {arm: list(of) for arm, of in AGENTS.items()},
}
DECIDED_BY = (
    "benchmarks.common.safety_suites",
    "foredrive.methods.reconstruction",
    "foredrive.driving.collisions",
    "foredrive.driving.controller",
    "foredrive.driving.dynamics",
    "foredrive.driving.ncap",
    "foredrive.driving.replay.reconstructed",
    "foredrive.methods.splatad.training",
)
WORK = Path("runs/ncap") / study_identity(CONFIG, DECIDED_BY)


def in_town(arm: str, town: str, _: int) -> dict[str, float]:
    """Return the figures of a suite in a reconstructed town."""
    drive = next(drive for drive in DRIVES if drive.town == town)
    agent, rules = AGENTS[arm]
    return driven_suite(agent, rules, reconstructed_town(drive), SIZE, WORK, arm, WORKERS)


def in_pandaset(_: int) -> dict[str, float]:
    """Return the number of scenarios that are feasible in PandaSet 002."""
    folder, file = WORK / "rebuilt" / "pandaset_002", WORK / "rebuilt" / "pandaset_002.yaml"
    reconstruct(gaussians_tiny(), pandaset_log(Path("runs/ncap/pandaset")), folder, WORK / "cache")
    file.unlink(missing_ok=True)
    try:
        return {"scenarios": float(len(propose_scenarios((str(folder),), file, "ours", SIZE.runs).passed))}
    except InputError:
        return {"scenarios": 0.0}


BENCHMARK = Benchmark(
    question="How safely do agents drive where a vehicle stands, comes head-on or crosses, in a "
    "reconstruction?",
    arms={
        f"{arm}@{drive.town}": functools.partial(in_town, arm, drive.town)
        for drive in DRIVES
        for arm in AGENTS
    }
    | {"pandaset_002": in_pandaset},
    seeds=(0,),
    config=CONFIG,
    decided_by=DECIDED_BY,
)
