"""Runs of drivers: the folder with the recipe, the eyes' training and the weights of the whole driver."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors.torch import save_file
from torch import Tensor

from foredrive.data import ClipDataset, LogPath
from foredrive.driver.agent import Driver
from foredrive.driver.eyes import CameraEyes, CameraEyesConfig
from foredrive.driver.judging import missed_by
from foredrive.driver.objective import SightObjective
from foredrive.driver.packed import PackedClips, batches, join
from foredrive.driver.planner_fit import fit_planner
from foredrive.driver.recipes import DriverRecipe
from foredrive.driver.speed_planner import SpeedPlanner
from foredrive.driver.volume_eyes import VolumeEyes
from foredrive.engine.checkpoints import load_weights
from foredrive.engine.config import read_values, save_recipe, validated
from foredrive.engine.folder import CONFIG, LOGS, WEIGHTS, RunFolder
from foredrive.engine.loop import train
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.runs.open_clips import open_clips
from foredrive.runs.progress import Progress, silent
from foredrive.runs.train.rigs import RIGS, trained_rigs, write_rigs
from foredrive.runs.train.run import pretrained_weights, read_log, written_log

SEE, PLAN = "see", "plan"
"""Folders of the stages."""
SIGN_HEAD = ("eyes.reader.signs.",)
"""Weights that drivers without stop signs lack."""


@dataclass(frozen=True)
class DriverRun:
    """A driver on disk."""

    folder: Path
    recipe: DriverRecipe
    logs: tuple[LogPath, ...]
    start: Path | None = None
    """The run that the training started from."""

    @property
    def weights(self) -> Path:
        """Return the path of the weights.

        Raises:
            InputError: training has not finished.
        """
        weights = self.folder / PLAN / WEIGHTS
        if not weights.is_file():
            raise InputError(f"{self.folder}: training has not finished; continue it with `foredrive train`")
        return weights


def is_driver(folder: Path) -> bool:
    """Return whether a folder holds the run of a driver."""
    if not (folder / CONFIG).is_file():
        return False
    values = read_values(folder / CONFIG)
    return isinstance(values, dict) and values.get("kind") == "driver"


def open_driver(folder: Path) -> DriverRun:
    """Open the folder of a driver's run.

    Raises:
        InputError: it is none, or cannot be read.
    """
    if not is_driver(folder):
        raise InputError(f"{folder}: not the run of a driver")
    recipe: DriverRecipe = validated(DriverRecipe, read_values(folder / CONFIG), str(folder / CONFIG))
    try:
        written = json.loads((folder / LOGS).read_text())
        start = written.get("start")
        logs = tuple(read_log(entry) for entry in written["logs"])
        return DriverRun(folder, recipe, logs, None if start is None else Path(start))
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise InputError(f"{folder / LOGS}: cannot be read as paths of logs: {error}") from error


def load_driver(run: DriverRun) -> Driver:
    """Return the trained driver in evaluation mode.

    Raises:
        InputError: its training has not finished.
    """
    driver = build_driver(run.recipe)
    load_weights(driver, run.weights)
    return driver.eval()


def build_driver(recipe: DriverRecipe) -> Driver:
    """Build a driver with fresh weights."""
    config = recipe.eyes
    eyes = CameraEyes(config) if isinstance(config, CameraEyesConfig) else VolumeEyes(config)
    return Driver(eyes, SpeedPlanner(recipe.planner))


def _drawn(
    driver: Driver, clips: PackedClips, emphasis: float, tick: Callable[[], None]
) -> Float[Tensor, "N"]:
    """Return how often each clip is drawn: more often where a driver is wrong."""
    return torch.where(missed_by(driver, clips, tick), emphasis, 1.0)


def _load_encoder(driver: Driver, start: Path) -> None:
    """Load the pre-trained backbone and encoder of a run into eyes that read a volume.

    Raises:
        InputError: the eyes have none, or the run's are of another architecture.
    """
    if not isinstance(driver.eyes, VolumeEyes):
        raise InputError("only eyes that read a volume start from a run: leave out --start")
    weights = pretrained_weights(start)
    load_weights(driver.eyes.backbone, weights, "world_model.backbone")
    load_weights(driver.eyes.encoder, weights, "world_model.encoder")


def train_driver(
    recipe: DriverRecipe,
    logs: Sequence[LogPath],
    folder: Path,
    cache_dir: Path | None = None,
    start: Path | None = None,
    progress: Progress = silent,
) -> DriverRun:
    """Train the eyes, then fit the planner. It continues where an earlier call stopped.

    Args:
        recipe: the recipe.
        logs: logs with boxes and routes, and with lights to learn them.
        folder: folder of the run.
        cache_dir: folder of packed clips; by default in `folder`.
        start: a run to start from. A driver's run gives its weights (stop signs are learned afresh if it
            knows none), and clips in which it is wrong are drawn more often (`DriverRecipe.emphasis`); a
            world model's run gives its pre-trained encoder.
        progress: shows how far packing and looking at the clips are.

    Raises:
        InputError: the folder holds another run, another process trains it, or a log cannot be read.
    """
    from foredrive.engine.fabric import make_fabric  # the import takes seconds

    start = None if start is None else start.absolute()
    run = DriverRun(folder, recipe, tuple(log.absolute() for log in logs), start)
    claim = RunFolder(folder, _asked(run), lambda: _read(folder), lambda: _write(run))
    claim.check()
    dataset = open_clips(run.logs, recipe.clips, cache_dir or folder / "cache")
    clips = PackedClips(dataset, (cache_dir or folder / "cache") / "packed")
    with claim.claimed():
        _write_rigs(run, dataset)
        with progress("packing clips", clips.logs) as tick:
            clips.pack(tick)
        torch.manual_seed(recipe.see.seed)
        driver, drawn = build_driver(recipe), None
        eyes = folder / SEE / WEIGHTS
        if start is not None and is_driver(start):
            load_weights(driver, open_driver(start).weights, fresh=SIGN_HEAD)
            if not eyes.is_file():
                with progress("looking for mistakes", batches(len(clips))) as tick:
                    drawn = _drawn(driver.eval(), clips, recipe.emphasis, tick)
        elif start is not None:
            _load_encoder(driver, start)
        if not eyes.is_file():
            fabric = make_fabric(recipe.precision)
            objective = SightObjective(driver.eyes, recipe.weights)
            train(objective, clips, join, recipe.see, folder / SEE, fabric, drawn)
            with atomic_path(eyes) as temporary:
                save_file(driver.eyes.state_dict(), temporary)
        if not (folder / PLAN / WEIGHTS).is_file():
            load_weights(driver.eyes, eyes)
            driver.eval()
            with progress("driving the clips by rule", batches(min(len(clips), recipe.plan.clips))) as tick:
                fit_planner(driver, clips, recipe.plan, recipe.see.seed, tick)
            with atomic_path(folder / PLAN / WEIGHTS) as temporary:
                save_file(driver.state_dict(), temporary)
    return run


def _write_rigs(run: DriverRun, dataset: ClipDataset) -> None:
    if not (run.folder / RIGS).is_file():
        rigs = trained_rigs(run.logs, dataset.camera_names)
        if rigs is not None:
            write_rigs(rigs, run.folder)


def _asked(run: DriverRun) -> dict[str, object]:
    return {
        "a run with another recipe": asdict(run.recipe) | {"about": ""},
        "a run with other logs": run.logs,
        "a run with another start": run.start,
    }


def _read(folder: Path) -> dict[str, object] | None:
    return _asked(open_driver(folder)) if (folder / CONFIG).is_file() else None


def _write(run: DriverRun) -> None:
    with atomic_path(run.folder / LOGS) as temporary:
        start = None if run.start is None else str(run.start)
        entries = {"logs": [written_log(log) for log in run.logs], "start": start}
        temporary.write_text(json.dumps(entries, indent=1))
    save_recipe(run.recipe, run.folder / CONFIG)
