"""One pass over a data set: predictions and truth in, one flat summary out."""

import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Bool
from torch import Tensor

from foredrive.errors import InputError
from foredrive.evaluation.predictor import Prediction, Predictor
from foredrive.evaluation.provenance import peak_rss_gib
from foredrive.evaluation.totals import (
    Figures,
    FlowTotals,
    FuturesTotals,
    ImageTotals,
    OccupancyTotals,
    PlanningTotals,
)
from foredrive.metrics import Obstacles, VoxelPrior, future_obstacles
from foredrive.metrics.protocols import STEP_S, STEPS
from foredrive.scene import Agent, Clip, Example, Trajectory, VoxelGrid

R = TypeVar("R")


@dataclass(frozen=True)
class Failure:
    """An item that could not be loaded, predicted or planned. It is counted, never scored."""

    key: str
    reason: str


@dataclass(frozen=True)
class EvaluationResult:
    """What an evaluation found."""

    summary: Figures
    """Flat dotted keys; NaN where nothing could be counted."""
    failures: tuple[Failure, ...]
    """Of the model under evaluation; those of baselines are in `summary` as counts."""


def evaluate(
    predictor: Predictor,
    loader: Iterable[Example],
    *,
    frame_dt_s: float,
    baselines: Mapping[str, Agent] | None = None,
    prior: VoxelPrior | None = None,
    command_source: Mapping[str, int] | None = None,
    device: torch.device | str = "cpu",
    on_items: Callable[[int], None] = lambda items: None,
) -> EvaluationResult:
    """Judge a model, and planners it has to beat, on every item of a loader.

    Args:
        predictor: sees `clip.observed()` only. What it leaves None is not judged.
        loader: batches. For collisions up to 3 s their clips need boxes of the six key frames after now.
        frame_dt_s: time between key frames; names the figures of future frames.
        baselines: planners by name, judged on every item they manage, under `planning.NAME.PROTOCOL`.
        prior: of the training set, on the model's frames; adds `best_constant` beside every occupancy figure.
        command_source: how many commands came from a route, the driven future, nowhere.
        on_items: told the number of items after each batch.

    An item at which the predictor raises an error or says something that is not finite counts as failed; its
    batch is then tried again item by item. Where the loader raises an InputError and can go on after it, a
    batch (of its `batch_size`; without one, an item) counts as failed.

    Raises:
        InputError: if there are no items, or all of them failed.
    """
    started = time.perf_counter()
    totals = _Totals(frame_dt_s, prior)
    rivals = {name: _Baseline(planner) for name, planner in (baselines or {}).items()}
    failures: list[Failure] = []
    judged = 0
    with torch.inference_mode():
        for loaded in _load(loader, failures, on_items):
            example = loaded.to(device)
            obstacles = future_obstacles(example.clip, STEPS, STEP_S)
            for chosen, prediction in _attempt(predictor.predict, _whole_prediction, example, failures):
                totals.add(_select(example, chosen), prediction, obstacles[chosen])
                judged += len(chosen)
            for rival in rivals.values():
                rival.add(example, obstacles)
            on_items(len(example.key))
    if judged == 0:
        first = f"all {len(failures)} items failed, {failures[0].reason}" if failures else "no items"
        raise InputError(f"there is nothing to evaluate: {first}")
    summary = totals.figures()
    for name, rival in rivals.items():
        summary |= rival.figures(f"planning.{name}")
    summary |= _command_figures(command_source or {})
    summary |= {"items": judged + len(failures), "failed": len(failures)}
    summary |= {"peak_rss_gib": peak_rss_gib(), "wall_s": time.perf_counter() - started}
    return EvaluationResult(summary, tuple(failures))


class _Baseline:
    """A planner that is judged beside the model."""

    def __init__(self, planner: Agent) -> None:
        self._planner = planner
        self._totals = PlanningTotals()
        self._failures: list[Failure] = []

    def add(self, example: Example, obstacles: Obstacles) -> None:
        """Judge its plans for one batch."""
        for chosen, plan in _attempt(self._planner.act, _whole_plan, example, self._failures):
            self._totals.add(plan, example.clip.future[chosen], obstacles[chosen])

    def figures(self, prefix: str) -> Figures:
        """Its figures and the number of its failures."""
        return self._totals.figures(prefix) | {f"{prefix}.failed": len(self._failures)}


class _Totals:
    """The sums of everything the model may say; what it says shows with its first prediction."""

    def __init__(self, frame_dt_s: float, prior: VoxelPrior | None) -> None:
        self._frame_dt_s, self._prior = frame_dt_s, prior
        self._planning: PlanningTotals | None = None
        self._occupancy: OccupancyTotals | None = None
        self._futures: FuturesTotals | None = None
        self._flow: FlowTotals | None = None
        self._images: ImageTotals | None = None

    def add(self, example: Example, prediction: Prediction, obstacles: Obstacles) -> None:
        """Judge one batch."""
        clip, dt_s = example.clip, self._frame_dt_s
        if prediction.plan is not None:
            self._planning = self._planning or PlanningTotals()
            self._planning.add(prediction.plan, clip.future, obstacles)
        if prediction.occupancy_logit is not None:
            frames = prediction.occupancy_logit.shape[1]
            labels = labels_from_now(example.occupancy, clip, frames)
            self._occupancy = self._occupancy or OccupancyTotals(labels.spec, frames, dt_s, self._prior)
            T_world_ego = clip.T_world_ego[:, clip.now : clip.now + frames]
            self._occupancy.add(prediction.occupancy_logit > 0, labels, T_world_ego)
        if prediction.futures is not None:
            count, frames = prediction.futures.shape[1:3]
            labels = labels_from_now(example.occupancy, clip, frames + 1)[:, 1:]
            self._futures = self._futures or FuturesTotals(labels.spec, count, frames, dt_s)
            self._futures.add(prediction.futures, labels)
        if prediction.flow_mps is not None:
            frames = prediction.flow_mps.shape[1]
            self._flow = self._flow or FlowTotals(frames, dt_s)
            self._flow.add(prediction.flow_mps, labels_from_now(example.flow, clip, frames))
        if prediction.images is not None:
            self._images = self._images or ImageTotals(prediction.images.shape[1], dt_s)
            self._images.add(prediction.images, prediction.image_known, prediction.image_stride, clip)

    def figures(self) -> Figures:
        parts = (
            ("occupancy", self._occupancy),
            ("occupancy", self._futures),
            ("flow", self._flow),
            ("image", self._images),
            ("planning", self._planning),
        )
        out: Figures = {}
        for prefix, part in parts:
            if part is not None:
                out |= part.figures(prefix)
        return out


def labels_from_now(labels: VoxelGrid, clip: Clip, frames: int) -> VoxelGrid:
    """The labels [b T …] of now and the `frames` - 1 key frames after it.

    Raises:
        InputError: if the clip ends before.
    """
    now = clip.now
    if now + frames > clip.t_s.shape[1]:
        raise InputError(
            f"{frames} frames from now on are predicted, but the clips hold only {clip.t_s.shape[1] - now}"
        )
    return labels[:, now : now + frames]


def _load(
    loader: Iterable[Example], failures: list[Failure], on_items: Callable[[int], None]
) -> Iterator[Example]:
    """The batches that can be loaded."""
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


def _attempt(
    act: Callable[[Clip], R], whole: Callable[[R], Tensor], example: Example, failures: list[Failure]
) -> Iterator[tuple[Tensor, R]]:
    """What `act` says about an example, as (indices of items, result for them), without what failed."""
    batches = [torch.arange(len(example.key))]
    while batches:
        chosen = batches.pop(0)
        try:
            result = act(_select(example, chosen).clip.observed())
        except Exception as error:  # whatever a model does wrong, the others are still to be judged
            if len(chosen) > 1:
                batches.extend(chosen[:, None])
            else:
                failures.append(Failure(example.key[int(chosen)], _line(error)))
            continue
        good = whole(result).cpu()
        failures.extend(Failure(example.key[i], "not finite or incomplete") for i in chosen[~good].tolist())
        if good.all():
            yield chosen, result
        elif good.any():
            yield chosen[good], result[good]  # type: ignore[index]


def _select(example: Example, chosen: Tensor) -> Example:
    """Some items of a batch."""
    if len(chosen) == len(example.key):
        return example
    return dataclasses.replace(example[chosen], key=tuple(example.key[i] for i in chosen.tolist()))


def _whole_plan(plan: Trajectory) -> Bool[Tensor, "b"]:
    """Which plans are finite and have all their steps."""
    fine = plan.valid & plan.xy.isfinite().all(dim=-1) & plan.yaw.isfinite()
    return fine[..., :STEPS].flatten(1).all(dim=-1)


def _whole_prediction(prediction: Prediction) -> Bool[Tensor, "b"]:
    """Which predictions are finite in all they say."""
    said = (prediction.occupancy_logit, prediction.flow_mps, prediction.images)
    fine = [values.flatten(1).isfinite().all(dim=-1) for values in said if values is not None]
    if prediction.plan is not None:
        fine.append(_whole_plan(prediction.plan))
    if not fine:
        raise InputError("the model predicted nothing")
    return torch.stack(fine).all(dim=0)


def _command_figures(counts: Mapping[str, int]) -> Figures:
    """Where the commands came from: they leak when they are read off the driven future."""
    sources = [source for source, count in counts.items() if count]
    out: Figures = {"command_source": sources[0] if len(sources) == 1 else ("mixed" if sources else "none")}
    return out | {f"command_source.{source}": count for source, count in counts.items()}


def _line(error: Exception) -> str:
    """An error in one line."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0] if lines else ''}".removeprefix("InputError: ")
