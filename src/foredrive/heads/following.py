"""The state of agents that are carried from frame to frame of one drive, and their identities."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int
from torch import Tensor

from foredrive.geometry.se3 import compose_se3, inverse_se3
from foredrive.heads.agents_head import AgentSet, CarriedConfig
from foredrive.heads.carried import CarriedAgents, Lineage, carry
from foredrive.heads.heads import HeadOutput

Perceive = Callable[[CarriedAgents | None], HeadOutput]
"""Returns the output of heads for one clip, from the agents of the frame before."""


@dataclass(frozen=True)
class _Frame:
    """The last frame of the drive."""

    T_world_ego: Float64[Tensor, "4 4"]
    output: HeadOutput
    track_id: Int[Tensor, "1 Q"]


class AgentFollower:
    """The state between the frames of a drive.

    It begins anew after a frame whose agents are not finite: one failure must not spoil the whole drive.

    Args:
        config: of the carried agents.
    """

    def __init__(self, config: CarriedConfig) -> None:
        self.config = config
        self._before: _Frame | None = None
        self._begun = 0

    def step(
        self, perceive: Perceive, T_world_ego: Float64[Tensor, "4 4"], dt_s: float | None
    ) -> tuple[HeadOutput, Int[Tensor, "1 Q"]]:
        """Return the output of heads for the next frame, and the identity of each agent; -1: none, or hidden.

        Args:
            perceive: the heads.
            T_world_ego: pose at now.
            dt_s: time since the frame before; None if this frame does not continue it: the state begins anew.
        """
        # The state begins anew where the frame does not continue the one before
        before = None if dt_s is None else self._before
        carried = None
        if before is not None and dt_s is not None:
            carried = self._carried(before, T_world_ego, dt_s)
        # Heads run with the carried agents, or without
        output = perceive(carried)
        assert output.agents is not None
        assert output.lineage is not None
        score = output.agents[-1].best_class()[0]
        # Identities of the frame before, by query
        old = torch.full_like(output.lineage.source, -1) if before is None else before.track_id
        seen = score >= self.config.born
        track_id = self._identities(output.lineage, old, seen)
        # A frame with values that are not finite carries nothing on
        self._before = _Frame(T_world_ego, output, track_id) if _is_finite(output.agents[-1]) else None
        return output, torch.where(seen, track_id, -1)

    def _carried(self, before: _Frame, T_world_ego: Float64[Tensor, "4 4"], dt_s: float) -> CarriedAgents:
        assert before.output.agents is not None
        assert before.output.lineage is not None
        # Pose of the frame before in the ego frame at now
        T_now_before = compose_se3(inverse_se3(T_world_ego), before.T_world_ego).float()[None]
        return carry(before.output.agents[-1], before.output.lineage, self.config.agents, T_now_before, dt_s)

    def _identities(
        self, lineage: Lineage, old: Int[Tensor, "1 _Q"], seen: Bool[Tensor, "1 Q"]
    ) -> Int[Tensor, "1 Q"]:
        """Return the identities that are carried on, and new ones for other agents that are seen.

        An identity ends when the rank of its query falls below `born`.
        """
        # An identity goes on while the rank of its query is high enough
        goes_on = (lineage.source >= 0) & (lineage.rank >= self.config.born)
        track_id = torch.where(goes_on, old.gather(1, lineage.source.clamp_min(0)), -1)
        # Others that are seen get new numbers, in ascending order
        new = (track_id < 0) & seen
        track_id[new] = self._begun + torch.arange(int(new.sum()), device=track_id.device)
        self._begun += int(new.sum())
        return track_id


def _is_finite(agents: AgentSet) -> bool:
    """Return whether agents can be carried on: whatever the next frame reads of them is finite."""
    boxes = agents.boxes
    read = (agents.query, agents.velocity, boxes.mean, boxes.heading, boxes.logits)
    return all(bool(tensor.isfinite().all()) for tensor in read if tensor is not None)
