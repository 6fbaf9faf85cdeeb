"""The demo without its pictures: all steps of the loop, each in its own part of one folder.

The folder is a 123D data root. What an earlier call has finished is not done again.
"""

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
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
from foredrive.runs.drive.recording import EgosPlan, log_of, record_drives, record_egos
from foredrive.runs.drive.suite import DriveSuite, drive_suite
from foredrive.runs.evaluate.run import ExamplePrediction, evaluate_run, predict_examples
from foredrive.runs.improve.loop import Loop
from foredrive.runs.improve.records import Improvement, LoopResult
from foredrive.runs.progress import Progress, fraction, silent
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
from foredrive.search.query import Modality, Query
from foredrive.sensors.rigs import FRONT_TELE, SURROUND
from foredrive.towns.campaign import DrivePlan

SHIPPED = "embedded:nemo_town"
"""The world model that sees."""
DRIVER = "embedded"
"""The driver by sight."""
ROUTES = "town05-short"
MET_BY = (REPLAY, CORRIDOR)
"""Agents that meet the car in their way: one replays the recorded drive, the other one uses the lidar."""
TEXTS: Mapping[str, Modality] = {
    "a pedestrian close by": "image",
    "a street at night": "image",
    "a parked car": "lidar",
}
"""Texts to search for, and what they are compared with: lidar cannot know whether it is night."""
HITS = 3
STRIDE_S = 1.0
SEARCHED = "training-short"
ROUND = ("see.epochs=4", "see.lr=1e-3", "see.batch_size=8")
"""Settings of the driver's training in the round of the loop."""
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
    failing: tuple[str, ...]
    """Ids of the routes of `SEARCHED` in which the driver looks for failures."""
    own: EgosPlan
    """Virtual egos that every round trains on."""
    pool: EgosPlan
    """Virtual egos to choose from."""
    budget: int
    """Moments that are chosen."""
    seconds: Mapping[str, int] = field(default_factory=dict)
    """Expected computing time of each step on one core, s, by its title."""


@dataclass(frozen=True)
class Demo:
    """A demo and its folder."""

    size: DemoSize
    out: Path
    progress: Progress = silent

    @property
    def cores(self) -> int:
        """Return the number of cores that the demo uses."""
        return min(2, len(os.sched_getaffinity(0)))

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
    """Return the full size: seven minutes of one core."""
    tiny = nemo_tiny()
    return DemoSize(
        train=(
            plan_drive("Town01", 1, seconds=40.0),
            plan_drive("Town10HD", 1, "night", seconds=40.0),
        ),
        test=plan_drive("Town05", 1, seconds=20.0),
        reconstructed=plan_drive("Town05", 7, seconds=6.0, rate_hz=10.0),
        recipe=dataclasses.replace(
            tiny,
            pretrain=None if tiny.pretrain is None else rescheduled(tiny.pretrain, steps=120),
            finetune=rescheduled(tiny.finetune, steps=40),
        ),
        reconstruction=dataclasses.replace(
            rescheduled_recipe(gaussians_tiny(), steps=300), image_hw=SURROUND.image_hw
        ),
        route="12",
        examples=8,
        failing=("Town01-0",),
        own=EgosPlan("Town03", 0, 16, ()),
        pool=EgosPlan("Town01", 100, 24, ()),
        budget=24,
        seconds={
            "Record": 65,
            "See": 20,
            "Learn": 120,
            "Drive": 40,
            "Reconstruct": 60,
            "Search": 15,
            "Improve": 90,
        },
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
        failing=("Town02-1",),
        own=EgosPlan("Town02", 0, 2, ()),
        pool=EgosPlan("Town02", 100, 4, ()),
        budget=4,
    )


def plan_drive(
    town: str, seed: int, conditions: str | None = None, *, seconds: float, rate_hz: float = 2.0
) -> DrivePlan:
    """Return a drive to record, with the usual traffic."""
    traffic = BackgroundTraffic()
    return DrivePlan(town, seed, conditions, traffic.vehicles, traffic.pedestrians, seconds, rate_hz)


def record_logs(demo: Demo) -> list[LogPath]:
    """Record the drives of the demo."""
    with demo.progress("recording drives", len(demo.plans)) as tick:
        recorded = record_drives(demo.plans, demo.out, SURROUND, demo.cores, tick=tick)
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
    suites = {
        DRIVER: (DriveSuite(folder, source, lidar=False), demo.out / "driven"),
        EXPERT: (DriveSuite(EXPERT, source, sensors=False), demo.out / "driven_expert"),
    }
    with demo.progress("driving", len(suites)) as tick:
        return {agent: _driven(suite, out, tick) for agent, (suite, out) in suites.items()}


def reconstruct_drive(demo: Demo) -> Reconstructed:
    """Reconstruct a drive, and put a car in the way of some agents that drive in it."""
    (log,) = _logs(demo, [demo.size.reconstructed])
    folder = demo.out / "reconstructed"
    scene = reconstruct_log(demo.size.reconstruction, log, folder)
    source = ReconstructedRoutes(str(folder.absolute()), threats=(Threat.STATIONARY,))
    with demo.progress("driving in it", len(MET_BY)) as tick:
        met = {agent: _driven(DriveSuite(agent, source), folder / agent, tick) for agent in MET_BY}
    return Reconstructed(scene, met)


def search_logs(demo: Demo) -> list[Found]:
    """Index all recorded drives, and search them by text and by the best hit of the first text.

    The hits of the texts are written as a list of clips, which `foredrive train` takes as logs.
    """
    index = FrameIndex(str(_indexed(demo)))
    results = [_found(index, Query(text=text, modality=kind, top=HITS)) for text, kind in TEXTS.items()]
    hits = [hit for result in results for hit in result.hits]
    if hits:
        best = hits[0].row
        results.append(_found(index, Query(like=f"{best.log}@{best.t_s:.2f}s/{best.view}", top=HITS)))
        write_clip_list(demo.out / "clips.json", listed_clips(hits, BEFORE_S, AFTER_S))
    return results


def improve_driver(demo: Demo) -> LoopResult:
    """Let the driver fail on training routes, and train it on the moments of a pool that resemble that."""
    folder, size = run_folder(Path(DRIVER), demo.out).absolute(), demo.size
    kept = []
    for name, plan in (("own", size.own), ("pool", size.pool)):
        with demo.progress(f"recording {plan.count} virtual egos", 1) as tick:
            logs, failed = record_egos([plan], demo.out / "egos" / name, FRONT_TELE, demo.cores, tick=tick)
        if failed:
            raise InputError("; ".join(failed.values()))
        kept.append(tuple(logs))
    own, pool = kept
    source = TownRoutes(SEARCHED, only=size.failing, rig=rig_of(str(folder)))
    improvement = Improvement(folder, pool, own, source, budget=size.budget, settings=ROUND)
    return Loop(improvement, demo.out / "improved", demo.cores, progress=demo.progress).run(1)


def _indexed(demo: Demo) -> Path:
    folder = demo.out / "search"
    with fraction(demo.progress, "embedding images and sweeps") as tick:
        done = index_logs(_logs(demo, demo.plans), str(folder), EMBEDDED, STRIDE_S, workers=1, tick=tick)
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


def _driven(suite: DriveSuite, out: Path, tick: Callable[[], None]) -> Driven:
    result = drive_suite(suite, out, tick=lambda *_: tick())
    if result.broken:
        raise InputError("; ".join(result.broken.values()))
    ((job, record),) = result.drives.items()
    return Driven(out, job.name, record)
