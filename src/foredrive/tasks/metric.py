"""The protocol of metrics: each accumulates over the clips of an evaluation and returns its figures."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from foredrive.engine.summary import Figures
from foredrive.errors import InputError
from foredrive.scene import Clip, Example, VoxelGrid
from foredrive.tasks.occupancy.scores import OccupancyPrior
from foredrive.tasks.predictor import Part, Prediction
from foredrive.tasks.task_priors import TaskPriors


@dataclass(frozen=True)
class EvaluationContext:
    """Facts that hold for all clips of an evaluation."""

    frame_dt_s: float
    """Time between key frames."""
    prior: OccupancyPrior | None = None
    """Occupancy prior of the training set, on the model's frames."""
    task_priors: TaskPriors | None = None
    """Priors of map and semantic occupancy, of the training set of the heads."""

    def frame_names(self, frames: int) -> list[str]:
        """Return the names of now and the key frames after it: now, future_500ms, future_1s, …"""
        milliseconds = [round(1000 * k * self.frame_dt_s) for k in range(1, frames)]
        return ["now", *(f"future_{ms}ms" if ms % 1000 else f"future_{ms // 1000}s" for ms in milliseconds)]


PRIOR, STEADY = "best_constant", "constant_velocity"
"""Baselines of several metrics, as the last part of their keys: the fixed answer that scores best on the
training logs, and road users that go on as they drive."""
CEILING = "ceiling"
"""Last part of the keys of what the truth itself scores under a limit of the model: above its grid, or moved
along as it is now."""


@dataclass(frozen=True)
class Shown:
    """A main figure of a metric, as terminal and report show it."""

    title: str
    """With the unit, if it has one."""
    key: str
    """Key in the summary, without the metric's `name`."""
    baseline: str
    """Last part of the key of the figure beside it."""
    digits: int = 3


class Metric(Protocol):
    """Accumulates over the predictions of one model.

    Batches come in the loader's order, and so do the clips within each: a metric over whole logs finds their
    frames in order, named by `Example.key`. Clips whose prediction failed are left out.
    """

    name: str
    """First part of its keys in the summary; metrics of one subject share it."""
    title: str
    """Heading above its main figures."""
    shown: tuple[Shown, ...]
    """Its main figures; () where a table of its own shows them (`view.summary_tables`)."""
    needs: frozenset[Part]
    """Parts of a prediction that it reads. `update` is called only where none of them is None."""

    def update(self, prediction: Prediction, truth: Example) -> None:
        """Add b clips."""
        ...

    def result(self) -> Figures:
        """Return the figures over all clips, by key without `name`; NaN where nothing could be counted."""
        ...


MetricFactory = Callable[[EvaluationContext], Metric]
"""Starts a metric for one model; a class with such a constructor is one."""


def labels_from_now(labels: VoxelGrid, clip: Clip, frames: int) -> VoxelGrid:
    """Return the labels [b T …] of now and the `frames` - 1 key frames after it.

    Raises:
        InputError: if the clip ends before.
    """
    # Labels begin with past frames; now comes after them
    now = clip.now
    if now + frames > clip.t_s.shape[1]:
        raise InputError(
            f"{frames} frames from now on are predicted, but the clips hold only {clip.t_s.shape[1] - now}"
        )
    return labels[:, now : now + frames]
