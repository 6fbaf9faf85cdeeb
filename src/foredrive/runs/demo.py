"""The demo without its pictures: record towns, train, evaluate on the held-out town."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from foredrive.data import LogPath
from foredrive.recipes.config import Recipe, rescheduled
from foredrive.recipes.nemo import nemo_tiny
from foredrive.runs.evaluate.run import evaluate_run
from foredrive.runs.train.run import Run, train_run
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import roof_lidar
from foredrive.towns.recorder import LabelOptions, record, split_of
from foredrive.towns.sensing.capture import SensorSuite

RATE_HZ = 2.0
"""Recording rate: one key frame every 0.5 s."""


@dataclass(frozen=True)
class DemoSize:
    """The amount of recorded data and of training."""

    recipe: Recipe
    train_drives: tuple[tuple[str, int], ...]
    """Town and seed of each drive."""
    test_drives: tuple[tuple[str, int], ...]
    train_s: float
    test_s: float


def full_demo() -> DemoSize:
    """Return the full size, minutes on two cores: two training towns, Town05 held out."""
    return DemoSize(
        recipe=nemo_tiny(),
        train_drives=(("Town01", 1), ("Town03", 1), ("Town01", 2), ("Town03", 2)),
        test_drives=(("Town05", 1), ("Town05", 2)),
        train_s=60.0,
        test_s=30.0,
    )


def quick_demo() -> DemoSize:
    """Return a size with the same steps that takes about a minute. The model learns nothing useful."""
    recipe, few = nemo_tiny(), {"batch_size": 2, "warmup_steps": 2}
    return DemoSize(
        recipe=dataclasses.replace(
            recipe,
            name="nemo_tiny (quick)",
            pretrain=None if recipe.pretrain is None else rescheduled(recipe.pretrain, steps=12, **few),
            finetune=rescheduled(recipe.finetune, steps=6, **few),
        ),
        train_drives=(("Town01", 1), ("Town02", 1)),
        test_drives=(("Town05", 1),),
        train_s=6.0,
        test_s=6.0,
    )


def run_demo(size: DemoSize, out: Path, say: Callable[[str], None]) -> tuple[Run, list[LogPath]]:
    """Record, pre-train, fine-tune and evaluate; continue where an earlier call stopped.

    Returns:
        the run, whose folder is `out/run`, and the held-out logs.
    """
    say("1/4 recording the training towns and Town05, which is held out")
    train_logs = [_drive(town, seed, size.train_s, out) for town, seed in size.train_drives]
    test_logs = [_drive(town, seed, size.test_s, out) for town, seed in size.test_drives]
    say("2/4 training NeMo: self-supervised pre-training, then planning")
    run = train_run(size.recipe, train_logs, out / "run")
    say("3/4 evaluating on Town05")
    evaluate_run(run, test_logs, run.folder)
    return run, test_logs


def _drive(town: str, seed: int, seconds: float, out: Path) -> LogPath:
    folder = out / "towns"
    there = folder / "logs" / split_of(town) / f"{town}_seed{seed}"
    if there.is_dir():  # a log is either complete or absent
        return LogPath(there, folder / "maps")
    sensors = SensorSuite(camera_rig(nemo_tiny().clips.image_hw), roof_lidar())
    return record(
        town,
        seconds,
        seed,
        folder,
        rate_hz=RATE_HZ,
        sensors=sensors,
        labels=LabelOptions(occupancy=None, visibility=False, captions=False),
    )
