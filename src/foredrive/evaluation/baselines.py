"""What a model has to beat: planners that see nothing, and what the training set alone tells."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.errors import InputError
from foredrive.evaluation.run import labels_from_now
from foredrive.metrics import VoxelPrior
from foredrive.models.ego_mlp import EgoMLP, EgoMLPConfig, ego_status
from foredrive.scene import Clip, Example, Trajectory
from foredrive.scene.record import Record


@dataclass(frozen=True)
class StandStill:
    """An `Agent` that stays where it is."""

    steps: int
    dt_s: float

    def act(self, observation: Clip) -> Trajectory:
        """Stay."""
        return _straight(torch.zeros_like(observation.ego_speed_mps[:, 0]), self.steps, self.dt_s)


@dataclass(frozen=True)
class ConstantVelocity:
    """An `Agent` that goes on straight ahead at the speed it has now."""

    steps: int
    dt_s: float

    def act(self, observation: Clip) -> Trajectory:
        """Go on. Where the speed is unknown it is taken from the last two poses.

        Raises:
            InputError: if there is no earlier pose either.
        """
        now = observation.now
        speed_mps, known = observation.ego_speed_mps[:, now], observation.ego_speed_valid[:, now]
        if not bool(known.all()):
            if now == 0:
                raise InputError("constant velocity needs a speed at now or an earlier pose")
            position = observation.T_world_ego[:, now - 1 : now + 1, :3, 3]
            step_m = (position[:, 1] - position[:, 0]).norm(dim=-1)
            travelled = (step_m / (observation.t_s[:, now] - observation.t_s[:, now - 1])).to(speed_mps)
            speed_mps = torch.where(known, speed_mps, travelled)
        return _straight(speed_mps, self.steps, self.dt_s)


def _straight(speed_mps: Float[Tensor, "b"], steps: int, dt_s: float) -> Trajectory:
    x = speed_mps[:, None, None] * dt_s * torch.arange(1, steps + 1, device=speed_mps.device)
    return Trajectory(
        xy=torch.stack([x, torch.zeros_like(x)], dim=-1),
        yaw=torch.zeros_like(x),
        valid=torch.ones_like(x, dtype=torch.bool),
        log_prob=torch.zeros_like(x[..., 0]),
        dt_s=dt_s,
    )


@dataclass(frozen=True)
class DrivenStatus(Record):
    """Ego status at now and what was driven then, of N clips: all that the ego MLP learns from."""

    status: Float[Tensor, "N S"]
    driven: Float[Tensor, "N T 3"]
    """x, y, yaw of the rear axle in the ego frame at now."""
    valid: Bool[Tensor, "N T"]


def read_status(clips: Iterable[Clip], past_frames: int, *, target: bool = False) -> DrivenStatus:
    """Ego status and what was driven, of batches of clips.

    Raises:
        InputError: if there is none.
    """
    rows = [_driven_status(clip, past_frames, target) for clip in clips]
    if not rows:
        raise InputError("the training set is empty")
    return DrivenStatus(
        torch.cat([row.status for row in rows]),
        torch.cat([row.driven for row in rows]),
        torch.cat([row.valid for row in rows]),
    )


def _driven_status(clip: Clip, past_frames: int, target: bool) -> DrivenStatus:
    future = clip.future
    driven = torch.cat([future.xy[:, 0], future.yaw[:, 0, :, None]], dim=-1)
    return DrivenStatus(ego_status(clip, past_frames, target=target), driven, future.valid[:, 0])


def read_training_set(
    loader: Iterable[Example], frames: int, past_frames: int, *, target: bool = False
) -> tuple[VoxelPrior, DrivenStatus]:
    """Everything the baselines need to know of a training set, in one pass (images are not looked at).

    Args:
        frames: now and future key frames of the voxel prior.
        past_frames: of the ego status.
        target: whether the ego status knows where the route leads.
    """
    prior: VoxelPrior | None = None

    def clips() -> Iterator[Clip]:
        nonlocal prior
        for example in loader:
            labels = labels_from_now(example.occupancy, example.clip, frames)
            prior = prior or VoxelPrior(frames, labels.spec)
            prior.add(labels)
            yield example.clip

    status = read_status(clips(), past_frames, target=target)
    assert prior is not None
    return prior, status


def fit_ego_mlp(
    data: DrivenStatus,
    *,
    past_frames: int,
    dt_s: float,
    seed: int,
    steps: int = 1000,
    batch_size: int = 256,
    target: bool = False,
) -> EgoMLP:
    """Train the ego MLP by L1 on the driven steps, AdamW with a cosine; takes seconds, repeats for a seed."""
    horizon_steps = data.driven.shape[1]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = EgoMLP(
            EgoMLPConfig(), past_frames=past_frames, horizon_steps=horizon_steps, dt_s=dt_s, target=target
        )
    _standardise(model, data)
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-3, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    generator = torch.Generator().manual_seed(seed)
    for _ in range(steps):
        chosen = torch.randint(len(data.status), (min(batch_size, len(data.status)),), generator=generator)
        error = (model(data.status[chosen]) - data.driven[chosen]).abs().sum(dim=-1)
        valid = data.valid[chosen]
        loss = torch.where(valid, error, 0.0).sum() / valid.sum().clamp_min(1)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        schedule.step()
    return model.eval()


def _standardise(model: EgoMLP, data: DrivenStatus) -> None:
    """Set the means and spreads; what hardly varies is left as it is."""
    whole = data.driven[data.valid.all(dim=-1)].flatten(1)
    for name, rows in (("status", data.status), ("plan", whole)):
        if len(rows) < 2:
            continue
        std = rows.std(dim=0)
        getattr(model, f"{name}_mean").copy_(rows.mean(dim=0))
        getattr(model, f"{name}_std").copy_(torch.where(std > 1e-3, std, torch.ones_like(std)))
