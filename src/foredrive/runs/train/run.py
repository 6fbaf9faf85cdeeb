"""Training runs: a folder with the recipe, the stages and their weights."""

import contextlib
import json
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from safetensors.torch import save_file

from foredrive.data import ClipDataset, LogPath, collate
from foredrive.data.lidar import frames_with_lidar
from foredrive.engine.checkpoints import load_weights, save_weights, whole_weights
from foredrive.engine.config import read_values, save_recipe
from foredrive.engine.folder import CONFIG, LOGS, WEIGHTS, RunFolder
from foredrive.engine.loop import CONDITIONS, train
from foredrive.engine.processes import entered_by_first, naming_lost_processes
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.methods.planner.path_fit import PathFit, fit_path
from foredrive.methods.recipe import Recipe
from foredrive.runs.build import build_agent, build_objective
from foredrive.runs.open_clips import open_clips
from foredrive.runs.recipes.world_models import load_recipe
from foredrive.runs.train.baselines import run_baselines
from foredrive.runs.train.kept_parts import load_kept, load_perception, with_kept_heads
from foredrive.runs.train.path_features import sample_paths
from foredrive.runs.train.rigs import RIGS, trained_rigs, write_rigs
from foredrive.runs.train.sequences import in_sequences
from foredrive.runs.train.task_priors import (
    PRIORS,
    SURVEYED,
    TASKS,
    check_truth,
    place_map_elements,
    save_priors,
    semantic_weights,
)
from foredrive.scene.task_truth import TaskTruth
from foredrive.tasks.task_priors import fit_task_priors

if TYPE_CHECKING:
    from lightning_fabric import Fabric

    from foredrive.engine.fabric import Sharing

_log = logging.getLogger(__name__)
STAGES = ("pretrain", "finetune")
PATH = "path"


@dataclass(frozen=True)
class Run:
    """A run on disk: its recipe, its training logs, and the folder of its label cache."""

    folder: Path
    recipe: Recipe
    logs: tuple[LogPath, ...]
    cache_dir: Path
    start: Path | None = None
    """The run that gave the pre-trained weights, if this run was not pre-trained itself."""

    @property
    def weights(self) -> Path:
        """Return the path of the weights of the last finished stage.

        Raises:
            InputError: no stage has finished.
        """
        for stage in (PATH, *reversed(STAGES)):
            if (self.folder / stage / WEIGHTS).is_file():
                return self.folder / stage / WEIGHTS
        raise InputError(
            f"{self.folder}: no stage of this run has finished; continue it with `foredrive train`"
        )

    @property
    def conditions(self) -> dict[str, str | int]:
        """Return device, precision and processes of each stage, as flat dotted keys. Older runs have none."""
        conditions: dict[str, str | int] = {}
        for stage in STAGES:
            with contextlib.suppress(OSError, ValueError, AttributeError, RecursionError):
                entries = json.loads((self.folder / stage / CONDITIONS).read_text()).items()
                conditions |= {f"training.{stage}.{name}": value for name, value in entries}
        return conditions


def open_run(folder: Path) -> Run:
    """Open a run folder that `train_run` wrote.

    Raises:
        InputError: the folder is no run folder, or its list of logs cannot be read.
    """
    if not (folder / CONFIG).is_file():
        raise InputError(f"{folder}: not a run folder (no {CONFIG})")
    values = read_values(folder / CONFIG)
    if isinstance(values, dict) and values.get("kind") == "driver":
        raise InputError(f"{folder}: the run of a driver, which has no world model; it can drive")
    recipe = load_recipe(folder / CONFIG)
    try:
        written = json.loads((folder / LOGS).read_text())
        logs = tuple(read_log(entry) for entry in written["logs"])
        start = written.get("start")
        return Run(folder, recipe, logs, Path(written["cache_dir"]), None if start is None else Path(start))
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise InputError(f"{folder / LOGS}: cannot be read as paths of logs: {error}") from error


def train_run(
    recipe: Recipe,
    logs: Sequence[LogPath],
    folder: Path,
    cache_dir: Path | None = None,
    start: Path | None = None,
    sharing: "Sharing" = "ddp",
) -> Run:
    """Pre-train, fine-tune, then fit the path features of the planner, if the recipe says so.

    It continues where an earlier call with the same arguments stopped.

    Args:
        recipe: a recipe without pre-training starts from scratch.
        logs: logs for all stages.
        folder: folder of the run.
        cache_dir: folder for labels and shrunk images; by default in `folder`.
        start: a run folder. The part of its pre-trained world model that the recipe transfers is used, and
            this run skips that stage. It allows pre-training on many logs and fine-tuning on few, or with
            another planner. A model that comes with the package has its last weights only; these are then
            used. If the recipe's `transfer` is "perception" or "frozen", its last world model and its heads
            are used instead.
        sharing: how the processes that torchrun started share the training, if there are several.

    Raises:
        InputError: `folder` holds a run of another recipe, other logs or another start; another process
            trains it; a log cannot be read; no log has the truth of a task; `start` has not finished
            pre-training, or its world model has other sizes; another process of this training has ended.
    """
    from foredrive.engine.fabric import make_fabric  # the import takes seconds; opening a run does without

    start = None if start is None else start.absolute()
    kept: Run | None = None
    if recipe.transfer in ("perception", "frozen"):
        kept = _kept(recipe, start)
    if kept is not None and recipe.transfer == "frozen":
        recipe = with_kept_heads(recipe, kept.recipe, kept.folder)
    logs = tuple(log.absolute() for log in logs)  # a run opens from any working directory
    run = Run(folder, recipe, logs, (cache_dir or folder / "cache").absolute(), start)
    claim = _folder_of(run)
    claim.check()
    dataset = open_clips(run.logs, recipe.clips, run.cache_dir)
    if recipe.tasks is not None and recipe.transfer != "frozen":
        check_truth(recipe.tasks.heads, run.logs)
    pretrained = None if start is None or kept is not None else pretrained_weights(start)
    if recipe.planner.attends or recipe.tasks is not None:
        build_agent(recipe, fetch=False)  # heads that do not fit the rest must not create a run
    fabric = make_fabric(recipe.precision, sharing)
    fabric.launch()
    # Only now: logs that cannot be read must not create a run.
    with naming_lost_processes(fabric), entered_by_first(claim.claimed(), fabric):
        if fabric.is_global_zero and not (folder / RIGS).is_file():
            rigs = trained_rigs(run.logs, dataset.camera_names)
            if rigs is not None:
                write_rigs(rigs, folder)
        if fabric.is_global_zero:
            _warn_without_labels(dataset)
            if dataset.touching:
                _log.warning(
                    "in %d of %d clips the vehicle touches a road user: no plan is learned from them",
                    dataset.touching,
                    len(dataset),
                )
        _train_stages(run, dataset, pretrained or kept, fabric)
    return run


def _warn_without_labels(dataset: ClipDataset) -> None:
    """Warn if no log has what the voxel labels are made from."""
    source = dataset.config.occupancy_source
    if source != "recorded" and not any(len(frames_with_lidar(log)) for log in dataset.logs):
        _log.warning(
            "none of the logs has lidar, so occupancy is not learned; logs of towns may have "
            "recorded occupancy (--occupancy recorded)"
        )


def begin_run(
    recipe: Recipe, logs: Sequence[LogPath], folder: Path, cache_dir: Path | None, start: Path
) -> Run:
    """Write the folder of a run without training it, unless the folder holds this run already.

    Raises:
        InputError: `folder` holds another run, or a log cannot be read.
    """
    logs = tuple(log.absolute() for log in logs)
    run = Run(folder, recipe, logs, (cache_dir or folder / "cache").absolute(), start.absolute())
    claim = _folder_of(run)
    claim.check()
    open_clips(run.logs, recipe.clips, run.cache_dir)
    with claim.claimed():
        return run


def _train_stages(run: Run, dataset: ClipDataset, start: "Path | Run | None", fabric: "Fabric") -> None:
    """Train the stages that are not finished yet, in order.

    Args:
        start: pre-trained weights, or the run whose last world model and heads are used. None: pre-train, if
            the recipe says so.
    """
    recipe, folder = run.recipe, run.folder
    if start is None and recipe.pretrain is not None:
        start = folder / "pretrain" / WEIGHTS
        if not start.is_file():
            first = recipe.of_pretraining
            data = dataset if recipe.clips.tasks is None else open_clips(run.logs, first.clips, run.cache_dir)
            _train_stage(replace(run, recipe=first), "pretrain", fresh_agent(first), data, fabric)
    agent = fresh_agent(recipe)
    finished = (folder / "finetune" / WEIGHTS).is_file()
    if agent.heads is not None and recipe.transfer != "frozen" and not finished:
        place_map_elements(agent.heads, _truths(dataset), recipe.finetune.schedule.seed)
    if isinstance(start, Run) and recipe.transfer == "perception":
        load_perception(agent, start.weights)
    elif isinstance(start, Run):
        load_kept(agent, start.recipe, start.folder, start.weights)
    elif start is not None:
        load_pretrained(agent, recipe, start)
    if agent.planner.ego_mlp is not None and not finished:
        # The base of the planner is the same MLP that is its baseline in the evaluation.
        base = agent.planner.ego_mlp
        _, fitted = run_baselines(folder, run.logs, recipe, run.cache_dir, base.past_frames)
        base.load_state_dict(fitted.state_dict())
    _train_stage(run, "finetune", agent, dataset, fabric)
    if recipe.tasks is not None and fabric.is_global_zero and not (folder / TASKS / PRIORS).is_file():
        save_priors(fit_task_priors(_truths(dataset)), folder / TASKS / PRIORS)
    if recipe.path is not None and agent.planner.path is not None:
        _fit_path(run, recipe.path, fabric)


def fresh_agent(recipe: Recipe) -> PlanningAgent[Any]:
    """Build an agent whose first weights follow from the seed of the recipe alone."""
    torch.manual_seed(recipe.finetune.schedule.seed)
    return build_agent(recipe)


def load_pretrained(agent: PlanningAgent[Any], recipe: Recipe, weights: Path) -> None:
    """Load the part of pre-trained weights that fine-tuning starts from.

    Raises:
        InputError: the file cannot be read, or this part is of another architecture.
    """
    parts = ("backbone", "encoder") if recipe.transfer == "encoder" else ("",)
    for part in parts:
        name = f"world_model.{part}".rstrip(".")
        load_weights(agent.get_submodule(name), weights, name)


def _fit_path(run: Run, fit: PathFit, fabric: "Fabric") -> None:
    """Fit the planner's path features on the final volume, in the first process."""
    weights = run.folder / PATH / WEIGHTS
    if fabric.is_global_zero and not weights.is_file():
        agent = load_agent(run).to(fabric.device)
        path = agent.planner.path
        assert path is not None
        demonstrations = sample_paths(agent, run.logs, run.recipe.clips, run.cache_dir, fit.stride_s)
        fit_path(path, demonstrations, fit, run.recipe.finetune.schedule.seed)
        with atomic_path(weights) as temporary:
            save_weights(agent, temporary)
    fabric.barrier()


def pretrained_weights(start: Path) -> Path:
    """Return the pre-trained weights of a run, or its last ones if only those were kept."""
    weights = start / "pretrain" / WEIGHTS
    if weights.is_file():
        return weights
    run = open_run(start)
    if run.recipe.pretrain is None or run.start is not None:
        raise InputError(f"{start}: no pre-trained weights (no pretrain/{WEIGHTS})")
    return run.weights


def _kept(recipe: Recipe, start: Path | None) -> Run:
    """Return the run whose last world model and heads are used."""
    if recipe.transfer == "perception" and recipe.tasks is None:
        raise InputError(f"{recipe.name}: transfer is perception, which trains heads: name them with --tasks")
    if start is None:
        raise InputError(f"{recipe.name}: transfer is {recipe.transfer}; --start has to name a trained run")
    source = open_run(start)
    assert source.weights
    if recipe.transfer == "perception" and source.recipe.tasks is None:
        raise InputError(f"{start}: has no task heads that were trained with its world model")
    return source


def _train_stage(
    run: Run, name: str, agent: PlanningAgent[Any], dataset: ClipDataset, fabric: "Fabric"
) -> None:
    weights, stage = run.folder / name / WEIGHTS, getattr(run.recipe, name)
    if not weights.is_file():
        tasks = run.recipe.tasks
        voxels = tasks is not None and tasks.heads.voxels is not None
        objective = build_objective(
            run.recipe, stage, agent, semantic_weights(_truths(dataset)) if voxels else None
        )
        if tasks is None:
            train(objective, dataset, collate, stage.schedule, run.folder / name, fabric)
        else:
            keys = [dataset.key(index) for index in range(len(dataset))]
            items, join, schedule = in_sequences(dataset, keys, collate, tasks.heads, stage.schedule)
            train(objective, items, join, schedule, run.folder / name, fabric)
        trained = whole_weights(agent)
        if fabric.is_global_zero:
            with atomic_path(weights) as temporary:
                save_file(trained, temporary)
        fabric.barrier()


def _truths(dataset: ClipDataset) -> Iterator[TaskTruth]:
    """Yield the truth of at most `SURVEYED` clips, evenly spaced."""
    for index in range(0, len(dataset), -(-len(dataset) // SURVEYED)):
        if (truth := dataset.truth(index)) is not None:
            yield truth


def load_agent(run: Run) -> PlanningAgent[Any]:
    """Return the trained agent in evaluation mode. Heads that are not trained yet are left out."""
    pretrained = run.weights.parent.name == "pretrain"
    agent = build_agent(run.recipe.of_pretraining if pretrained else run.recipe, fetch=False)
    load_weights(agent, run.weights)
    return agent.eval()


def _write(run: Run) -> None:
    logs = [written_log(log) for log in run.logs]
    with atomic_path(run.folder / LOGS) as temporary:
        start = None if run.start is None else str(run.start)
        entries = {"logs": logs, "cache_dir": str(run.cache_dir), "start": start}
        temporary.write_text(json.dumps(entries, indent=1))
    save_recipe(run.recipe, run.folder / CONFIG)


def written_log(log: LogPath) -> dict[str, object]:
    """Return the entry of a log in a run's list."""
    entry: dict[str, object] = {"folder": str(log.folder), "maps_dir": str(log.maps_dir)}
    return entry | ({"parts_s": log.parts_s} if log.parts_s else {})


def read_log(entry: dict[str, Any]) -> LogPath:
    """Return the log of an entry of a run's list."""
    parts = tuple((float(start), float(end)) for start, end in entry.get("parts_s", ()))
    return LogPath(Path(entry["folder"]), Path(entry["maps_dir"]), parts).absolute()


def _folder_of(run: Run) -> RunFolder:
    def asked(of: Run) -> dict[str, object]:
        return {
            "a run with another recipe": of.recipe,
            "a run with other logs": of.logs,
            "a run with another start": of.start,
        }

    def read() -> dict[str, object] | None:
        return asked(open_run(run.folder)) if (run.folder / CONFIG).is_file() else None

    return RunFolder(run.folder, asked(run), read, lambda: _write(run))
