"""The training loop: Lightning Fabric, exact resume, progress, a clean stop."""

import contextlib
import itertools
import json
import logging
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Float
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from foredrive.debugging import profile_step
from foredrive.engine.checkpoints import latest_checkpoint, load_checkpoint, remove_older, save_checkpoint
from foredrive.engine.interrupts import end_with_parent, hold_interrupts, start_fork_server
from foredrive.engine.metrics_log import MetricsLog
from foredrive.engine.one_cycle import OneCycle
from foredrive.engine.parameter_groups import parameter_groups
from foredrive.engine.parts import Part, StepBuffers, mean_losses, parts_of_step
from foredrive.engine.processes import gathered, naming_lost_processes
from foredrive.engine.ranges import check_at_least
from foredrive.errors import InputError
from foredrive.files import atomic_path

if TYPE_CHECKING:  # Slow to import, and not needed to read schedules and metrics
    from lightning_fabric import Fabric
    from lightning_fabric.wrappers import _FabricModule

_log = logging.getLogger(__name__)
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
"""File of a stage: device, precision, number of processes and parts of a step."""


@dataclass(frozen=True)
class Schedule:
    """Length and learning rate of a training: AdamW, linear warm-up, then a cosine to `final_lr_fraction`.

    With `one_cycle`, learning rate and momentum follow this policy instead.

    The length is given in steps, or in epochs over the data when `steps` is None. A step is the same on any
    number of processes: they share its items.
    """

    batch_size: int
    """Items of one step, of all processes together."""
    lr: float
    """Maximum of the learning rate."""
    steps: int | None = None
    """Number of steps; None: `epochs` gives the length."""
    epochs: int | None = None
    """Number of passes over the data; None: `steps` gives the length."""
    weight_decay: float = 1e-2
    """Decay of weight matrices and filters, see `parameter_groups`."""
    warmup_steps: int = 0
    """Steps in which the learning rate rises linearly to `lr`."""
    final_lr_fraction: float = 0.0
    """Learning rate at the end of the cosine, as a fraction of `lr`."""
    clip_grad_norm: float = 35.0
    """Maximum norm of the gradient of a step; longer gradients are scaled down to it."""
    checkpoint_every: int = 200
    """Steps between checkpoints."""
    workers: int = 0
    """Processes that read the items of a training process; 0: it reads them itself."""
    seed: int = 0
    """Seed of the order of the items and of random numbers."""
    one_cycle: OneCycle | None = None
    """1cycle policy of learning rate and momentum; None: warm-up and cosine."""
    accumulate: int = 1
    """Parts of a step, computed one after the other or in several processes; their gradients are accumulated.
    A step has at least as many parts as processes. With the same number of parts, losses are the same on any
    number of processes."""

    def __post_init__(self) -> None:
        """Check the numbers' ranges. No steps are allowed: then nothing is trained."""
        check_at_least(self, batch_size=1, lr=0, steps=0, epochs=0, weight_decay=0, warmup_steps=0)
        check_at_least(self, final_lr_fraction=0, clip_grad_norm=0, checkpoint_every=1, workers=0)
        check_at_least(self, accumulate=1)

    def parts(self, processes: int, begun_with: int = 1) -> int:
        """Return the number of parts of a step.

        Args:
            processes: number of processes. Each computes at least one part.
            begun_with: parts with which the training began.

        Raises:
            InputError: a step has fewer items.
        """
        count = max(self.accumulate, processes, begun_with)
        if count > self.batch_size:
            raise InputError(
                f"{count} processes or parts share the {self.batch_size} items of a step: "
                f"set batch_size in the recipe's schedules to {count} or more"
            )
        return count

    def total_steps(self, items: int) -> int:
        """Return the number of steps over a data set of `items`."""
        if (self.steps is None) == (self.epochs is None):
            raise InputError("a schedule has either steps or epochs")
        if self.steps is not None:
            return self.steps
        assert self.epochs is not None
        return self.epochs * math.ceil(items / self.batch_size)

    def lr_at(self, step: int, total: int) -> float:
        """Return the learning rate of step `step` (from 0) of `total`."""
        if self.one_cycle is not None:
            return self.lr * self.one_cycle.at(step, total)[0]
        if step < self.warmup_steps:
            return self.lr * (step + 1) / self.warmup_steps
        progress = (step - self.warmup_steps) / max(total - self.warmup_steps, 1)
        floor = self.final_lr_fraction
        return self.lr * (floor + (1 - floor) * 0.5 * (1 + math.cos(math.pi * progress)))


def batch_order(
    items: int, batch_size: int, seed: int, weights: Float[Tensor, "N"] | None = None
) -> Iterator[list[int]]:
    """Yield endless batches of indices, reproducible by `seed`.

    Each epoch is a new permutation. With weights, it is as many draws with replacement.
    """
    for epoch in itertools.count():
        # Each epoch has its own seed, so that a resumed training finds its place without any state
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

    Several processes share the parts of each step, and the first one writes. All end after the same step.

    Raises:
        InputError: the data set is empty, a loss is not finite (the message names the batch), there are more
            processes than items of a step, or another process has ended.
    """
    items = len(dataset)  # type: ignore[arg-type]
    if items == 0:
        raise InputError("there is nothing to train on: the data set is empty")
    total = schedule.total_steps(items)
    # A resumed training keeps the parts with which it began: the losses depend on their number
    parts = schedule.parts(fabric.world_size, _parts_before(folder))
    with naming_lost_processes(fabric):
        model = fabric.setup_module(objective)
        groups = parameter_groups(objective, schedule.weight_decay)
        optimizer = torch.optim.AdamW(groups, lr=schedule.lr, fused=True)
        # All processes resume from the checkpoint that the first one sees
        checkpoint = fabric.broadcast(latest_checkpoint(folder / CHECKPOINTS))
        done = 0 if checkpoint is None else load_checkpoint(checkpoint, objective, optimizer)
        if checkpoint is not None and fabric.is_global_zero:
            remove_older(checkpoint)
        if done >= total:
            return
        if fabric.is_global_zero:
            write_conditions(folder, fabric, parts)
        weights_count = sum(p.numel() for p in objective.parameters())
        _log.info("%s: steps %d to %d on %s, %d weights", folder, done, total, fabric.device, weights_count)
        # Skip the batches of finished steps
        batches = itertools.islice(
            batch_order(items, schedule.batch_size, schedule.seed, weights), done, total
        )
        # Process r of n computes the parts r, r + n, ... of each step
        mine = [parts_of_step(batch, parts)[fabric.global_rank :: fabric.world_size] for batch in batches]
        loader: Any = fabric.setup_dataloaders(
            _loader(dataset, collate, mine, schedule.workers, pinned=fabric.device.type == "cuda"),
            use_distributed_sampler=False,
        )
        model.train()
        steps = _Steps(
            model, fabric.setup_optimizers(optimizer), StepBuffers(objective), schedule, total, fabric
        )
        # The loader yields the parts of all steps of this process one after the other
        examples = iter(loader)
        with step_counter(
            folder,
            objective,
            optimizer,
            done,
            total,
            schedule.checkpoint_every,
            writes=fabric.is_global_zero,
            agreed=lambda stop: any(gathered(stop, fabric)),
        ) as end_step:
            for step, own in enumerate(mine, start=done):
                losses = steps.take(step, own, examples)
                if end_step(losses, f"loss {losses['loss'].item():.3f}"):
                    break
        # In an interrupted process `step_counter` raises this itself; the other processes end in the same way
        if step + 1 < total:
            raise KeyboardInterrupt


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
    agreed: Callable[[bool], bool] = bool,
) -> Iterator[Callable[[dict[str, Tensor], str], bool]]:
    """Count, log, show and save the steps of a training. Ctrl-C takes effect at the end of a step.

    Args:
        folder: folder for the metrics and checkpoints.
        model, optimizer: what a checkpoint holds.
        done: number of steps that are finished.
        total: number of steps at the end.
        checkpoint_every: steps between checkpoints. The last step has one too.
        writes: whether this process writes files and shows progress.
        agreed: returns whether any process has to stop, from whether this one has to.

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
            profile_step()
            if log is not None:
                log.add(step, losses)
            progress.update(task, completed=step, note=note)
            # All processes have to stop after the same step: saving and the next step need them all
            last = agreed(interrupted()) or step == total
            if last or step % checkpoint_every == 0:
                save_checkpoint(folder / CHECKPOINTS, model, optimizer, step, writes=writes)
            return last

        yield end_step


def _loader(
    dataset: Dataset[B],
    collate: Callable[[list[B]], B],
    steps: Sequence[Sequence[Part]],
    workers: int,
    *,
    pinned: bool,
) -> DataLoader[B]:
    """Return the parts of steps, one after the other."""
    if workers:
        start_fork_server(preload=type(dataset).__module__)
    return DataLoader(
        dataset,
        batch_sampler=[part.items for parts in steps for part in parts],
        collate_fn=collate,
        num_workers=workers,
        pin_memory=pinned,
        worker_init_fn=end_with_parent,
        # Forked workers crash if numba's threads have run in the parent.
        multiprocessing_context="forkserver" if workers else None,
    )


@dataclass(frozen=True)
class _Steps:
    """The model, optimizer and settings that a step needs besides its data."""

    model: "_FabricModule"
    optimizer: Any
    buffers: StepBuffers
    schedule: Schedule
    total: int
    fabric: "Fabric"

    def take(self, step: int, parts: Sequence[Part], examples: Iterator[Batch]) -> dict[str, Tensor]:
        """Take a step from this process' parts; return the losses of all processes, by name."""
        self._set_rates(step)
        self.optimizer.zero_grad(set_to_none=True)
        # One part is the whole step, and its buffers need no averaging
        in_parts = parts[0].weight < 1
        if in_parts:
            self.buffers.begin()
        results, complaint = [], None
        for part in parts:
            last = part is parts[-1]
            example = next(examples)
            # Processes exchange gradients only once, after the last part of each
            with self.fabric.no_backward_sync(self.model, enabled=not last):
                losses = self._backward(step, part, example)
            if in_parts:
                self.buffers.end_part(part.weight, last=last)
            results.append((part.weight, {name: value.item() for name, value in losses.items()}))
            # Not raised here: the other processes would wait for this one
            complaint = complaint or _not_finite(losses, step, f"the batch {', '.join(example.key)}")
        if in_parts:
            self.buffers.end(processes=self.fabric.world_size)
        everywhere = gathered((results, complaint), self.fabric)
        for _, fault in everywhere:
            if fault is not None:
                raise InputError(fault)
        # The losses are finite everywhere. Gradients are not checked, only clipped
        self.fabric.clip_gradients(
            self.model, self.optimizer, max_norm=self.schedule.clip_grad_norm, error_if_nonfinite=False
        )
        self.optimizer.step()
        means = mean_losses(itertools.chain.from_iterable(losses for losses, _ in everywhere))
        return {name: torch.tensor(value, dtype=torch.float64) for name, value in means.items()}

    def _set_rates(self, step: int) -> None:
        one_cycle = self.schedule.one_cycle
        for group in self.optimizer.param_groups:
            group["lr"] = self.schedule.lr_at(step, self.total)
            if one_cycle is not None:
                group["betas"] = (one_cycle.at(step, self.total)[1], group["betas"][1])

    def _backward(self, step: int, part: Part, example: Batch) -> dict[str, Tensor]:
        """Return the losses of a part; add its share to the gradients."""
        # A part has the same random numbers in whichever process computes it
        seed = (self.schedule.seed * 1_000_003 + step) * 1009 + part.number
        torch.manual_seed(seed)  # For dropout
        losses: dict[str, Tensor] = self.model(example, torch.Generator().manual_seed(seed))
        # Fabric averages the gradients over processes, but the parts' weights already add up to 1
        self.fabric.backward(losses["loss"] * (part.weight * self.fabric.world_size))
        return on_host(losses)


def _parts_before(folder: Path) -> int:
    """Return the number of parts with which a training began; 1 if it has not begun."""
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError):
        return int(json.loads((folder / CONDITIONS).read_text())["parts"])
    return 1


def write_conditions(folder: Path, fabric: "Fabric", parts: int) -> None:
    """Write device, precision, number of processes and parts of a step to `folder/conditions.json`.

    The precision is the one that is used, which is not bfloat16 where that would be slower.
    """
    device = fabric.device.type
    with fabric.autocast():
        dtype = torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else torch.float32
    conditions = {
        "device": device,
        "precision": str(dtype).removeprefix("torch."),
        "processes": fabric.world_size,
        "parts": parts,
    }
    with atomic_path(folder / CONDITIONS) as temporary:
        temporary.write_text(json.dumps(conditions) + "\n")


def on_host(losses: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the losses of a step on the CPU. A GPU is waited for once, not once for each."""
    values = torch.stack([value.detach().double() for value in losses.values()]).cpu()
    return dict(zip(losses, values, strict=True))


def check_finite(losses: dict[str, Tensor], step: int, source: str) -> None:
    """Check the losses of a step.

    Raises:
        InputError: a loss is not finite. The message names `source`, the data of the step.
    """
    complaint = _not_finite(losses, step, source)
    if complaint is not None:
        raise InputError(complaint)


def _not_finite(losses: dict[str, Tensor], step: int, source: str) -> str | None:
    """Return a message if a loss of a step is not finite, else None."""
    if bool(torch.stack([value.detach() for value in losses.values()]).isfinite().all()):
        return None
    values = ", ".join(f"{name} = {value.item():g}" for name, value in losses.items())
    return f"step {step + 1}: loss is not finite ({values}) on {source}"
