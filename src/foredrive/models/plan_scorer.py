"""A scorer of plans: sub-scores of each plan of a vocabulary, and the choice of one."""

from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.models.few_queries import FewQueriesDecoderLayer
from foredrive.models.plan_vocabulary import Candidates, VocabularyConfig
from foredrive.scene import Trajectory, VoxelSpec
from foredrive.scene.record import Record

SUB_SCORES = ("no_collision", "drivable", "light", "progress", "time_to_collision", "lane", "comfort")
"""Parts of NAVSIM's EPDMS (Cao et al. 2025) that a town tells exactly: NC, DAC, TLC, EP, TTC, LK and HC.

Hydra-MDP++ (Li et al. 2025) learns the same from a simulation. DDC needs the directions of lanes.
"""
GATES = ("no_collision", "drivable", "light")
"""Factors of the score. The others are averaged."""
MEAN_WEIGHTS = {"progress": 5.0, "time_to_collision": 5.0, "lane": 2.0, "comfort": 2.0}
"""Weights of EPDMS, whose extended comfort compares two plans and is left out."""


@dataclass(frozen=True)
class ChoiceWeights:
    """Weights of the logarithms whose sum chooses a plan, as in Hydra-MDP (Li et al. 2024)."""

    imitation: float = 0.1
    no_collision: float = 1.0
    drivable: float = 0.5
    light: float = 1.0
    mean: float = 1.0


@dataclass(frozen=True, kw_only=True)
class PlanScorerConfig:
    """Sizes of a `PlanScorer`, its vocabulary, and how it chooses."""

    vocabulary: VocabularyConfig = field(default_factory=VocabularyConfig)
    layers: int = 1
    """Rounds of attention of the plans to the plane and to tokens of the scene."""
    pool: int = 4
    """Cells of the plane along each side that share a key and a value."""
    choice: ChoiceWeights = field(default_factory=ChoiceWeights)


@dataclass(frozen=True)
class ScoredPlans(Record):
    """The plans of a vocabulary with their logits."""

    xy: Float[Tensor, "b N T 2"]
    yaw: Float[Tensor, "b N T"]
    speed_mps: Float[Tensor, "b N T"]
    logits: Float[Tensor, "b N S"]
    """Of the `SUB_SCORES`."""
    imitation: Float[Tensor, "b N"]
    """Logit of each plan to be the expert's."""
    dt_s: float
    weights: ChoiceWeights

    def utility(self) -> Float[Tensor, "b N"]:
        """Return the weighted sum of the logarithms of imitation, gates and mean."""
        log_p = F.logsigmoid(self.logits)
        of = {name: log_p[..., k] for k, name in enumerate(SUB_SCORES)}
        total = sum(MEAN_WEIGHTS.values())
        mean = sum(
            (weight / total * of[name].exp() for name, weight in MEAN_WEIGHTS.items()),
            start=torch.zeros_like(self.imitation),
        )
        utility = self.weights.imitation * self.imitation.log_softmax(-1)
        utility = utility + self.weights.mean * mean.clamp_min(1e-6).log()
        for gate in GATES:
            utility = utility + getattr(self.weights, gate) * of[gate]
        return utility

    def best(self) -> Trajectory:
        """Return the plan with the highest utility."""
        chosen = self.utility().argmax(-1)
        rows = torch.arange(len(chosen), device=chosen.device)
        xy, yaw = self.xy[rows, chosen][:, None], self.yaw[rows, chosen][:, None]
        return Trajectory(
            xy=xy,
            yaw=yaw,
            valid=torch.ones_like(yaw, dtype=torch.bool),
            log_prob=torch.zeros_like(yaw[..., 0]),
            dt_s=self.dt_s,
        )


class PlanScorer(nn.Module):
    """A transformer whose queries are plans.

    A plan is embedded by its waypoints and the features of the plane at each of them, together with what the
    planner is told (command, speed, target). It attends to tokens of the scene and to the pooled plane.

    Args:
        config: sizes.
        spec: grid of the plane.
        width: channels of the plane, of the tokens and of the query.
        heads: heads of the attention.
        feed_forward: hidden width.
        dropout: dropout probability.
        steps: T.
    """

    lower_m: Tensor
    extent_m: Tensor

    def __init__(
        self,
        config: PlanScorerConfig,
        spec: VoxelSpec,
        *,
        width: int,
        heads: int,
        feed_forward: int,
        dropout: float,
        steps: int,
    ) -> None:
        super().__init__()
        self.config = config
        lower = torch.tensor(spec.lower_m[:2])
        self.register_buffer("lower_m", lower, persistent=False)
        self.register_buffer("extent_m", torch.tensor(spec.upper_m[:2]) - lower, persistent=False)
        self.shape = nn.Sequential(nn.Linear(5 * steps, width), nn.ReLU(), nn.Linear(width, width))
        self.at_place = nn.Linear(width, width // 4)
        self.along = nn.Linear(steps * (width // 4), width)
        self.norm = nn.LayerNorm(width)
        self.layers = nn.ModuleList(
            [FewQueriesDecoderLayer(width, heads, feed_forward, dropout) for _ in range(config.layers)]
        )
        self.out = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, len(SUB_SCORES) + 1)
        )

    def forward(
        self,
        plans: Candidates,
        query: Float[Tensor, "b C"],
        plane: Float[Tensor, "b Y X C"],
        tokens: Float[Tensor, "b _N C"] | None,
    ) -> Float[Tensor, "b N _S"]:
        """Return the logits of the sub-scores and, last, of imitation."""
        numbers = torch.cat(
            [
                plans.xy / 20.0,
                torch.stack([plans.yaw.sin(), plans.yaw.cos(), plans.speed_mps / 10.0], dim=-1),
            ],
            dim=-1,
        )
        each = self.shape(numbers.flatten(2)) + self.along(self._read(plane, plans.xy).flatten(2))
        each = self.norm(each + query[:, None])
        pooled = F.avg_pool2d(plane.permute(0, 3, 1, 2), self.config.pool, ceil_mode=True)
        memory = pooled.flatten(2).mT
        if tokens is not None:
            memory = torch.cat([memory, tokens.to(memory)], dim=1)
        for layer in self.layers:
            each = layer(each, memory)
        logits: Tensor = self.out(each).float()
        return logits

    def _read(
        self, plane: Float[Tensor, "b Y X C"], xy: Float[Tensor, "b N T 2"]
    ) -> Float[Tensor, "b N T _c"]:
        """Return the features of the plane at the waypoints; 0 outside."""
        at = 2 * (xy - self.lower_m) / self.extent_m - 1
        narrow = self.at_place(plane).permute(0, 3, 1, 2)
        found = F.grid_sample(narrow, at.to(narrow), align_corners=False)
        return found.permute(0, 2, 3, 1)
