"""The demo without its pictures: all steps of the loop, each in its own part of one folder.

The folder is a 123D data root. What an earlier call has finished is not done again.
"""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from foredrive.data import LogPath
from foredrive.data.clip_list import write_clip_list
from foredrive.driving.drive_record import DriveRecord
from foredrive.driving.replay.threats import Threat
from foredrive.engine.folder import SUMMARY
from foredrive.engine.summary import Summary, read_summary
from foredrive.errors import InputError
from foredrive.methods.nemo.recipes import nemo_tiny
from foredrive.methods.recipe import Recipe, rescheduled
from foredrive.runs.drive.agent_inputs import rig_of
from foredrive.runs.drive.agents import CORRIDOR, EXPERT, REPLAY
from foredrive.runs.drive.in_reconstruction import ReconstructedRoutes
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.recording import log_of, record_drives
from foredrive.runs.drive.suite import DriveSuite, drive_suite
from foredrive.runs.evaluate.run import ExamplePrediction, evaluate_run, predict_examples
from foredrive.runs.recipes.reconstruction import ReconstructionRecipe, gaussians_tiny, rescheduled_recipe
from foredrive.runs.reconstruction.reconstruct import Reconstruction
from foredrive.runs.reconstruction.reconstruct import reconstruct as reconstruct_log
from foredrive.runs.search.indexing import index_logs
from foredrive.runs.search.searching import ask, listed_clips
from foredrive.runs.search.towers import EMBEDDED
from foredrive.runs.shipped import run_folder
from foredrive.runs.train.run import Run, open_run, train_run
from foredrive.scene.conditions import BackgroundTraffic
from foredrive.search.find import Hit
from foredrive.search.index import FrameIndex
from foredrive.search.query import Query
from foredrive.sensors.rigs import SURROUND
from foredrive.towns.campaign import DrivePlan

SHIPPED = "embedded:nemo_town"
"""The world model that sees."""
DRIVER = "embedded"
"""The driver by sight."""
ROUTES = "town05-short"
MET_BY = (REPLAY, CORRIDOR)
"""Agents that meet the car in their way: one replays the recorded drive, the other one uses the lidar."""
TEXTS = ("a pedestrian close by", "a street at night")
HITS = 3
STRIDE_S = 0.5
BEFORE_S, AFTER_S = 2.0, 4.0
"""The part of a log around a hit that goes into the list of clips, s."""


@dataclass(frozen=True)
class DemoSize:
    """The amount of recorded data and of computing."""

    train: tuple[DrivePlan, ...]
    test: DrivePlan
    """The drive through the town that no model was trained on."""
    reconstructed: DrivePlan
    """The drive that is reconstructed."""
    recipe: Recipe
    reconstruction: ReconstructionRecipe
    route: str
    """Id of the route of `ROUTES` that is driven."""
    examples: int
    """Number of moments that models are asked about for the pictures."""
    minutes: Mapping[str, int] = field(default_factory=dict)
    """Expected time of each step on two cores, min, by its title; without those that take seconds."""


@dataclass(frozen=True)
class Demo:
    """A demo and its folder."""

    size: DemoSize
    out: Path

    @property
    def plans(self) -> tuple[DrivePlan, ...]:
        """Return all drives to record, each once."""
        return tuple(dict.fromkeys((*self.size.train, self.size.test, self.size.reconstructed)))


@dataclass(frozen=True)
class Judged:
    """A model on the held-out drive."""

    run: Run
    logs: list[LogPath]
    summary: Summary
    examples: list[ExamplePrediction]


@dataclass(frozen=True)
class Driven:
    """One drive, in the folder of its suite."""

    folder: Path
    name: str
    record: DriveRecord


@dataclass(frozen=True)
class Reconstructed:
    """A reconstructed drive, and the drive of each agent that met a car in it."""

    scene: Reconstruction
    met: dict[str, Driven]


@dataclass(frozen=True)
class Found:
    """The best hits of a query."""

    query: Query
    hits: list[Hit]


def full_demo() -> DemoSize:
    """Return the full size: minutes on two cores."""
    return DemoSize(
        train=tuple(
            plan_drive(*drive, seconds=60.0)
            for drive in (("Town01", 1), ("Town03", 1), ("Town10HD", 1, "night"))
        ),
        test=plan_drive("Town05", 1, seconds=30.0),
        reconstructed=plan_drive("Town05", 7, seconds=8.0, rate_hz=10.0),
        recipe=nemo_tiny(),
        reconstruction=dataclasses.replace(
            rescheduled_recipe(gaussians_tiny(), steps=300), image_hw=SURROUND.image_hw
        ),
        route="12",
        examples=4,
        # Estimates from speeds in benchmarks/results (towns, real-to-sim) and the training time in README
        minutes={"Record": 2, "See": 1, "Learn": 10, "Drive": 2, "Reconstruct": 3, "Search": 1},
    )


def quick_demo() -> DemoSize:
    """Return a size with the same steps that takes about a minute. Its model learns nothing useful."""
    tiny, few = nemo_tiny(), {"batch_size": 2, "warmup_steps": 2}
    test = plan_drive("Town05", 7, seconds=6.0, rate_hz=4.0)
    return DemoSize(
        train=(plan_drive("Town02", 1, "night", seconds=6.0),),
        test=test,
        reconstructed=test,
        recipe=dataclasses.replace(
            tiny,
            name="nemo_tiny (quick)",
            pretrain=None if tiny.pretrain is None else rescheduled(tiny.pretrain, steps=12, **few),
            finetune=rescheduled(tiny.finetune, steps=6, **few),
        ),
        reconstruction=dataclasses.replace(
            rescheduled_recipe(gaussians_tiny(), steps=20), image_hw=(72, 128)
        ),
        route="4",
        examples=1,
    )


def plan_drive(
    town: str, seed: int, conditions: str | None = None, *, seconds: float, rate_hz: float = 2.0
) -> DrivePlan:
    """Return a drive to record, with the usual traffic."""
    traffic = BackgroundTraffic()
    return DrivePlan(town, seed, conditions, traffic.vehicles, traffic.pedestrians, seconds, rate_hz)


def record_logs(demo: Demo) -> list[LogPath]:
    """Record the drives of the demo."""
    cores = len(os.sched_getaffinity(0))
    recorded = record_drives(demo.plans, demo.out, SURROUND, workers=min(2, cores))
    if recorded.failed:
        raise InputError("; ".join(f"{plan.log_name}: {why}" for plan, why in recorded.failed.items()))
    return list(recorded.logs.values())


def judge_shipped(demo: Demo) -> Judged:
    """Evaluate the shipped model on the held-out drive."""
    return _judged(open_run(run_folder(Path(SHIPPED), demo.out)), demo, demo.out / "seen")


def train_tiny(demo: Demo) -> Judged:
    """Train a model from scratch on the training drives, and evaluate it on the held-out one."""
    run = train_run(demo.size.recipe, _logs(demo, demo.size.train), demo.out / "learned")
    return _judged(run, demo, run.folder)


def drive_route(demo: Demo) -> dict[str, Driven]:
    """Drive a route of the held-out town: the shipped driver, and the expert without sensors."""
    folder = str(run_folder(Path(DRIVER), demo.out).absolute())
    source = TownRoutes(ROUTES, only=(demo.size.route,), rig=rig_of(folder))
    return {
        DRIVER: _driven(DriveSuite(folder, source, lidar=False), demo.out / "driven"),
        EXPERT: _driven(DriveSuite(EXPERT, source, sensors=False), demo.out / "driven_expert"),
    }


def reconstruct_drive(demo: Demo) -> Reconstructed:
    """Reconstruct a drive, and put a car in the way of some agents that drive in it."""
    (log,) = _logs(demo, [demo.size.reconstructed])
    folder = demo.out / "reconstructed"
    scene = reconstruct_log(demo.size.reconstruction, log, folder)
    source = ReconstructedRoutes(str(folder.absolute()), threats=(Threat.STATIONARY,))
    return Reconstructed(
        scene, {agent: _driven(DriveSuite(agent, source), folder / agent) for agent in MET_BY}
    )


def search_logs(demo: Demo) -> list[Found]:
    """Index all recorded drives, and search them by text and by the best hit of the first text.

    The hits of the texts are written as a list of clips, which `foredrive train` takes as logs.
    """
    index = FrameIndex(str(_indexed(demo)))
    results = [_found(index, Query(text=text, modality="joint", top=HITS)) for text in TEXTS]
    hits = [hit for result in results for hit in result.hits]
    if hits:
        best = hits[0].row
        results.append(_found(index, Query(like=f"{best.log}@{best.t_s:.2f}s/{best.view}", top=HITS)))
        write_clip_list(demo.out / "clips.json", listed_clips(hits, BEFORE_S, AFTER_S))
    return results


def _indexed(demo: Demo) -> Path:
    folder = demo.out / "search"
    done = index_logs(_logs(demo, demo.plans), str(folder), EMBEDDED, STRIDE_S, workers=1)
    if done.failed:
        raise InputError("; ".join(f"{log}: {why}" for log, why in done.failed.items()))
    return folder


def _found(index: FrameIndex, query: Query) -> Found:
    return Found(query, ask(index, query).hits)


def _logs(demo: Demo, plans: Sequence[DrivePlan]) -> list[LogPath]:
    """Return recorded logs.

    Raises:
        InputError: one is missing.
    """
    logs = [log_of(plan, demo.out) for plan in plans]
    for log in logs:
        if not log.folder.is_dir():
            raise InputError(f"{log.folder}: was not recorded")
    return logs


def _judged(run: Run, demo: Demo, out: Path) -> Judged:
    logs = _logs(demo, [demo.size.test])
    # The metrics of an earlier call are kept; the predictions for the pictures are not stored
    if not (out / SUMMARY).is_file():
        evaluate_run(run, logs, out)
    return Judged(run, logs, read_summary(out / SUMMARY), predict_examples(run, logs, demo.size.examples))


def _driven(suite: DriveSuite, out: Path) -> Driven:
    result = drive_suite(suite, out)
    if result.broken:
        raise InputError("; ".join(result.broken.values()))
    ((job, record),) = result.drives.items()
    return Driven(out, job.name, record)
