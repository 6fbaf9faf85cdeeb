"""Training of a scene of any representation from the images and sweeps of a drive.

The loop is here: seeds, rates, steps of Adam, checkpoints. A representation says what a step looks at, what
its losses are, and how the scene changes besides (`SceneTraining`).
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor, nn
from torch.optim import Adam, Optimizer

from foredrive.engine.checkpoints import latest_checkpoint, load_checkpoint, remove_older
from foredrive.engine.learning_rates import Rate
from foredrive.engine.loop import CHECKPOINTS, check_finite, on_host, step_counter
from foredrive.errors import InputError
from foredrive.methods.reconstruction.reconstructed import ReconstructedScene
from foredrive.methods.reconstruction.views import CameraView, SweepView

_SMOOTHING = 0.05
"""Weight of the newest image in the displayed PSNR."""


@dataclass(frozen=True)
class SensorViews:
    """The training data."""

    cameras: Sequence[CameraView]
    sweeps: Sequence[SweepView]


class ParameterGroup(NamedTuple):
    """Parameters that learn at one rate."""

    name: str
    parameters: list[nn.Parameter]
    rate: Rate
    eps: float = 1e-15
    """Term that Adam adds to the root of the second moment."""
    fused: bool = False
    """One pass over the numbers in place of one for each operation: the same step but for the last digits."""


class StepLosses(NamedTuple):
    """Losses of one step."""

    source: str
    """The data of the step, for error messages."""
    losses: dict[str, Tensor]
    """By name. "loss" is minimised; "psnr_db" is shown and may be infinite."""


@runtime_checkable
class SceneTraining(Protocol):
    """What a representation adds to the loop. All its random numbers come from the generators it is given."""

    @property
    def scene(self) -> ReconstructedScene:
        """Return the trained scene."""
        ...

    @property
    def steps(self) -> int:
        """Return the number of steps."""
        ...

    @property
    def checkpoint_every(self) -> int:
        """Return the number of steps between checkpoints."""
        ...

    @property
    def seed(self) -> int:
        """Return the seed of all random numbers."""
        ...

    def parameter_groups(self) -> list[ParameterGroup]:
        """Return all learned parameters in groups, always in the same order."""
        ...

    def losses(self, step: int, generator: torch.Generator) -> StepLosses:
        """Return the losses of a step, with gradients: those of the data and the regularisers."""
        ...

    def evolve(self, step: int, optimizer: Optimizer, generator: torch.Generator) -> None:
        """Change the scene after a step of the optimizer, and the optimizer's state with it."""
        ...


def train_representation(training: SceneTraining, folder: Path) -> None:
    """Train a scene, continuing from a checkpoint in `folder` if there is one.

    Writes `folder/metrics.jsonl` and `folder/checkpoints/step_N`. An interrupted run that is resumed gives
    the same scene as an uninterrupted one: all random numbers follow from the seed and the step. Ctrl-C ends
    the run after the current step, with a checkpoint.

    Raises:
        InputError: a checkpoint cannot be read, or a loss is not finite.
    """
    scene, steps = training.scene, training.steps
    checkpoint, done = latest_checkpoint(folder / CHECKPOINTS), 0
    if checkpoint is not None:
        # Training may change the number of parameters: the sizes must be right before weights are loaded
        scene.resize(checkpoint / "model.safetensors")
    optimizer = make_optimizer(training)
    if checkpoint is not None:
        done = load_checkpoint(checkpoint, scene, optimizer)
        remove_older(checkpoint)
    if done >= steps:
        return
    rates, shown_db = {group.name: group.rate for group in training.parameter_groups()}, math.nan
    with step_counter(folder, scene, optimizer, done, steps, training.checkpoint_every) as end_step:
        for step in range(done, steps):
            before_s = time.process_time()
            # The rate follows from the step alone, so a resumed run continues it
            for group in optimizer.param_groups:
                group["lr"] = rates[group["name"]].at(step, steps)
            losses = _one_step(training, optimizer, step)
            losses["computing_s"] = torch.tensor(time.process_time() - before_s)
            if "psnr_db" in losses:
                now_db = float(losses["psnr_db"])
                # Exponential mean over images; the first one starts it
                shown_db = now_db if math.isnan(shown_db) else shown_db + _SMOOTHING * (now_db - shown_db)
            note = "" if math.isnan(shown_db) else f"  PSNR {shown_db:.1f} dB"
            if end_step(losses, scene.described + note):
                break


def make_optimizer(training: SceneTraining) -> Adam:
    """Return Adam with the groups of parameters of a training."""
    return Adam(
        [
            {
                "params": group.parameters,
                "name": group.name,
                "lr": group.rate.first,
                "eps": group.eps,
                "fused": group.fused,
            }
            for group in training.parameter_groups()
        ]
    )


def _one_step(training: SceneTraining, optimizer: Optimizer, step: int) -> dict[str, Tensor]:
    # One generator per step, seeded by run and step, makes a resumed run equal to an uninterrupted one
    generator = torch.Generator().manual_seed((training.seed * 1_000_003 + step) * 1009)
    source, losses = training.losses(step, generator)
    descended = {name: value for name, value in losses.items() if name != "psnr_db"}  # may be infinite
    check_finite(descended, step, source)
    optimizer.zero_grad(set_to_none=True)
    losses["loss"].backward()
    optimizer.step()
    training.evolve(step, optimizer, generator)
    return on_host(losses)


@dataclass(frozen=True)
class ViewOrder:
    """The image or sweep of each step: one sweep after every few images, each in a new order per epoch."""

    images: int
    sweeps: int
    images_per_sweep: int
    seed: int

    def __post_init__(self) -> None:
        """Check that there is anything.

        Raises:
            InputError: there are neither images nor sweeps.
        """
        if not self.images and not self.sweeps:
            raise InputError("there is nothing to learn from: neither images nor sweeps")

    def at(self, step: int) -> tuple[Literal["image", "sweep"], int]:
        """Return the kind of a step's view, and its index."""
        turn = self.images_per_sweep + 1
        # The last step of each turn shows a sweep
        if not self.images or (self.sweeps and step % turn == turn - 1):
            # Number of sweeps, respectively images, shown before this step
            return "sweep", self._shuffled(step // turn if self.images else step, self.sweeps, 1)
        return "image", self._shuffled(step - step // turn if self.sweeps else step, self.images, 0)

    def _shuffled(self, number: int, items: int, kind: int) -> int:
        # Every epoch and kind has an order of its own
        seed = ((self.seed * 1_000_003 + number // items) * 2 + kind) * 7919
        order = torch.randperm(items, generator=torch.Generator().manual_seed(seed))
        return int(order[number % items])
