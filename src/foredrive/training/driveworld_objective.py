"""DriveWorld's objective: eq. 3, and the waypoint loss when a planner is trained with it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from foredrive.losses import occupancy_loss, waypoint_loss
from foredrive.models.agent import PlanningAgent
from foredrive.models.driveworld import DriveWorld, Unrolled, actions_of, balanced_kl
from foredrive.models.driveworld.state_space import ACTION_SCALE
from foredrive.scene import Belief, Boxes, Clip, Example, last_frames
from foredrive.training.loop import Schedule
from foredrive.training.objective import train_planner

MOVING_MPS = 0.5


@dataclass(frozen=True)
class DriveWorldWeights:
    """Weights of the terms of eq. 3, each a mean over frames. The paper gives none; the first two are MILE's.

    If all are 0 except `wpts`, only planning is trained.
    """

    kl: float = 1e-3
    balance: float = 0.75
    """Share of the divergence that moves the prior (see `balanced_kl`)."""
    occ: float = 1.0
    action: float = 1.0
    """L1 in units of 10 m/s and 0.1 rad."""
    flow: float = 0.1
    """L2, where labels have flow."""
    velocity: float = 0.1
    """L1 of the velocities of moving objects, where boxes are known, in units of 10 m/s."""
    scal: float = 1.0
    bce: float = 10.0
    occupied: float = 3.0
    """Weights within the occupancy loss, as for NeMo."""
    wpts: float = 0.0
    """Weight of the waypoints. With 0 the planner is not trained."""


@dataclass(frozen=True)
class DriveWorldStage:
    """One stage of DriveWorld's training."""

    schedule: Schedule
    weights: DriveWorldWeights
    temporal: bool = True
    """Train the latent dynamics. If False, each frame's occupancy is learned from that frame only."""
    statics_of: Literal["random", "now"] = "random"
    """Frame whose statics all frames are decoded with: a random one, as in the paper's pre-training, or the
    present one, as in use."""
    kind: Literal["driveworld"] = "driveworld"


class DriveWorldObjective(nn.Module):
    """The mapping from a batch to its losses.

    Args:
        agent: a DriveWorld and its planner.
        weights: weights of the terms.
        steps: L, number of imagined key frames.
        temporal: if False, every observed frame's occupancy is learned from its own plane only, and nothing
            about time: the 3-D pre-training of OccNet and UniScene.
        statics_of: frame whose statics all frames use.
    """

    def __init__(
        self,
        agent: PlanningAgent[DriveWorld],
        weights: DriveWorldWeights,
        *,
        steps: int,
        temporal: bool = True,
        statics_of: Literal["random", "now"] = "random",
    ) -> None:
        super().__init__()
        self.agent, self.weights, self.steps = agent, weights, steps
        self.temporal, self.statics_of = temporal, statics_of
        train_planner(agent.planner, weights.wpts > 0)
        world = agent.world_model
        world.states.requires_grad_(temporal)
        world.to_vector.requires_grad_(temporal)
        world.occupancy.requires_grad_(weights.occ > 0)
        world.flow.requires_grad_(weights.flow > 0)

    def forward(self, example: Example, generator: torch.Generator) -> dict[str, Float[Tensor, ""]]:
        """Return losses by name; "loss" is minimised. `generator` draws states and the frame of statics."""
        clip, weights, world = example.clip, self.weights, self.agent.world_model
        observed = clip.observed()
        seen = world.see(last_frames(observed, world.past_frames))
        losses: dict[str, Float[Tensor, ""]] = {}
        if not self.temporal:
            losses |= self._volume_losses(world, world.without_time(seen), example)
        elif weights.occ > 0:
            unrolled = world.unroll(seen, self.steps, generator, self.statics_of)
            losses |= self._latent_losses(unrolled, clip)
            losses |= self._volume_losses(world, unrolled.beliefs, example)
        if weights.wpts > 0:
            now = world.believe(seen)
            ahead = world.imagine(now, 1) if self.agent.planner.looks_ahead else []
            losses["wpts"] = waypoint_loss(self.agent.plan(observed, [now, *ahead]), clip.future)
        losses["loss"] = torch.stack([getattr(weights, name) * value for name, value in losses.items()]).sum()
        return losses

    def _latent_losses(self, unrolled: Unrolled, clip: Clip) -> dict[str, Float[Tensor, ""]]:
        """Return the divergence of prior and posterior and the errors of the policy and the velocities."""
        first = clip.now + 1 - len(unrolled.posteriors)
        pairs = zip(unrolled.posteriors, unrolled.priors, strict=True)
        kl = torch.stack([balanced_kl(q, p, self.weights.balance).mean() for q, p in pairs]).mean()
        shown = slice(first, clip.now + self.steps + 1)
        past = slice(first, clip.now + 1)
        return {
            "kl": kl,
            "action": _action_loss(unrolled, clip, shown),
            "velocity": _velocity_loss(unrolled, clip.boxes[:, past], clip.boxes_valid[:, past]),
        }

    def _volume_losses(
        self, world: DriveWorld, beliefs: Sequence[Belief], example: Example
    ) -> dict[str, Float[Tensor, ""]]:
        """Return the losses of occupancy and flow over all frames."""
        weights, occ, flow = self.weights, [], []
        for frame, belief in enumerate(beliefs, start=example.clip.now - world.past_frames):
            decoded = world.decode(belief)
            known = example.occupancy.known[:, frame]
            occ.append(
                occupancy_loss(
                    decoded.occupancy_logit,
                    example.occupancy.values[:, frame, 0],
                    known,
                    scal_weight=weights.scal,
                    bce_weight=weights.bce,
                    occupied_weight=weights.occupied,
                )
            )
            if decoded.flow is not None and weights.flow > 0:
                off = (decoded.flow - example.flow.values[:, frame]).square().sum(dim=1)
                flow.append(_masked_mean(off, example.flow.known[:, frame]))
        out = {"occ": torch.stack(occ).mean()}
        return out | {"flow": torch.stack(flow).mean()} if flow else out


def _action_loss(seen: Unrolled, clip: Clip, shown: slice) -> Float[Tensor, ""]:
    """Return the L1 error of the policy's actions, without the clip's last frame: its action is unknown."""
    done = actions_of(clip)[:, shown]
    frames = done.shape[1] - (1 if shown.stop >= clip.t_s.shape[1] else 0)
    off = (seen.actions[:, :frames] - done[:, :frames]).abs() / done.new_tensor(ACTION_SCALE)
    return off.mean()


def _velocity_loss(seen: Unrolled, boxes: Boxes, known: Bool[Tensor, "b T"]) -> Float[Tensor, ""]:
    """Return the L1 error of the velocities of the nearest moving objects, sorted by distance."""
    estimated = seen.velocities_mps
    truth, there = nearest_moving(boxes, estimated.shape[2])
    there = there & known[:, :, None]
    off = (estimated - truth).abs().sum(-1) / ACTION_SCALE[0]
    return _masked_mean(off, there)


def nearest_moving(boxes: Boxes, count: int) -> tuple[Float[Tensor, "b T K 2"], Bool[Tensor, "b T K"]]:
    """Return the velocities of the `count` nearest moving boxes, nearest first, and which of them exist."""
    moves = boxes.valid & (boxes.velocity.norm(dim=-1).nan_to_num(0.0) > MOVING_MPS)
    away_m = torch.where(moves, boxes.centre[..., :2].norm(dim=-1), torch.inf)
    missing = max(0, count - away_m.shape[-1])
    away_m = torch.nn.functional.pad(away_m, (0, missing), value=torch.inf)
    velocity = torch.nn.functional.pad(boxes.velocity.nan_to_num(0.0), (0, 0, 0, missing))
    nearest = away_m.sort(dim=-1, stable=True)
    chosen = nearest.indices[..., :count]
    found = velocity.gather(-2, chosen[..., None].expand(*chosen.shape, 2))
    return found, nearest.values[..., :count].isfinite()


def _masked_mean(values: Tensor, mask: Tensor) -> Float[Tensor, ""]:
    """Return the mean over a mask, or 0 if it is empty."""
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp_min(1)
