"""Fits of small modules to data in memory: no checkpoints, no workers, a few seconds."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from foredrive.engine.parameter_groups import parameter_groups
from foredrive.engine.ranges import check_at_least


@dataclass(frozen=True)
class FitSchedule:
    """Schedule of a fit: AdamW, with a cosine learning rate down to 0."""

    steps: int
    """Number of steps of the fit."""
    batch_size: int
    """Rows of one step, drawn with replacement."""
    lr: float
    """Learning rate of the first step."""
    weight_decay: float
    """Decay of weight matrices and filters, see `parameter_groups`."""

    def __post_init__(self) -> None:
        """Check the numbers' ranges."""
        check_at_least(self, steps=0, batch_size=1, lr=0, weight_decay=0)


def fit_in_memory(
    module: nn.Module,
    rows: int,
    loss: Callable[[Int[Tensor, "n"]], Float[Tensor, ""]],
    fit: FitSchedule,
    seed: int,
) -> None:
    """Minimise `loss` on random rows, drawn with replacement. `module` ends in evaluation mode.

    Args:
        module: its parameters are fitted.
        rows: number of rows.
        loss: loss of the rows with the given indices.
        fit: schedule.
        seed: seed of the draws and of dropout. Torch's own generators are restored afterwards.
    """
    optimizer = torch.optim.AdamW(parameter_groups(module, fit.weight_decay), lr=fit.lr)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, fit.steps)
    draws = torch.Generator().manual_seed(seed)
    module.train()
    # Dropout draws from torch's own generators, batches from `draws`
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        for _ in range(fit.steps):
            chosen = torch.randint(rows, (min(fit.batch_size, rows),), generator=draws)
            optimizer.zero_grad(set_to_none=True)
            loss(chosen).backward()
            optimizer.step()
            schedule.step()
    module.eval()
