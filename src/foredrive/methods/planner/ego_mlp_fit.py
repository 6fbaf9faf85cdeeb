"""Fitting of the ego MLP, which plans from ego status only."""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.engine.in_memory_fit import FitSchedule, fit_in_memory
from foredrive.errors import InputError
from foredrive.heads.plan_losses import l1_waypoint_loss
from foredrive.methods.planner.ego_mlp import EgoMLP, EgoMLPConfig, ego_status
from foredrive.scene import Clip
from foredrive.scene.record import Record


@dataclass(frozen=True)
class EgoMLPFit(FitSchedule):
    """Schedule of the fit of an `EgoMLP`."""

    steps: int = 1000
    batch_size: int = 256
    lr: float = 1e-3
    weight_decay: float = 1e-2
    seed: int = 0
    """Seed of the weights and draws. MLPs with different seeds differ by as much as the use of images may
    gain."""


@dataclass(frozen=True)
class StatusDemonstrations(Record):
    """Training data of the ego MLP: ego status at now and the driven future of N clips."""

    status: Float[Tensor, "N S"]
    driven: Float[Tensor, "N T 3"]
    """x, y (m), yaw (rad) of the rear axle in the ego frame at now."""
    valid: Bool[Tensor, "N T"]


def read_status(
    clips: Iterable[Clip], past_frames: int, *, target: bool = False, rates: bool = False
) -> StatusDemonstrations:
    """Return ego status and driven future of batches of clips.

    Args:
        clips: batches.
        past_frames: key frames before now in the ego status.
        target: whether the ego status includes the target point of the route.
        rates: whether it includes `motion_rates`.

    Raises:
        InputError: there are no clips.
    """
    rows = [_demonstrations(clip, past_frames, target, rates) for clip in clips]
    if not rows:
        raise InputError("the training set is empty")
    return StatusDemonstrations(
        torch.cat([row.status for row in rows]),
        torch.cat([row.driven for row in rows]),
        torch.cat([row.valid for row in rows]),
    )


def _demonstrations(clip: Clip, past_frames: int, target: bool, rates: bool) -> StatusDemonstrations:
    future = clip.future
    status = ego_status(clip, past_frames, target=target, rates=rates and past_frames > 0)
    driven = torch.cat([future.xy[:, 0], future.yaw[:, 0, :, None]], dim=-1)
    return StatusDemonstrations(status, driven, future.valid[:, 0])


def fit_ego_mlp(
    config: EgoMLPConfig,
    data: StatusDemonstrations,
    fit: EgoMLPFit,
    *,
    past_frames: int,
    dt_s: float,
    target: bool = False,
) -> EgoMLP:
    """Fit an ego MLP by L1 on the driven steps. It takes seconds; the same seed gives the same weights."""
    horizon_steps = data.driven.shape[1]
    # The weights depend on the seed of the fit alone and leave the global generator as it is
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(fit.seed)
        model = EgoMLP(config, past_frames=past_frames, horizon_steps=horizon_steps, dt_s=dt_s, target=target)
    _standardise(model, data)

    def loss(rows: Tensor) -> Tensor:
        return l1_waypoint_loss(model(data.status[rows]), data.driven[rows], data.valid[rows])

    fit_in_memory(model, len(data.status), loss, fit, fit.seed)
    return model


def _standardise(model: EgoMLP, data: StatusDemonstrations) -> None:
    """Set means and spreads of inputs and outputs. Columns that hardly vary keep a spread of 1."""
    # Means and spreads of plans come from complete futures only
    whole = data.driven[data.valid.all(dim=-1)].flatten(1)
    for name, rows in (("status", data.status), ("plan", whole)):
        if len(rows) < 2:
            continue
        std = rows.std(dim=0)
        getattr(model, f"{name}_mean").copy_(rows.mean(dim=0))
        getattr(model, f"{name}_std").copy_(torch.where(std > 1e-3, std, torch.ones_like(std)))
