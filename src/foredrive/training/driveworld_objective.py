"""DriveWorld's pre-training objective (eq. 3)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from foredrive.losses import occupancy_loss
from foredrive.models.driveworld import DriveWorld, Unrolled, actions_of, balanced_kl
from foredrive.models.driveworld.state_space import ACTION_SCALE
from foredrive.scene import Boxes, Clip, Example

MOVING_MPS = 0.5


@dataclass(frozen=True)
class DriveWorldWeights:
    """Weights of the terms of eq. 3, each a mean over frames; the paper gives none, MILE the first two."""

    kl: float = 1e-3
    balance: float = 0.75
    """Share of the divergence that the prior has to close."""
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
    """Of the occupancy loss, as for NeMo."""


class DriveWorldObjective(nn.Module):
    """Maps a batch to its losses.

    Args:
        world: what is trained.
        weights: of the terms.
        steps: L, imagined key frames.
    """

    def __init__(self, world: DriveWorld, weights: DriveWorldWeights, *, steps: int) -> None:
        super().__init__()
        self.world, self.weights, self.steps = world, weights, steps

    def forward(self, example: Example, generator: torch.Generator) -> dict[str, Float[Tensor, ""]]:
        """Losses by name; "loss" is what to descend. The generator draws states and the frame of statics."""
        clip, weights = example.clip, self.weights
        seen = self.world.unroll(clip.observed(), self.steps, generator)
        first = clip.now - self.world.past_frames
        shown = slice(first, clip.now + self.steps + 1)
        losses = {
            "kl": torch.stack(
                [
                    balanced_kl(q, p, weights.balance).mean()
                    for q, p in zip(seen.posteriors, seen.priors, strict=True)
                ]
            ).mean(),
            "action": _action_loss(seen, clip, shown),
            "velocity": _velocity_loss(
                seen, clip.boxes[:, first : clip.now + 1], clip.boxes_valid[:, first:]
            ),
        }
        losses |= self._volume_losses(seen, example, first)
        losses["loss"] = torch.stack([getattr(weights, name) * value for name, value in losses.items()]).sum()
        return losses

    def _volume_losses(self, seen: Unrolled, example: Example, first: int) -> dict[str, Float[Tensor, ""]]:
        """Occupancy and flow of every frame."""
        weights, occ, flow = self.weights, [], []
        for k, belief in enumerate(seen.beliefs):
            decoded, frame = self.world.decode(belief), first + k
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
            if decoded.flow is not None:
                off = (decoded.flow - example.flow.values[:, frame]).square().sum(dim=1)
                flow.append(_masked_mean(off, example.flow.known[:, frame]))
        out = {"occ": torch.stack(occ).mean()}
        return out | {"flow": torch.stack(flow).mean()} if flow else out


def _action_loss(seen: Unrolled, clip: Clip, shown: slice) -> Float[Tensor, ""]:
    """L1 between the policy's actions and what was done, but at the clip's last frame, where that is open."""
    done = actions_of(clip)[:, shown]
    frames = done.shape[1] - (1 if shown.stop >= clip.t_s.shape[1] else 0)
    off = (seen.actions[:, :frames] - done[:, :frames]).abs() / done.new_tensor(ACTION_SCALE)
    return off.mean()


def _velocity_loss(seen: Unrolled, boxes: Boxes, known: Bool[Tensor, "b _T"]) -> Float[Tensor, ""]:
    """L1 of the velocities of the nearest moving objects, nearest first."""
    estimated = seen.velocities_mps
    truth, there = nearest_moving(boxes, estimated.shape[2])
    there = there & known[:, : there.shape[1], None]
    off = (estimated - truth).abs().sum(-1) / ACTION_SCALE[0]
    return _masked_mean(off, there)


def nearest_moving(boxes: Boxes, count: int) -> tuple[Float[Tensor, "b T K 2"], Bool[Tensor, "b T K"]]:
    """Velocities of the `count` nearest boxes that move, nearest first; which of them there are."""
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
    """Mean over a mask; 0 if it is empty."""
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp_min(1)
