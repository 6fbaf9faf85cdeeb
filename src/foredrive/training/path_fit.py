"""Fitting what a planner reads along its path to many demonstrations, the world model being left as it is."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.models.planner import PathCorrection, PathReads
from foredrive.scene.record import Record


@dataclass(frozen=True)
class PathFit:
    """How a `PathCorrection` is fitted: AdamW with a cosine."""

    stride_s: float = 1.0
    """Time between the clips whose volumes are read."""
    steps: int = 1500
    batch_size: int = 64
    lr: float = 1e-3
    weight_decay: float = 0.05


@dataclass(frozen=True)
class PathDemonstrations(Record):
    """What was read along N plans made without looking, what was planned without that, what was driven."""

    values: Float[Tensor, "N D S F"]
    places_m: Float[Tensor, "N D S 2"]
    told: Float[Tensor, "N _told"]
    planned_xy: Float[Tensor, "N T 2"]
    """What the correction is added to."""
    driven_xy: Float[Tensor, "N T 2"]
    valid: Bool[Tensor, "N T"]


def fit_path(correction: PathCorrection, shown: PathDemonstrations, fit: PathFit, seed: int) -> None:
    """Fit by L1 on the waypoints; inputs are standardised by their means and spreads from then on."""
    shown = shown.to(correction.mean.device)
    values = shown.values.float()
    correction.mean.copy_(values.mean(dim=(0, 1, 2)))
    correction.std.copy_(values.std(dim=(0, 1, 2)) + 1e-3)
    optimizer = torch.optim.AdamW(correction.parameters(), lr=fit.lr, weight_decay=fit.weight_decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, fit.steps)
    order = torch.Generator().manual_seed(seed)
    correction.train().requires_grad_(True)  # joint training has left it out
    with torch.random.fork_rng():
        torch.manual_seed(seed)  # of dropout
        for _ in range(fit.steps):
            chosen = torch.randint(len(shown.told), (min(fit.batch_size, len(shown.told)),), generator=order)
            batch = shown[chosen]
            change = correction(PathReads(batch.values, batch.places_m), batch.told)
            error = (batch.planned_xy + change.cumsum(dim=1) - batch.driven_xy).abs().sum(dim=-1)
            loss = torch.where(batch.valid, error, 0.0).sum() / batch.valid.sum().clamp_min(1)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            schedule.step()
    correction.eval()
