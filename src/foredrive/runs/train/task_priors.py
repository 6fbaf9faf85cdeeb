"""Survey a training set for task heads: baselines, class weights, and typical map lines."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from scipy.cluster.vq import kmeans2
from torch import Tensor

from foredrive.data import LogPath
from foredrive.data.logs import Log
from foredrive.data.truth.tasks import tasks_of
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.heads.heads import TaskHeads, TaskHeadsConfig
from foredrive.heads.semantic_losses import class_weights
from foredrive.heads.targets import map_targets
from foredrive.scene.semantics import VOXEL_CLASSES
from foredrive.scene.task_truth import TaskTruth
from foredrive.tasks.task_priors import TaskPriors

TASKS = "tasks"
"""Folder of what belongs to the heads in the folder of a run."""
PRIORS = "priors.safetensors"
"""File of the baselines in it."""
SURVEYED = 2000
"""Number of clips that are enough for class weights, constant masks and typical lines."""


def save_priors(priors: TaskPriors, path: Path) -> None:
    """Write the baselines that exist."""
    tensors = {name: value.contiguous() for name, value in vars(priors).items() if value is not None}
    with atomic_path(path) as temporary:
        save_file(tensors, temporary)


def load_priors(path: Path) -> TaskPriors:
    """Read what `save_priors` wrote.

    Raises:
        InputError: the file cannot be read.
    """
    try:
        return TaskPriors(**load_file(path))
    except (OSError, SafetensorError, TypeError) as error:
        raise InputError(f"{path}: cannot be read as baselines: {error}") from error


def check_truth(heads: TaskHeadsConfig, logs: Sequence[LogPath]) -> None:
    """Check that at least one log has the truth of each task that heads are trained for.

    Raises:
        InputError: none has. The message names the task and the reason.
    """
    missing: dict[str, str] = dict.fromkeys(heads.tasks, "")
    for log in logs:
        if not missing:
            return
        for support in tasks_of(Log(log)):
            if support.judged:
                missing.pop(support.task, None)
            elif support.task in missing:
                missing[support.task] = support.reason
    for task, reason in missing.items():
        raise InputError(f"no log can train the task {task!r}; {logs[-1].name}: {reason}")


def semantic_weights(truths: Iterable[TaskTruth | None]) -> Float[Tensor, "C"] | None:
    """Return the weights of the semantic classes from their shares in a training set; None without voxels."""
    counts: Tensor | None = None
    for truth in truths:
        if truth is not None and (voxels := truth.semantics) is not None:
            classes = len(VOXEL_CLASSES[voxels.taxonomy])
            class_counts = torch.bincount(voxels.index[voxels.known].long(), minlength=classes)
            counts = class_counts if counts is None else counts + class_counts
    return None if counts is None else class_weights(counts)


def place_map_elements(heads: TaskHeads, truths: Iterable[TaskTruth | None], seed: int) -> None:
    """Let the map elements of fresh heads start at typical lines of a training set, if heads have them."""
    if heads.elements is None or heads.config.elements is None:
        return
    config = heads.config.elements
    lines_m = typical_lines(truths, config.elements, config.points, config.kinds, seed)
    if lines_m is not None:
        heads.elements.begin_at(lines_m)


def typical_lines(
    truths: Iterable[TaskTruth | None], elements: int, points: int, kinds: int, seed: int
) -> Float[Tensor, "elements points 2"] | None:
    """Return the middles of clusters of the true map elements, m; None if there are too few elements.

    Lines are compared point by point, from the end that lies farther back.

    Args:
        truths: of the training set.
        elements: number of clusters.
        points: points of a line, at equal distances.
        kinds: the first so many of `ElementKind` count.
        seed: of the clustering.
    """
    lines = [torch.zeros(0, points, 2)]
    for truth in truths:
        if truth is not None and truth.elements is not None and bool(truth.elements.known):
            lines.append(map_targets(truth.elements, kinds, points).orders[:, 0])
    every = torch.cat(lines)
    if len(every) < elements:
        return None
    # Both directions describe an open line: begin at the end with the smaller x
    backwards = every[:, 0, 0] > every[:, -1, 0]
    every = torch.where(backwards[:, None, None], every.flip(1), every)
    middles, _ = kmeans2(every.flatten(1).double().numpy(), elements, minit="++", seed=seed)
    return torch.from_numpy(middles).float().unflatten(1, (points, 2))
