"""The training loop: Lightning Fabric, exact resume, progress, a clean stop."""

import contextlib
import itertools
import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Float
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from foredrive.errors import InputError
from foredrive.files import atomic_path, naming
from foredrive.training.checkpoints import latest_checkpoint, load_checkpoint, save_checkpoint
from foredrive.training.interrupts import end_with_parent, hold_interrupts, start_fork_server
from foredrive.training.one_cycle import OneCycle
from foredrive.training.parameter_groups import parameter_groups
from foredrive.training.ranges import check_at_least

if TYPE_CHECKING:  # slow to import, and not needed to read schedules and metrics
    from lightning_fabric import Fabric

CHECKPOINTS = "checkpoints"


@runtime_checkable
class Batch(Protocol):
    """The input of an objective. It is a record that can be moved to a device."""

    @property
    def key(self) -> tuple[str, ...]:
        """Names of its items, for error messages."""
        ...


B = TypeVar("B", bound=Batch)

CONDITIONS = "conditions.json"
"""File of a stage: device, precision and number of processes."""


@dataclass(frozen=True)
class Schedule:
    """Length and learning rate of a training: AdamW, linear warm-up, then a cosine to `final_lr_fraction`.

    With `one_cycle`, learning rate and momentum follow this policy instead.

    The length is given in steps, or in epochs over the data when `steps` is None. Steps, here and in
    `warmup_steps`, are those of one process: N processes consume N batches at a time and so take 1/N as many.
    """

    batch_size: int
    """Items of one process in one step."""
    lr: float
    steps: int | None = None
    epochs: int | None = None
    weight_decay: float = 1e-2
    """Decay of weight matrices and filters, see `parameter_groups`."""
    warmup_steps: int = 0
    final_lr_fraction: float = 0.0
    clip_grad_norm: float = 35.0
    checkpoint_every: int = 200
    workers: int = 0
    seed: int = 0
    one_cycle: OneCycle | None = None

    def __post_init__(self) -> None:
        """Check the numbers' ranges. No steps are allowed: then nothing is trained."""
        check_at_least(self, batch_size=1, lr=0, steps=0, epochs=0, weight_decay=0, warmup_steps=0)
        check_at_least(self, final_lr_fraction=0, clip_grad_norm=0, checkpoint_every=1, workers=0)

    def total_steps(self, items: int, processes: int = 1) -> int:
        """Return the number of steps over a data set of `items` that several processes share."""
        if (self.steps is None) == (self.epochs is None):
            raise InputError("a schedule has either steps or epochs")
        if self.steps is not None:
            return math.ceil(self.steps / processes)
        assert self.epochs is not None
        return self.epochs * math.ceil(items / (self.batch_size * processes))

    def lr_at(self, step: int, total: int, processes: int = 1) -> float:
        """Return the learning rate of step `step` (from 0) of `total`."""
        if self.one_cycle is not None:
            return self.lr * self.one_cycle.at(step, total)[0]
        warmup = math.ceil(self.warmup_steps / processes)
        if step < warmup:
            return self.lr * (step + 1) / warmup
        progress = (step - warmup) / max(total - warmup, 1)
        floor = self.final_lr_fraction
        return self.lr * (floor + (1 - floor) * 0.5 * (1 + math.cos(math.pi * progress)))


def batch_order(
    items: int, batch_size: int, seed: int, weights: Float[Tensor, "N"] | None = None
) -> Iterator[list[int]]:
    """Yield endless batches of indices, reproducible by `seed`.

    Each epoch is a new permutation. With weights, it is as many draws with replacement.
    """
    for epoch in itertools.count():
        generator = torch.Generator().manual_seed(seed * 1_000_003 + epoch)
        if weights is None:
            order = torch.randperm(items, generator=generator).tolist()
        else:
            order = torch.multinomial(weights, items, replacement=True, generator=generator).tolist()
        for start in range(0, items, batch_size):
            yield order[start : start + batch_size]


def train(
    objective: nn.Module,
    dataset: Dataset[B],
    collate: Callable[[list[B]], B],
    schedule: Schedule,
    folder: Path,
    fabric: "Fabric",
    weights: Float[Tensor, "N"] | None = None,
) -> None:
    """Train `objective` on `dataset`, continuing from a checkpoint in `folder` if there is one.

    `objective(example, generator)` returns losses by name; "loss" is minimised. Writes `folder/metrics.jsonl`
    and `folder/checkpoints/step_N`. An interrupted run that is resumed gives the same losses as an
    uninterrupted one: data order and random numbers follow from the seed and the step. Ctrl-C ends the run
    after the current step, with a checkpoint. A second Ctrl-C ends it at once.

    With `weights`, items are drawn in proportion to them.

    Raises:
        InputError: the data set is empty, or a loss is not finite (the message names the batch).
    """
    items = len(dataset)  # type: ignore[arg-type]
    if items == 0:
        raise InputError("there is nothing to train on: the data set is empty")
    total = schedule.total_steps(items, fabric.world_size)
    groups = parameter_groups(objective, schedule.weight_decay)
    optimizer = torch.optim.AdamW(groups, lr=schedule.lr, fused=True)
    model, fabric_optimizer = fabric.setup(objective, optimizer)
    found = latest_checkpoint(folder / CHECKPOINTS)
    done = load_checkpoint(found, objective, optimizer) if found is not None else 0
    if done >= total:
        return
    if fabric.is_global_zero:
        write_conditions(folder, fabric)
    loader: Any = fabric.setup_dataloaders(
        _loader(dataset, collate, schedule, done, total, fabric, weights), use_distributed_sampler=False
    )
    model.train()
    with step_counter(
        folder, objective, optimizer, done, total, schedule.checkpoint_every, writes=fabric.is_global_zero
    ) as end_step:
        for step, example in enumerate(loader, start=done):
            losses = _one_step(model, fabric_optimizer, example, step, total, schedule, fabric)
            if end_step(losses, f"loss {losses['loss'].item():.3f}"):
                break


@contextlib.contextmanager
def step_counter(
    folder: Path,
    model: nn.Module,
    optimizer: torch.optim.Optimizer,
    done: int,
    total: int,
    checkpoint_every: int,
    *,
    writes: bool = True,
) -> Iterator[Callable[[dict[str, Tensor], str], bool]]:
    """Count, log, show and save the steps of a training. Ctrl-C takes effect at the end of a step.

    Args:
        folder: folder for the metrics and checkpoints.
        model, optimizer: what a checkpoint holds.
        done: number of steps that are finished.
        total: number of steps at the end.
        checkpoint_every: steps between checkpoints. The last step has one too.
        writes: whether this process writes files and shows progress.

    Yields:
        a function to call after each step with its losses and a note to show. It returns whether to stop.
    """
    log = MetricsLog(folder / "metrics.jsonl", done) if writes else None
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with (
        hold_interrupts() as interrupted,
        Progress(*columns, TextColumn("{task.fields[note]}"), disable=not writes) as progress,
    ):
        task = progress.add_task(folder.name, total=total, completed=done, note="")
        step = done

        def end_step(losses: dict[str, Tensor], note: str) -> bool:
            nonlocal step
            step += 1
            if log is not None:
                log.add(step, losses)
            progress.update(task, completed=step, note=note)
            last = step == total or interrupted()
            if writes and (last or step % checkpoint_every == 0):
                save_checkpoint(folder / CHECKPOINTS, model, optimizer, step)
            return last

        yield end_step


def _loader(
    dataset: Dataset[B],
    collate: Callable[[list[B]], B],
    schedule: Schedule,
    done: int,
    total: int,
    fabric: "Fabric",
    weights: Float[Tensor, "N"] | None,
) -> DataLoader[B]:
    """Return batches from step `done` on. Each rank takes its share of every global batch."""
    items = len(dataset)  # type: ignore[arg-type]
    batches = itertools.islice(
        batch_order(items, schedule.batch_size * fabric.world_size, schedule.seed, weights), done, total
    )
    if schedule.workers:
        start_fork_server(preload=type(dataset).__module__)
    mine = [_rank_part(batch, fabric.global_rank, fabric.world_size) for batch in batches]
    return DataLoader(
        dataset,
        batch_sampler=mine,
        collate_fn=collate,
        num_workers=schedule.workers,
        worker_init_fn=end_with_parent,
        # Forked workers crash if numba's threads have run in the parent.
        multiprocessing_context="forkserver" if schedule.workers else None,
    )


def _rank_part(batch: Sequence[int], rank: int, world_size: int) -> list[int]:
    """Return a rank's part of a batch. Every rank gets at least one item, also of a short last batch."""
    padded = list(itertools.islice(itertools.cycle(batch), max(len(batch), world_size)))
    return padded[rank::world_size]


def _one_step(
    model: nn.Module,
    optimizer: Any,
    example: Batch,
    step: int,
    total: int,
    schedule: Schedule,
    fabric: "Fabric",
) -> dict[str, Tensor]:
    for group in optimizer.param_groups:
        group["lr"] = schedule.lr_at(step, total, fabric.world_size)
        if schedule.one_cycle is not None:
            group["betas"] = (schedule.one_cycle.at(step, total)[1], group["betas"][1])
    seed = (schedule.seed * 1_000_003 + step) * 1009 + fabric.global_rank
    torch.manual_seed(seed)  # dropout
    losses: dict[str, Tensor] = model(example, torch.Generator().manual_seed(seed))
    check_finite(losses, step, f"the batch {', '.join(example.key)}")
    optimizer.zero_grad(set_to_none=True)
    fabric.backward(losses["loss"])
    fabric.clip_gradients(model, optimizer, max_norm=schedule.clip_grad_norm, error_if_nonfinite=False)
    optimizer.step()
    return {name: value.detach() for name, value in losses.items()}


def write_conditions(folder: Path, fabric: "Fabric") -> None:
    """Write device, precision and number of processes of a training to `folder/conditions.json`.

    The precision is the one that was used: bfloat16 is not where it would be slower.
    """
    device = fabric.device.type
    with fabric.autocast():
        dtype = torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else torch.float32
    conditions = {
        "device": device,
        "precision": str(dtype).removeprefix("torch."),
        "processes": fabric.world_size,
    }
    with atomic_path(folder / CONDITIONS) as temporary:
        temporary.write_text(json.dumps(conditions) + "\n")


def check_finite(losses: dict[str, Tensor], step: int, source: str) -> None:
    """Check the losses of a step.

    Raises:
        InputError: a loss is not finite. The message names `source`, the data of the step.
    """
    if not bool(torch.stack([value.detach() for value in losses.values()]).isfinite().all()):
        values = ", ".join(f"{name} = {value.item():g}" for name, value in losses.items())
        raise InputError(f"step {step + 1}: loss is not finite ({values}) on {source}")


class MetricsLog:
    """The file metrics.jsonl, one line per step. Lines after the resumed step are dropped.

    `step_s` is the time since the step before, `cpu_s` this process's CPU time, without its data workers.
    """

    def __init__(self, path: Path, done: int) -> None:
        kept = [line for line in read_metrics(path) if line["step"] <= done]
        with atomic_path(path) as temporary:
            temporary.write_text("".join(json.dumps(line) + "\n" for line in kept))
        self.path = path
        self._wall_s, self._cpu_s = time.perf_counter(), time.process_time()

    def add(self, step: int, losses: dict[str, Tensor]) -> None:
        """Write the losses of one finished step."""
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        took = {"step_s": round(wall_s - self._wall_s, 4), "cpu_s": round(cpu_s - self._cpu_s, 4)}
        line = {"step": step, **{name: value.item() for name, value in losses.items()}}
        with naming(self.path), self.path.open("a") as file:
            file.write(json.dumps({**line, **took}) + "\n")
        self._wall_s, self._cpu_s = wall_s, cpu_s


def read_metrics(path: Path) -> list[dict[str, float | int]]:
    """Return the lines of a metrics file. A last line cut off by a crash is left out."""
    lines = []
    for text in path.read_text().splitlines() if path.exists() else []:
        try:
            lines.append(json.loads(text))
        except json.JSONDecodeError:
            break
    return lines
