"""Closed-loop driving of NeMo with and without pre-training: `foredrive bench drive-nemo`, many hours.

DAgger demonstrations are driven in the training towns, and `nemo_drive` is trained on them. Every run drives
the routes of Town05, as do the MLP that it starts from and constant velocity. Everything is kept in
runs/drive_nemo/COMMIT, so that an interrupted benchmark continues with the next drive or run.
"""

import dataclasses
import os
from collections.abc import Callable, Mapping
from pathlib import Path

from benchmarks.common.study import HEADLINE, JUDGED_EVERY_S, seeded, work_folder
from foredrive.data import LogPath
from foredrive.errors import InputError
from foredrive.evaluation.bench import Benchmark
from foredrive.evaluation.summary import read_summary
from foredrive.recipes import find_recipe
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.recording import record_drives
from foredrive.runs.drive.records import summarise
from foredrive.runs.drive.suite import DriveSuite, SuiteResult, drive_suite
from foredrive.runs.evaluate.run import SUMMARY, evaluate_run
from foredrive.runs.train.run import train_run
from foredrive.sensors.rigs import SURROUND
from foredrive.towns.campaign import Campaign, plan_drives

WORK = work_folder(Path("runs/drive_nemo"))
RECIPE = "nemo_drive"
DEMONSTRATIONS = ("training-short", "training-long")
JUDGED = {"short": "town05-short", "long": "town05-long"}
OPEN_LOOP = Campaign(("Town05",), seeds=tuple(range(1, 7)), seconds=60.0, rate_hz=2.0)
CORES = len(os.sched_getaffinity(0))


def _driven(suite: DriveSuite, out: Path) -> SuiteResult:
    driven = drive_suite(suite, out, CORES)
    if driven.broken:
        job, why = next(iter(driven.broken.items()))
        raise InputError(f"{len(driven.broken)} drives failed, {job.name}: {why}")
    return driven


def _demonstrations() -> tuple[LogPath, ...]:
    folders = [WORK / "demonstrations" / name for name in DEMONSTRATIONS]
    for name, folder in zip(DEMONSTRATIONS, folders, strict=True):
        _driven(DriveSuite("disturbed", TownRoutes(name)), folder)
    return find_all_logs(folders)


def _scores(agent: str, name: str, seed: int) -> dict[str, float]:
    """Return the metrics of one repetition of each set of routes; the seed selects the repetition."""
    figures = {}
    for short, routes in JUDGED.items():
        suite = DriveSuite(agent, TownRoutes(routes, seed=seed), sensors=False)
        summary = summarise(
            list(_driven(suite, WORK / "drives" / f"{name}_{short}_seed{seed}").drives.values())
        )
        kept = {
            "driving_score_1_0": "ds",
            "driving_score_2_1": "ds_2_1",
            "completion": "rc",
            "failed": "failed",
        }
        kept |= {key: key for key in summary if key.startswith(("infractions.", "endings."))}
        figures |= {f"{kept[key]}_{short}": float(summary[key] or 0.0) for key in kept}
    return figures


def learned(pretrained: bool) -> Callable[[int], Mapping[str, float]]:
    """Return an arm of `nemo_drive`, pre-trained on the demonstrations or trained from scratch."""

    def measure(seed: int) -> Mapping[str, float]:
        recipe, name = seeded(find_recipe(RECIPE), seed), "pretrained" if pretrained else "scratch"
        if not pretrained:
            recipe = dataclasses.replace(recipe, pretrain=None)
        folder = WORK / "runs" / f"{name}_seed{seed}"
        run = train_run(recipe, _demonstrations(), folder, WORK / "cache")
        if not (folder / SUMMARY).is_file():
            recorded = record_drives(plan_drives(OPEN_LOOP), WORK / "towns", SURROUND, CORES)
            logs = tuple(recorded.logs.values())
            evaluate_run(run, logs, folder, batch_size=8, views=False, stride_s=JUDGED_EVERY_S)
        l2_m = read_summary(folder / SUMMARY)[f"planning.{HEADLINE}.l2_avg_m"]
        return {"l2_avg_m": float(l2_m or 0.0), **_scores(str(folder.absolute()), name, seed)}

    return measure


def ego_mlp(seed: int) -> Mapping[str, float]:
    """Score the MLP that the runs start from; it uses no sensors."""
    folder = (WORK / "runs" / f"pretrained_seed{seed}").absolute()
    if not folder.is_dir():
        learned(pretrained=True)(seed)
    return _scores(f"ego-mlp:{folder}", "ego_mlp", seed)


def constant_velocity(seed: int) -> Mapping[str, float]:
    """Score driving straight on at 5 m/s."""
    return _scores("constant-velocity", "constant_velocity", seed)


BENCHMARK = Benchmark(
    question="How well does NeMo drive Town05's routes, and does pre-training help it to?",
    arms={
        "constant_velocity": constant_velocity,
        "pretrained": learned(pretrained=True),
        "scratch": learned(pretrained=False),
        "ego_mlp": ego_mlp,
    },
    config={
        "recipe": dataclasses.asdict(find_recipe(RECIPE)),
        "demonstrations": DEMONSTRATIONS,
        "routes": JUDGED,
    },
)
