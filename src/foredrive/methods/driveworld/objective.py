"""DriveWorld's objective: eq. 3, and the waypoint loss when a planner is trained with it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from foredrive.engine.loop import Schedule
from foredrive.heads.joint import TaskTerms
from foredrive.heads.occupancy_losses import occupancy_loss
from foredrive.heads.plan_losses import waypoint_loss
from foredrive.methods.driveworld import DriveWorld, Unrolled, actions_of, balanced_kl
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.methods.planner.planner import set_planner_trainable
from foredrive.ops.masked import masked_mean
from foredrive.scene import Belief, Boxes, Clip, Example, last_frames


@dataclass(frozen=True)
class DriveWorldWeights:
    """Weights of the terms of eq. 3. The paper gives none; the first two are MILE's.

    If all are 0 except `wpts`, only planning is trained.
    """

    kl: float = 1e-3
    """Weight of the divergence of posterior and prior states, see `balanced_kl`."""
    balance: float = 0.75
    """Share of the divergence that moves the prior (see `balanced_kl`)."""
    occ: float = 1.0
    """Weight of the occupancy loss."""
    action: float = 1.0
    """Weight of the policy's actions, L1 in units of the model's scales of speed and steering."""
    flow: float = 0.1
    """Weight of the flow, L2, where labels have flow."""
    velocity: float = 0.1
    """Weight of the velocities of moving objects, L1 in units of the scale of speed, where boxes are
    known."""
    scal: float = 0.0
    """Weight of the scene-class affinity within the occupancy loss, as for NeMo; eq. 3 has none."""
    bce: float = 1.0
    """Weight of the binary cross-entropy within the occupancy loss (eq. 3)."""
    occupied: float = 1.0
    """Weight of occupied voxels within the BCE, as for NeMo; eq. 3 has 1."""
    wpts: float = 0.0
    """Weight of the waypoints. With 0 the planner is not trained."""
    over_frames: Literal["mean", "sum"] = "mean"
    """Reduction of every term but the waypoints over its frames. Eq. 3 sums."""


@dataclass(frozen=True)
class DriveWorldStage:
    """One stage of DriveWorld's training."""

    schedule: Schedule
    weights: DriveWorldWeights
    temporal: bool = True
    """Train the latent dynamics. If False, each frame's occupancy is learned from its own plane only, as in
    the 3-D pre-training of OccNet and UniScene."""
    statics_of: Literal["random", "now"] = "random"
    """Frame whose statics all frames are decoded with: a random one, as in the paper's pre-training, or the
    present one, as in use."""
    moving_mps: float = 0.5
    """Minimum speed of an object whose velocity is learned."""
    kind: Literal["driveworld"] = "driveworld"


class DriveWorldObjective(nn.Module):
    """The mapping from a batch to its losses.

    Args:
        agent: a DriveWorld and its planner.
        stage: weights of the terms, and what is trained.
        steps: L, number of imagined key frames.
        tasks: losses of the agent's heads, or None if they are not trained.
    """

    def __init__(
        self,
        agent: PlanningAgent[DriveWorld],
        stage: DriveWorldStage,
        *,
        steps: int,
        tasks: TaskTerms | None = None,
    ) -> None:
        super().__init__()
        self.agent, self.stage, self.steps, self.tasks = agent, stage, steps, tasks
        weights, world = stage.weights, agent.world_model
        set_planner_trainable(agent.planner, weights.wpts > 0)
        # The latent dynamics are left out where single frames are trained
        world.states.requires_grad_(stage.temporal)
        world.to_vector.requires_grad_(stage.temporal)
        world.occupancy.requires_grad_(weights.occ > 0)
        world.flow.requires_grad_(weights.flow > 0)

    def forward(self, example: Example, generator: torch.Generator) -> dict[str, Float[Tensor, ""]]:
        """Return losses by name; "loss" is minimised. `generator` draws states and the frame of statics."""
        clip, stage, world = example.clip, self.stage, self.agent.world_model
        observed = clip.observed()
        # All frames are lifted once, for the latent dynamics and for planning
        lifted = world.lift_frames(last_frames(observed, world.past_frames))
        losses: dict[str, Float[Tensor, ""]] = {}
        if not stage.temporal:
            # Baseline: the occupancy of each frame from its own plane
            losses |= self._volume_losses(world.single_frame_beliefs(lifted), example)
        elif stage.weights.occ > 0:
            # Posteriors over the observed frames, then priors over the imagined ones
            unrolled = world.unroll(lifted, self.steps, generator, stage.statics_of)
            losses |= self._latent_losses(unrolled, clip)
            losses |= self._volume_losses(unrolled.beliefs, example)
        terms: dict[str, Float[Tensor, ""]] = {}
        if stage.weights.wpts > 0 or self.tasks is not None:
            # The belief of use, not of training: planner and heads read what they get in evaluation
            now = world.belief_about_now(lifted)
            output = None if self.tasks is None else self.agent.perceive(now, clip, instances=True)
            if stage.weights.wpts > 0:
                future = world.imagine(now, 1) if self.agent.planner.imagined_frames else []
                plan = self.agent.plan(observed, [now, *future], output)
                losses["wpts"] = waypoint_loss(plan, example.clip.future)
            if self.tasks is not None and output is not None:
                terms |= self.tasks(output, example)
        # Names of the losses are those of their weights
        weighted = [getattr(stage.weights, name) * value for name, value in losses.items()]
        total = torch.stack(weighted).sum()
        return losses | terms | {"loss": total + terms["tasks"] if "tasks" in terms else total}

    def _latent_losses(self, unrolled: Unrolled, clip: Clip) -> dict[str, Float[Tensor, ""]]:
        """Return the divergence of prior and posterior and the errors of the policy and the velocities."""
        # The posteriors end at now
        first = clip.now + 1 - len(unrolled.posteriors)
        pairs = list(zip(unrolled.posteriors, unrolled.priors, strict=True))
        balance = self.stage.weights.balance
        kl = torch.stack([balanced_kl(q, p, balance).mean() for q, p in pairs]).mean()
        return {
            "kl": self._over_frames(kl, len(pairs)),
            "action": self._action_loss(unrolled, clip, slice(first, clip.now + self.steps + 1)),
            "velocity": self._velocity_loss(unrolled, clip, slice(first, clip.now + 1)),
        }

    def _over_frames(self, mean: Float[Tensor, ""], frames: int) -> Float[Tensor, ""]:
        """Return the mean of a term over its frames, or their sum if the weights say so."""
        return mean if self.stage.weights.over_frames == "mean" else frames * mean

    def _volume_losses(self, beliefs: Sequence[Belief], example: Example) -> dict[str, Float[Tensor, ""]]:
        """Return the losses of occupancy and flow over all frames."""
        world, weights, occ, flow = self.agent.world_model, self.stage.weights, [], []
        # Beliefs begin with the first observed frame
        for frame, belief in enumerate(beliefs, start=example.clip.now - world.past_frames):
            decoded = world.decode(belief)
            occ.append(
                occupancy_loss(
                    decoded.occupancy_logit,
                    example.occupancy.values[:, frame, 0],
                    example.occupancy.known[:, frame],
                    scal_weight=weights.scal,
                    bce_weight=weights.bce,
                    occupied_weight=weights.occupied,
                )
            )
            if decoded.flow is not None and weights.flow > 0:
                # The squared error of the velocity vector counts only where labels know the flow
                squared = (decoded.flow - example.flow.values[:, frame]).square().sum(dim=1)
                flow.append(masked_mean(squared, example.flow.known[:, frame]))
        terms = {"occ": occ, "flow": flow}
        return {
            name: self._over_frames(torch.stack(values).mean(), len(values))
            for name, values in terms.items()
            if values
        }

    def _action_loss(self, unrolled: Unrolled, clip: Clip, frames: slice) -> Float[Tensor, ""]:
        """Return the L1 error of the policy's actions. The action at the clip's last frame is unknown."""
        # Actions lead from a frame to the next: the last frame of the clip has none
        driven = actions_of(clip)[:, frames.start : min(frames.stop, clip.t_s.shape[1] - 1)]
        error = (unrolled.actions[:, : driven.shape[1]] - driven).abs()
        # Divided by the scales of speed and steering, both terms are of order 1
        mean = (error / self.agent.world_model.states.action_scale).mean()
        return self._over_frames(mean, error.shape[1])

    def _velocity_loss(self, unrolled: Unrolled, clip: Clip, frames: slice) -> Float[Tensor, ""]:
        """Return the L1 error of the velocities of the nearest moving objects, sorted by distance."""
        estimated = unrolled.velocities_mps
        boxes = clip.boxes[:, frames]
        truth, exists = nearest_velocities(boxes, estimated.shape[2], self.stage.moving_mps)
        # Slots are compared in order of distance
        error = (estimated - truth).abs().sum(-1) / self.agent.world_model.states.speed_scale_mps
        mean = masked_mean(error, exists & clip.boxes_valid[:, frames, None])
        return self._over_frames(mean, error.shape[1])


def nearest_velocities(
    boxes: Boxes, count: int, moving_mps: float
) -> tuple[Float[Tensor, "b T K 2"], Bool[Tensor, "b T K"]]:
    """Return the velocities of the `count` nearest moving boxes, nearest first, and which of them exist."""
    # Unknown velocities are NaN and do not count as moving
    moving = boxes.valid & (boxes.velocity.norm(dim=-1).nan_to_num(0.0) > moving_mps)
    # Infinite distance sorts what does not move, or is padding, to the end
    distance_m = torch.where(moving, boxes.centre[..., :2].norm(dim=-1), torch.inf)
    missing = max(0, count - distance_m.shape[-1])
    distance_m = F.pad(distance_m, (0, missing), value=torch.inf)
    velocity = F.pad(boxes.velocity.nan_to_num(0.0), (0, 0, 0, missing))
    nearest = distance_m.sort(dim=-1, stable=True)
    chosen = nearest.indices[..., :count]
    velocities = velocity.gather(-2, chosen[..., None].expand(*chosen.shape, 2))
    return velocities, nearest.values[..., :count].isfinite()
