"""Agents and map elements as tokens for a planner, as in VAD and UniAD."""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.errors import InputError
from foredrive.heads.agents_head import AGENT_CLASSES, AgentSet
from foredrive.heads.decoder import PlaceEmbedding
from foredrive.heads.heads import HeadOutput, TaskHeadsConfig
from foredrive.heads.map_head import MapSet
from foredrive.scene import VoxelSpec

Attended = Literal["agents", "map"]
"""Outputs of the task heads that a planner can attend to."""

SPEED_SCALE_MPS = 10.0
FUTURE_SCALE_M = 20.0


class SceneTokens(nn.Module):
    """Tokens of the agents and map elements that heads have found, for the decoder of a planner.

    A token is made of the query's features and of what the query stands for. For an agent these are its
    probability, heading, size, velocity and most probable future; for a map element its kinds and points.
    Gradients reach the features alone. Jiang et al. 2023 (VAD, §3.3) let the query of the ego vehicle attend
    to agents and then to the map, and leave out queries of a low score. Here the planner's decoder attends to
    tokens and to cells of the plane together, and is told the scores.

    Args:
        attends: outputs that become tokens.
        heads: sizes of the heads.
        spec: grid of the volumes.
        width: channels of the tokens.

    Raises:
        InputError: no head finds what the planner shall attend to.
    """

    lower_m: Tensor
    extent_m: Tensor

    def __init__(
        self, attends: tuple[Attended, ...], heads: TaskHeadsConfig | None, spec: VoxelSpec, width: int
    ) -> None:
        super().__init__()
        heads_of = {"agents": heads and heads.agents, "map": heads and heads.elements}
        tasks = {"agents": "detection", "map": "map"}
        for name in attends:
            if heads is None or heads_of[name] is None:
                raise InputError(
                    f"planner.attends names {name}, but no head finds them: train with {tasks[name]}"
                )
        lower = torch.tensor(spec.lower_m[:2])
        self.register_buffer("lower_m", lower, persistent=False)
        self.register_buffer("extent_m", torch.tensor(spec.upper_m[:2]) - lower, persistent=False)
        self.place = PlaceEmbedding(width)
        self.agents = self.elements = None
        if heads is not None and heads.agents is not None and "agents" in attends:
            motion = heads.agents.motion
            numbers = len(AGENT_CLASSES) + 6 + (0 if motion is None else 2 * motion.steps)
            self.agents = _mlp(heads.width + numbers, width)
        if heads is not None and heads.elements is not None and "map" in attends:
            self.elements = _mlp(heads.width + heads.elements.kinds + 2 * heads.elements.points, width)

    def forward(self, output: HeadOutput) -> Float[Tensor, "b N C"]:
        """Return a token for each query, agents first."""
        tokens = []
        if self.agents is not None:
            assert output.agents is not None
            tokens.append(self._of_agents(self.agents, output.agents[-1]))
        if self.elements is not None:
            assert output.elements is not None
            tokens.append(self._of_elements(self.elements, output.elements[-1]))
        return torch.cat(tokens, dim=1)

    def _of_agents(self, mlp: nn.Module, agents: AgentSet) -> Float[Tensor, "b Q C"]:
        assert agents.query is not None
        centre = agents.boxes.mean[..., :2]
        attributes = [
            agents.boxes.logits.softmax(dim=-1)[..., :-1],
            agents.boxes.heading,
            agents.boxes.mean[..., 3:5],
            agents.velocity / SPEED_SCALE_MPS,
        ]
        if agents.future_xy is not None and agents.log_prob is not None:
            # Path of the most probable mode, relative to the agent
            best = agents.log_prob.argmax(dim=-1)[..., None, None, None]
            path = agents.future_xy.take_along_dim(best, dim=2)[:, :, 0]
            attributes.append(((path - centre[:, :, None]) / FUTURE_SCALE_M).flatten(2))
        # What heads predict enters without gradient; only the features of queries pass one
        features = torch.cat([agents.query, torch.cat(attributes, dim=-1).detach()], dim=-1)
        tokens: Tensor = mlp(features) + self.place(self._share(centre.detach()))
        return tokens

    def _of_elements(self, mlp: nn.Module, elements: MapSet) -> Float[Tensor, "b E C"]:
        assert elements.query is not None
        share = self._share(elements.points)
        attributes = torch.cat([elements.logits.sigmoid(), share.flatten(2)], dim=-1).detach()
        middle = self.place(share.mean(dim=2).detach())
        tokens: Tensor = mlp(torch.cat([elements.query, attributes], dim=-1)) + middle
        return tokens

    def _share(self, points_m: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 2"]:
        """Return points as shares of the grid's extent."""
        return (points_m - self.lower_m) / self.extent_m


def _mlp(inputs: int, width: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width), nn.LayerNorm(width))
