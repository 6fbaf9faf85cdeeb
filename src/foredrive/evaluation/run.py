"""One pass over a data set: predictions and truth in, one flat summary out."""

import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

import torch
from jaxtyping import Bool
from torch import Tensor

from foredrive.errors import InputError
from foredrive.evaluation.metric import EvaluationContext, Figures, MetricFactory
from foredrive.evaluation.metrics import METRICS
from foredrive.evaluation.predictor import (
    DriveFollowing,
    Part,
    PlannerPredictor,
    Prediction,
    Predictor,
)
from foredrive.evaluation.provenance import peak_rss_gib
from foredrive.evaluation.task_priors import TaskPriors
from foredrive.metrics.occupancy import OccupancyPrior
from foredrive.metrics.protocols import STEPS
from foredrive.scene import Agent, Example, Trajectory
from foredrive.scene.record import Record

OnPrediction = Callable[[Prediction, Example], None]
"""Called with predictions and their truth."""


@dataclass(frozen=True)
class Failure:
    """An item that could not be loaded, predicted or planned. It is counted, never scored."""

    key: str
    reason: str


@dataclass(frozen=True)
class EvaluationResult:
    """The figures of an evaluation, and its failures."""

    summary: Figures
    """Flat dotted keys; NaN where nothing could be counted."""
    failures: tuple[Failure, ...]
    """Of the model under evaluation; those of baselines are in `summary` as counts."""


def evaluate(
    predictor: Predictor,
    loader: Iterable[Example],
    *,
    frame_dt_s: float,
    metrics: Sequence[MetricFactory] = METRICS,
    baselines: Mapping[str, Agent] | None = None,
    prior: OccupancyPrior | None = None,
    task_priors: TaskPriors | None = None,
    command_source: Mapping[str, int] | None = None,
    device: torch.device | str = "cpu",
    on_items: Callable[[int], None] = lambda items: None,
    on_prediction: OnPrediction = lambda prediction, truth: None,
) -> EvaluationResult:
    """Judge a model and its baselines on every item of a loader.

    Args:
        predictor: sees `clip.observed()` only, and is asked for the parts that the metrics need. A metric
            gives no figures where the model leaves one of its parts None.
        loader: batches.
        frame_dt_s: time between key frames; names the figures of future frames.
        metrics: started once for the model and once for each baseline.
        baselines: planners by name, judged by the metrics of plans on every item that they manage. Their keys
            are `METRIC.BASELINE.KEY`, where the model's are `METRIC.KEY`.
        prior: of the training set, on the model's frames; stands beside every occupancy figure.
        task_priors: of the training set of the heads; stand beside figures of maps and semantic voxels.
        command_source: how many commands came from a route, the driven future, nowhere.
        on_items: called with the number of items after each batch.
        on_prediction: called with the model's predictions and their truth, batch by batch. Failed items are
            left out.

    An item for which the predictor raises an error, or predicts a value that is not finite, counts as failed;
    its batch is then tried again item by item. Where the loader raises an InputError and can go on after it,
    a batch (of its `batch_size`; without one, an item) counts as failed.

    Raises:
        InputError: if there are no items, or all of them failed.
    """
    started = time.perf_counter()
    context = EvaluationContext(frame_dt_s, prior, task_priors)
    model = _EvaluatedMethod(predictor, metrics, context)
    planners = {
        name: _EvaluatedMethod(PlannerPredictor(planner), metrics, context, only=frozenset({"plan"}))
        for name, planner in (baselines or {}).items()
    }
    with torch.inference_mode():
        for loaded in _load(loader, model.failures, on_items):
            example = loaded.to(device)
            model.add(example, on_prediction)
            for planner in planners.values():
                planner.add(example)
            on_items(len(example.key))
    failed = len(model.failures)
    if model.items == 0:
        first = f"all {failed} items failed, {model.failures[0].reason}" if failed else "no items"
        raise InputError(f"there is nothing to evaluate: {first}")
    summary = _figures(model, planners) | _command_figures(command_source or {})
    summary |= {"items": model.items + failed, "failed": failed}
    summary |= {"peak_rss_gib": peak_rss_gib(), "wall_s": time.perf_counter() - started}
    return EvaluationResult(summary, tuple(model.failures))


class _EvaluatedMethod:
    """A model or baseline, its metrics and its failures.

    Args:
        only: parts that it predicts, if that is known; metrics of others are not started.
    """

    def __init__(
        self,
        predictor: Predictor,
        metrics: Sequence[MetricFactory],
        context: EvaluationContext,
        only: frozenset[Part] | None = None,
    ) -> None:
        self._predictor = predictor
        started = [start(context) for start in metrics]
        self._metrics = [metric for metric in started if only is None or metric.needs <= only]
        self._asked: frozenset[Part] = frozenset().union(*(metric.needs for metric in self._metrics))
        self._has_figures = [only is not None for _ in self._metrics]
        """Metrics that give figures: those that were updated, and all of them where `only` is given."""
        self.failures: list[Failure] = []
        self.items = 0
        """Number of clips that were predicted."""

    def add(self, example: Example, on_prediction: OnPrediction = lambda prediction, truth: None) -> None:
        """Predict and judge one batch."""
        for chosen, prediction in self._attempt(example):
            truth = _select(example, chosen)
            self.items += len(chosen)
            for number, metric in enumerate(self._metrics):
                if all(getattr(prediction, part) is not None for part in metric.needs):
                    metric.update(prediction, truth)
                    self._has_figures[number] = True
            on_prediction(prediction, truth)

    def figures(self, infix: str = "") -> Figures:
        """Return the figures of all metrics, `infix` standing between a metric's name and its keys."""
        return {
            f"{metric.name}.{infix}{key}": value
            for metric, met in zip(self._metrics, self._has_figures, strict=True)
            if met
            for key, value in metric.result().items()
        }

    def _attempt(self, example: Example) -> Iterator[tuple[Tensor, Prediction]]:
        """Yield predictions with the indices of their items, in order; note the failures."""
        batches = [torch.arange(len(example.key))]
        while batches:
            chosen = batches.pop(0)
            try:
                part = _select(example, chosen)
                observed = part.clip.observed()
                if isinstance(self._predictor, DriveFollowing):
                    self._predictor.follow(part.key)
                prediction = self._predictor.predict(observed, self._asked)
            except Exception as error:  # whatever a model does wrong, the others are still to be judged
                if len(chosen) > 1:
                    batches.extend(chosen[:, None])
                else:
                    self.failures.append(Failure(example.key[int(chosen)], _line(error)))
                continue
            good = _is_complete(prediction).cpu()
            bad = chosen[~good].tolist()
            self.failures.extend(Failure(example.key[i], "not finite or incomplete") for i in bad)
            if good.all():
                yield chosen, prediction
            elif good.any():
                yield chosen[good], prediction[good]


def _figures(model: _EvaluatedMethod, planners: Mapping[str, _EvaluatedMethod]) -> Figures:
    """Return the figures of the model and of its baselines."""
    summary = model.figures()
    for name, method in planners.items():
        summary |= method.figures(f"{name}.") | {f"planning.{name}.failed": len(method.failures)}
    return summary


def _load(
    loader: Iterable[Example], failures: list[Failure], on_items: Callable[[int], None]
) -> Iterator[Example]:
    """Yield the batches that can be loaded; note those that cannot."""
    batches = iter(loader)
    batch_size = getattr(loader, "batch_size", None) or 1
    while True:
        try:
            batch = next(batches)
        except StopIteration:
            return
        except InputError as error:  # the loader has moved on and can give the next batch
            failures.extend([Failure("not loaded", _line(error))] * batch_size)
            on_items(batch_size)
            continue
        yield batch


def _select(example: Example, chosen: Tensor) -> Example:
    """Return some items of a batch."""
    if len(chosen) == len(example.key):
        return example
    return dataclasses.replace(example[chosen], key=tuple(example.key[i] for i in chosen.tolist()))


def _is_complete(prediction: Prediction) -> Bool[Tensor, "b"]:
    """Return which of b predictions are finite in all their parts.

    Raises:
        InputError: if all parts are None.
    """
    parts = [getattr(prediction, part) for part in get_args(Part)]
    fine = [_is_part_complete(part) for part in parts if part is not None]
    if not fine:
        raise InputError("the model predicted nothing")
    return torch.stack(fine).all(dim=0)


def _is_part_complete(part: Record | Tensor) -> Bool[Tensor, "b"]:
    """Return which of b items are finite; a plan has all steps that are scored, too."""
    if isinstance(part, Trajectory):
        fine = part.valid & part.xy.isfinite().all(dim=-1) & part.yaw.isfinite()
        return fine[..., :STEPS].flatten(1).all(dim=-1)
    if isinstance(part, Record):
        tensors = [value for value in vars(part).values() if isinstance(value, Tensor)]
        return torch.stack([_is_part_complete(tensor) for tensor in tensors]).all(dim=0)
    return part.isfinite().reshape(len(part), -1).all(dim=-1)


def _command_figures(counts: Mapping[str, int]) -> Figures:
    """Return where the commands came from: read off the driven future, they leak it."""
    sources = [source for source, count in counts.items() if count]
    out: Figures = {"command_source": sources[0] if len(sources) == 1 else ("mixed" if sources else "none")}
    return out | {f"command_source.{source}": count for source, count in counts.items()}


def _line(error: Exception) -> str:
    """Return an error as one line."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0] if lines else ''}".removeprefix("InputError: ")
