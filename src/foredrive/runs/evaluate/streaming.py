"""Task heads that follow the drives of an evaluation frame by frame."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float64, Int
from torch import Tensor

from foredrive.evaluation.frame_keys import continues, time_of
from foredrive.models.tasks.agents import CarriedConfig
from foredrive.models.tasks.carried import interleaved
from foredrive.models.tasks.following import AgentFollower, Perceive
from foredrive.models.tasks.heads import HeadOutput


class DriveFollower:
    """The state between the frames of drives. It begins anew with each log, and where frames are missing.

    Args:
        config: of the carried agents.
    """

    def __init__(self, config: CarriedConfig) -> None:
        self._follower, self._before = AgentFollower(config), ""

    def step(
        self, perceive: Perceive, key: str, T_world_ego: Float64[Tensor, "4 4"]
    ) -> tuple[HeadOutput, Int[Tensor, "1 Q"]]:
        """Return the output of heads for the next frame, and the identity of each agent; -1: none, or hidden.

        Args:
            perceive: the heads.
            key: name of the frame, LOG@T_US.
            T_world_ego: pose at now.
        """
        follows = continues(self._before, key)
        dt_s = 1e-6 * (time_of(key) - time_of(self._before)) if follows else None
        self._before = key
        return self._follower.step(perceive, T_world_ego, dt_s)


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
