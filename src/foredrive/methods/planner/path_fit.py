"""Fitting of a planner's path correction to many demonstrations, with a fixed world model."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.engine.in_memory_fit import FitSchedule, fit_in_memory
from foredrive.heads.plan_losses import l1_waypoint_loss
from foredrive.methods.planner.path_correction import PathCorrection, PathSamples
from foredrive.scene.record import Record


@dataclass(frozen=True)
class PathFit(FitSchedule):
    """Schedule of the fit of a `PathCorrection` and spacing of its clips."""

    steps: int = 1500
    batch_size: int = 64
    lr: float = 1e-3
    weight_decay: float = 0.05
    stride_s: float = 1.0
    """Time between the clips whose volumes are sampled, s."""


@dataclass(frozen=True)
class PathDemonstrations(Record):
    """Features sampled along N initial plans, these plans, and the driven waypoints."""

    values: Float[Tensor, "N D S F"]
    positions_m: Float[Tensor, "N D S 2"]
    status: Float[Tensor, "N _S"]
    """Standardised ego status; no columns without an ego MLP."""
    planned_xy: Float[Tensor, "N T 2"]
    """Initial plans, which the correction is added to."""
    driven_xy: Float[Tensor, "N T 2"]
    valid: Bool[Tensor, "N T"]


def fit_path(correction: PathCorrection, data: PathDemonstrations, fit: PathFit, seed: int) -> None:
    """Fit the correction by L1 on the waypoints, and store the means and the spread that standardise inputs.

    All features have the same spread, so that one that is nearly always 0 is not blown up.
    """
    data = data.to(correction.mean.device)
    # A mean for each feature, over all demonstrations, distances and offsets, and a spread for all
    values = data.values.float()
    correction.mean.copy_(values.mean(dim=(0, 1, 2)))
    correction.std.fill_(values.var(dim=(0, 1, 2)).mean().sqrt() + 1e-3)
    correction.requires_grad_(True)  # joint training disables it

    def loss(rows: Tensor) -> Tensor:
        batch = data[rows]
        change = correction(PathSamples(batch.values, batch.positions_m), batch.status)
        return l1_waypoint_loss(batch.planned_xy + change.cumsum(dim=1), batch.driven_xy, batch.valid)

    fit_in_memory(correction, len(data.status), loss, fit, seed)
