"""Fitting small modules to rows that lie in memory: no checkpoints, no workers, done in seconds."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn


@dataclass(frozen=True)
class RowFit:
    """Length and speed of a fit: AdamW, the learning rate falling to 0 along a cosine."""

    steps: int
    batch_size: int
    lr: float
    weight_decay: float


def fit_rows(
    module: nn.Module,
    rows: int,
    loss: Callable[[Int[Tensor, "n"]], Float[Tensor, ""]],
    fit: RowFit,
    seed: int,
) -> None:
    """Descend `loss` on random rows, drawn with replacement; leaves `module` in evaluation mode.

    Args:
        module: whose parameters are fitted.
        rows: how many there are.
        loss: of the rows with these indices.
        fit: length and speed.
        seed: of the draws, and of dropout. Torch's own generators are left as they were.
    """
    optimizer = torch.optim.AdamW(module.parameters(), lr=fit.lr, weight_decay=fit.weight_decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, fit.steps)
    draws = torch.Generator().manual_seed(seed)
    module.train()
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        for _ in range(fit.steps):
            chosen = torch.randint(rows, (min(fit.batch_size, rows),), generator=draws)
            optimizer.zero_grad(set_to_none=True)
            loss(chosen).backward()
            optimizer.step()
            schedule.step()
    module.eval()
