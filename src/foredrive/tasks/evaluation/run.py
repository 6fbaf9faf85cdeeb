"""One pass over a data set: predictions and truth in, one flat summary out."""

import dataclasses
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from foredrive.debugging import profile_step
from foredrive.engine.provenance import peak_rss_gib
from foredrive.errors import InputError
from foredrive.scene import Agent, Example, Trajectory
from foredrive.scene.record import Record
from foredrive.tasks.evaluation.metrics import METRICS
from foredrive.tasks.metric import EvaluationContext, Figures, MetricFactory
from foredrive.tasks.occupancy.scores import OccupancyPrior
from foredrive.tasks.planning.protocols import STEPS
from foredrive.tasks.predictor import DriveFollowing, Part, PlannerPredictor, Prediction, Predictor
from foredrive.tasks.task_priors import TaskPriors

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


@dataclass(frozen=True)
class PredictedBatch:
    """A batch of examples and a model's predictions for it."""

    truth: Example | None
    """None if the batch could not be loaded."""
    parts: tuple[tuple[Int[Tensor, "_n"], Prediction], ...]
    """Predictions with the indices of their items, in order. Items that failed are in none."""
    failures: tuple[Failure, ...]

    @property
    def items(self) -> int:
        """Return the number of items, failed ones included."""
        return len(self.failures) if self.truth is None else len(self.truth.key)

    def to(self, device: torch.device | str) -> "PredictedBatch":
        """Return the batch on a device."""
        truth = None if self.truth is None else self.truth.to(device)
        parts = tuple((chosen.to(device), part.to(device)) for chosen, part in self.parts)
        return PredictedBatch(truth, parts, self.failures)


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
    """Judge a model and its baselines on every item of a loader; see `judge` for the other arguments.

    Args:
        predictor: sees `clip.observed()` only, and is asked for the parts that the metrics need. A metric
            gives no figures where the model leaves one of its parts None.
        loader: batches.

    Raises:
        InputError: if there are no items, or all of them failed.
    """
    return judge(
        predict_batches(predictor, loader, parts_needed(metrics), device),
        frame_dt_s=frame_dt_s,
        metrics=metrics,
        baselines=baselines,
        prior=prior,
        task_priors=task_priors,
        command_source=command_source,
        device=device,
        on_items=on_items,
        on_prediction=on_prediction,
    )


def parts_needed(metrics: Sequence[MetricFactory] = METRICS) -> frozenset[Part]:
    """Return the parts of a prediction that some metrics need."""
    context = EvaluationContext(1.0)
    return frozenset().union(*(start(context).needs for start in metrics))


@torch.inference_mode()
def predict_batches(
    predictor: Predictor,
    loader: Iterable[Example],
    asked: frozenset[Part],
    device: torch.device | str = "cpu",
) -> Generator[PredictedBatch, None, None]:
    """Yield the batches of a loader with their predictions.

    An item for which the predictor raises an error, or predicts a value that is not finite, counts as failed;
    its batch is then tried again item by item. Where the loader raises an InputError and can go on after it,
    a batch (of its `batch_size`; without one, an item) counts as failed.
    """
    batches = iter(loader)
    batch_size = getattr(loader, "batch_size", None) or 1
    while True:
        profile_step()
        try:
            example = next(batches).to(device)
        except StopIteration:
            return
        except InputError as error:  # the loader has moved on and can give the next batch
            yield PredictedBatch(None, (), (Failure("not loaded", _line(error)),) * batch_size)
            continue
        yield _predicted(predictor, example, asked)


def judge(
    batches: Iterable[PredictedBatch],
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
    """Judge predictions of a model, and baselines on the same items.

    Args:
        batches: of `predict_batches`, in the order of the data set.
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

    Raises:
        InputError: if there are no items, or all of them failed.
    """
    started = time.perf_counter()
    context = EvaluationContext(frame_dt_s, prior, task_priors)
    # The model and each baseline accumulate figures of their own
    model = _JudgedMethod(metrics, context)
    planners = {
        name: (PlannerPredictor(planner), _JudgedMethod(metrics, context, only=frozenset({"plan"})))
        for name, planner in (baselines or {}).items()
    }
    with torch.inference_mode():
        for batch in batches:
            model.add(batch, on_prediction)
            # Baselines see the same items, also those that the model failed on
            if batch.truth is not None:
                for predictor, method in planners.values():
                    method.add(_predicted(predictor, batch.truth.to(device), frozenset({"plan"})))
            on_items(batch.items)
    failed = len(model.failures)
    if model.items == 0:
        first = f"all {failed} items failed, {model.failures[0].reason}" if failed else "no items"
        raise InputError(f"there is nothing to evaluate: {first}")
    summary = model.figures()
    for name, (_, method) in planners.items():
        summary |= method.figures(f"{name}.") | {f"planning.{name}.failed": len(method.failures)}
    # Commands that come from the driven future leak it, so their source is part of the summary
    summary |= _command_figures(command_source or {})
    summary |= {"items": model.items + failed, "failed": failed}
    summary |= {"peak_rss_gib": peak_rss_gib(), "wall_s": time.perf_counter() - started}
    return EvaluationResult(summary, tuple(model.failures))


class _JudgedMethod:
    """The metrics and the failures of a model or baseline.

    Args:
        only: parts that it predicts, if that is known; metrics of others are not started.
    """

    def __init__(
        self,
        metrics: Sequence[MetricFactory],
        context: EvaluationContext,
        only: frozenset[Part] | None = None,
    ) -> None:
        started = [start(context) for start in metrics]
        # A baseline of plans gets the metrics that need nothing but a plan
        self._metrics = [metric for metric in started if only is None or metric.needs <= only]
        self._has_figures = [only is not None for _ in self._metrics]
        """Metrics that give figures: those that were updated, and all of them where `only` is given."""
        self.failures: list[Failure] = []
        self.items = 0
        """Number of clips that were predicted."""

    def add(
        self, batch: PredictedBatch, on_prediction: OnPrediction = lambda prediction, truth: None
    ) -> None:
        """Judge one batch."""
        self.failures.extend(batch.failures)
        for chosen, prediction in batch.parts:
            assert batch.truth is not None
            truth = _select(batch.truth, chosen)
            self.items += len(chosen)
            for number, metric in enumerate(self._metrics):
                # A metric counts only where the model gives all parts that it reads
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


def _predicted(predictor: Predictor, example: Example, asked: frozenset[Part]) -> PredictedBatch:
    """Predict one batch; if it fails, item by item."""
    batches, parts, failures = [torch.arange(len(example.key))], [], []
    while batches:
        # The queue holds index sets: first the whole batch, after an error its single items
        chosen = batches.pop(0)
        try:
            # The model sees the clip up to now only
            part = _select(example, chosen)
            observed = part.clip.observed()
            if isinstance(predictor, DriveFollowing):
                predictor.follow(part.key)
            prediction = predictor.predict(observed, asked)
        except Exception as error:  # whatever a model does wrong, the others are still to be judged
            if len(chosen) > 1:
                batches.extend(chosen[:, None])
            else:
                failures.append(Failure(example.key[int(chosen)], _line(error)))
            continue
        good = _is_complete(prediction).cpu()
        # Items with values that are not finite fail; the rest of the batch is kept
        bad = chosen[~good].tolist()
        failures.extend(Failure(example.key[i], "not finite or incomplete") for i in bad)
        if good.all():
            parts.append((chosen, prediction))
        elif good.any():
            parts.append((chosen[good], prediction[good]))
    return PredictedBatch(example, tuple(parts), tuple(failures))


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
