"""Task heads that follow a drive frame by frame, and the identities of what they carry on."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float64, Int
from torch import Tensor

from foredrive.evaluation.frame_keys import continues, time_of
from foredrive.geometry.se3 import compose_se3, inverse_se3
from foredrive.models.tasks.agents import AgentSet, CarriedConfig
from foredrive.models.tasks.carried import CarriedAgents, Lineage, carry, interleaved
from foredrive.models.tasks.heads import HeadOutput

Perceive = Callable[[CarriedAgents | None], HeadOutput]
"""Returns the output of heads for one clip, from the agents of the frame before."""


@dataclass(frozen=True)
class _Frame:
    """The last frame of the drive."""

    key: str
    T_world_ego: Float64[Tensor, "4 4"]
    output: HeadOutput
    track_id: Int[Tensor, "1 Q"]


class DriveFollower:
    """The state between the frames of a drive.

    It begins anew with each log, where frames are missing, and after a frame whose agents are not finite:
    one failure must not spoil the rest of the drive.

    Args:
        config: of the carried agents.
    """

    def __init__(self, config: CarriedConfig) -> None:
        self.config = config
        self._before: _Frame | None = None
        self._begun = 0

    def step(
        self, perceive: Perceive, key: str, T_world_ego: Float64[Tensor, "4 4"]
    ) -> tuple[HeadOutput, Int[Tensor, "1 Q"]]:
        """Return the output of heads for the next frame, and the identity of each agent; -1: none, or hidden.

        Args:
            perceive: the heads.
            key: name of the frame, LOG@T_US.
            T_world_ego: pose at now.
        """
        before = self._before
        if before is not None and not continues(before.key, key):
            before = None
        output = perceive(None if before is None else self._carried(before, key, T_world_ego))
        assert output.agents is not None
        assert output.lineage is not None
        score = output.agents[-1].boxes.logits.softmax(dim=-1)[..., :-1].amax(dim=-1)
        old = torch.full_like(output.lineage.source, -1) if before is None else before.track_id
        seen = score >= self.config.born
        track_id = self._identities(output.lineage, old, seen)
        whole = _is_finite(output.agents[-1])
        self._before = _Frame(key, T_world_ego, output, track_id) if whole else None
        return output, torch.where(seen, track_id, -1)

    def _carried(self, before: _Frame, key: str, T_world_ego: Float64[Tensor, "4 4"]) -> CarriedAgents:
        assert before.output.agents is not None
        assert before.output.lineage is not None
        T_now_before = compose_se3(inverse_se3(T_world_ego), before.T_world_ego).float()[None]
        dt_s = 1e-6 * (time_of(key) - time_of(before.key))
        return carry(before.output.agents[-1], before.output.lineage, self.config.agents, T_now_before, dt_s)

    def _identities(
        self, lineage: Lineage, old: Int[Tensor, "1 _Q"], seen: Bool[Tensor, "1 Q"]
    ) -> Int[Tensor, "1 Q"]:
        """Return the identities that are carried on, and new ones for other agents that are seen.

        An identity ends when the rank of its query falls below `born`.
        """
        goes_on = (lineage.source >= 0) & (lineage.rank >= self.config.born)
        track_id = torch.where(goes_on, old.gather(1, lineage.source.clamp_min(0)), -1)
        new = (track_id < 0) & seen
        track_id[new] = self._begun + torch.arange(int(new.sum()), device=track_id.device)
        self._begun += int(new.sum())
        return track_id


def _is_finite(agents: AgentSet) -> bool:
    """Return whether agents can be carried on: whatever the next frame reads of them is finite."""
    boxes = agents.boxes
    read = (agents.query, agents.velocity, boxes.mean, boxes.heading, boxes.logits)
    return all(bool(tensor.isfinite().all()) for tensor in read if tensor is not None)


def together(outputs: Sequence[HeadOutput]) -> HeadOutput:
    """Return outputs for one clip each as that of a batch."""
    joined: dict[str, Any] = {}
    for field in dataclasses.fields(HeadOutput):
        parts = [getattr(output, field.name) for output in outputs]
        if isinstance(parts[0], list):
            joined[field.name] = [interleaved([part[n] for part in parts]) for n in range(len(parts[0]))]
        elif isinstance(parts[0], Tensor):
            joined[field.name] = torch.cat(parts)
        else:
            joined[field.name] = None if parts[0] is None else interleaved(parts)
    return HeadOutput(**joined)
