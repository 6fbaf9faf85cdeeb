"""The head of road users: a set of boxes with velocity, attribute and motion."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from foredrive.errors import InputError
from foredrive.heads.decoder import DecoderConfig, PlaceEmbedding, QueryDecoderLayer
from foredrive.heads.detection_losses import NO_OBJECT_WEIGHT
from foredrive.heads.detection_network import LOG_STD_RANGE, BoxSet
from foredrive.heads.motion_head import MotionConfig, MotionModes
from foredrive.heads.plane import PlanePyramid, Planes
from foredrive.heads.proposals import CentreHead, CentreMap, Proposals, best_proposals
from foredrive.scene import Attribute, Category
from foredrive.scene.agents import Agents
from foredrive.scene.record import Record

AGENT_CLASSES = (
    Category.CAR,
    Category.TRUCK,
    Category.BUS,
    Category.TRAILER,
    Category.CONSTRUCTION_VEHICLE,
    Category.PEDESTRIAN,
    Category.MOTORCYCLE,
    Category.BICYCLE,
    Category.TRAFFIC_CONE,
    Category.BARRIER,
)
"""The ten classes of nuScenes' detection task, in its order."""
_CHANGES = (len(AGENT_CLASSES), 3, 3, 2, 7, 2, len(Attribute))
"""Numbers of a query: changes of logits, position, size, heading; log stds; change of velocity; attribute."""


@dataclass(frozen=True)
class CarriedConfig:
    """Carrying of agents from frame to frame (`tasks.tracking.carried`)."""

    agents: int = 30
    """Number of queries that are carried on. That many fewer queries begin at proposals."""
    decay: float = 0.36
    """Share of its rank that a carried query keeps at least from frame to frame."""
    reach_m: float = 2.0
    """Maximum distance of the proposal at which a carried agent goes on from where it is expected."""
    born: float = 0.01
    """Minimum score at which a query gets an identity, and minimum rank at which it keeps it."""
    frames: int = 4
    """Key frames of a training sequence, at least 2."""
    dt_s: float = 0.5
    """Time between them."""
    task: Literal["tracking", "detection"] = "tracking"
    """Task whose volume the head reads. Heads that were saved without this entry read that of detection."""


@dataclass(frozen=True)
class AgentHeadConfig:
    """Sizes of an `AgentHead`. The defaults are for towns on two cores."""

    queries: int = 60
    decoder: DecoderConfig = field(default_factory=DecoderConfig)
    motion: MotionConfig | None = field(default_factory=MotionConfig)
    """None: no forecasts."""
    carried: CarriedConfig | None = None
    """None: no identities."""


@dataclass(frozen=True)
class AgentSet(Record):
    """The output of the head for each of Q queries, in the ego frame at now."""

    boxes: BoxSet
    velocity: Float[Tensor, "*b Q 2"]
    """Velocity over ground, m/s."""
    attribute: Float[Tensor, "*b Q A"]
    """Logits of the attributes."""
    future_xy: Float[Tensor, "*b Q M S 2"] | None = None
    """Box centres at the steps after now in each mode, m. None without forecasts."""
    log_prob: Float[Tensor, "*b Q M"] | None = None
    """Log-probability of each mode."""
    query: Float[Tensor, "*b Q W"] | None = None
    """Features of each query; those after the last layer alone."""

    def best_class(self) -> tuple[Float[Tensor, "*b Q"], Int[Tensor, "*b Q"]]:
        """Return the probability of each query's most probable class, and the class.

        Queries without an object weigh `NO_OBJECT_WEIGHT` in the loss, so the logits learn odds that are too
        high by its inverse. Here they are multiplied by it.
        """
        logits = self.boxes.logits.clone()
        # The last logit stands for "no object" and is no class
        logits[..., -1] -= math.log(NO_OBJECT_WEIGHT)
        score, label = logits.softmax(dim=-1)[..., :-1].max(dim=-1)
        return score, label

    def agents(self, dt_s: float) -> Agents:
        """Return the most probable class of each query, with its probability as the score.

        Args:
            dt_s: time between the steps of the futures.
        """
        mean, heading = self.boxes.mean, self.boxes.heading
        score, label = self.best_class()
        categories = torch.tensor([int(kind) for kind in AGENT_CLASSES], device=label.device)
        return Agents(
            centre=mean[..., :3],
            size_lwh=mean[..., 3:].exp(),
            yaw=torch.atan2(heading[..., 0], heading[..., 1]),
            velocity=self.velocity,
            category=categories[label],
            score=score,
            # Only attributes of the category's group can be chosen
            attribute=_possible(self.attribute, categories[label]).argmax(dim=-1),
            track_id=torch.full_like(label, -1),
            future_xy=self.future_xy,
            log_prob=self.log_prob,
            dt_s=dt_s,
        )


class AgentHead(nn.Module):
    """Queries that begin at the most probable centres of a dense map and refine its boxes.

    The queries' first content and boxes come from the cell in which a centre lies (TransFusion, Bai et al.
    2022), so that attention has to learn corrections alone. A query reads the plane at its own position,
    attends to the other queries and to the whole plane. Each layer refines the box of the one before.

    Args:
        planes: the module that makes the planes.
        config: sizes.
    """

    def __init__(self, planes: PlanePyramid, config: AgentHeadConfig) -> None:
        super().__init__()
        width = planes.width
        self.queries, self.carried = config.queries, config.carried
        self.renew: nn.Module | None = None
        if config.carried is not None:
            check_carried(config.carried, config.queries)
            self.renew = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width))
        self.centres = CentreHead(planes.fine_width, len(AGENT_CLASSES))
        self.kind = nn.Embedding(len(AGENT_CLASSES), width)
        self.place = PlaceEmbedding(width)
        self.read = nn.Linear(planes.fine_width, width)
        self.layers = nn.ModuleList(
            QueryDecoderLayer(width, config.decoder) for _ in range(config.decoder.layers)
        )
        self.change = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, sum(_CHANGES))
        )
        final = self.change[-1]
        assert isinstance(final, nn.Linear)
        with torch.no_grad():  # start with the proposals as they are
            final.weight *= 0.1
            final.bias.zero_()
        self.motion = None if config.motion is None else MotionModes(width, config.motion)

    def forward(
        self, planes: Planes, motion_planes: Planes | None = None, carried: AgentSet | None = None
    ) -> tuple[CentreMap, list[AgentSet]]:
        """Return the dense map, and the agents after each layer; the last has the forecasts.

        Args:
            planes: features of detection.
            motion_planes: features of motion. None: no forecasts.
            carried: agents of the frame before in the ego frame at now, with their queries. They are the
                first of the queries, before the most probable proposals that they leave.
        """
        cells, fine = planes.coarse.cells, planes.fine
        cell_place = self.place(planes.coarse.share(planes.coarse.middle_m))[None]
        centres = self.centres(fine)
        # The most probable centres of the map start the queries
        first = best_proposals(centres, self.queries)
        queries, before = self.kind(first.label), _first_agents(first)
        # Carried agents take the place of the least probable proposals
        if carried is not None:
            queries, before = self._with_carried(queries, before, carried)
        layers: list[AgentSet] = []
        for layer in self.layers:
            at_m = before.boxes.mean[..., :2]
            # Each query reads the plane at its own box
            queries = queries + self.read(fine.at(at_m))
            queries = layer(queries, self.place(fine.share(at_m)), cells, cell_place)
            layers.append(_changed(before, self.change(queries)))
            # Each layer refines a fixed box: gradients do not run back through the boxes of earlier layers
            before = layers[-1].map_tensors(torch.Tensor.detach)
        layers[-1] = replace(layers[-1], query=queries)
        if self.motion is not None and motion_planes is not None:
            boxes = layers[-1].boxes
            future_xy, log_prob = self.motion(
                queries, boxes.mean[..., :2], boxes.heading, layers[-1].velocity, motion_planes, self.place
            )
            layers[-1] = replace(layers[-1], future_xy=future_xy, log_prob=log_prob)
        return centres, layers

    def _with_carried(
        self, queries: Float[Tensor, "b Q W"], first: AgentSet, carried: AgentSet
    ) -> tuple[Float[Tensor, "b Q W"], AgentSet]:
        """Return queries and boxes of carried agents and of the proposals that they leave.

        A carried agent goes on at the proposal that it takes, or where it is expected if there is none.
        """
        assert self.carried is not None
        assert self.renew is not None
        assert carried.query is not None
        expected_m, proposed_m = carried.boxes.mean[..., :2], first.boxes.mean[..., :2]
        # Which proposal each carried agent takes, and which proposals are left
        taken, rest = take_proposals(expected_m, proposed_m, self.carried.reach_m)
        sees = taken >= 0
        place = taken.clamp_min(0)

        def go_on(seen: Tensor, expected: Tensor) -> Tensor:
            return torch.where(sees.view(*sees.shape, *[1] * (seen.dim() - 2)), seen, expected)

        item = torch.arange(len(place), device=place.device)[:, None]
        # Features are carried on through a layer, plus those of the proposal that the agent takes
        renewed = self.renew(carried.query) + sees[..., None] * queries[item, place]
        # The box is the proposal's where there is one, else the carried one moved to now
        old = _merged(go_on, _chosen(first, place), carried)
        return torch.cat([renewed, queries[item, rest]], dim=1), _merged(_join, old, _chosen(first, rest))


def _chosen(agents: AgentSet, index: Int[Tensor, "b _N"]) -> AgentSet:
    """Return some agents of each item."""
    item = torch.arange(len(index), device=index.device)[:, None]
    return agents.map_tensors(lambda tensor: tensor[item, index])


def check_carried(config: CarriedConfig, queries: int) -> None:
    """Check the numbers of carried agents and of frames.

    Raises:
        InputError: a number is impossible.
    """
    if not 0 < config.agents < queries:
        raise InputError(f"carried.agents is {config.agents}; the head has {queries} queries for all agents")
    if config.frames < 2:
        raise InputError(f"carried.frames is {config.frames}; agents are carried on from 2 frames on")


def _first_agents(first: Proposals) -> AgentSet:
    # Zero log standard deviations; each layer replaces them
    """Return proposals as agents. The logit of "no object" is 0, so each class keeps its own probability."""
    nothing = torch.zeros_like(first.z)
    heading = nn.functional.normalize(first.heading, dim=-1, eps=1e-3)
    boxes = BoxSet(
        logits=torch.cat([first.logits, nothing[..., None]], dim=-1),
        mean=torch.cat([first.xy, first.z[..., None], first.log_lwh], dim=-1),
        log_std=nothing[..., None].expand(*nothing.shape, 6),
        heading=heading,
        log_std_yaw=nothing,
    )
    return AgentSet(boxes, first.velocity, nothing[..., None].expand(*nothing.shape, len(Attribute)))


def _join(one: Tensor, other: Tensor) -> Tensor:
    return torch.cat([one, other], dim=1)


def _merged(merge: Callable[[Tensor, Tensor], Tensor], first: AgentSet, second: AgentSet) -> AgentSet:
    """Return two sets as one, without queries and forecasts."""
    one, other = first.boxes, second.boxes
    boxes = BoxSet(
        logits=merge(one.logits, other.logits),
        mean=merge(one.mean, other.mean),
        log_std=merge(one.log_std, other.log_std),
        heading=merge(one.heading, other.heading),
        log_std_yaw=merge(one.log_std_yaw, other.log_std_yaw),
    )
    return AgentSet(boxes, merge(first.velocity, second.velocity), merge(first.attribute, second.attribute))


def _changed(before: AgentSet, change: Float[Tensor, "b Q _N"]) -> AgentSet:
    """Return agents after a layer's change of them; spreads and attributes are each layer's own."""
    logits, shift, size, heading, log_std, velocity, attribute = change.split(_CHANGES, dim=-1)
    log_std = log_std.clamp(*LOG_STD_RANGE)
    boxes = before.boxes
    return AgentSet(
        boxes=BoxSet(
            # The logit of "no object" stays 0
            logits=boxes.logits + nn.functional.pad(logits, (0, 1)),
            mean=boxes.mean + torch.cat([shift, size], dim=-1),
            log_std=log_std[..., :6],
            heading=nn.functional.normalize(boxes.heading + heading, dim=-1, eps=1e-3),
            log_std_yaw=log_std[..., 6],
        ),
        velocity=before.velocity + velocity,
        attribute=attribute,
    )


def _possible(logits: Float[Tensor, "*n A"], category: Int[Tensor, "*n"]) -> Float[Tensor, "*n A"]:
    """Leave out the attributes that a category cannot have."""
    # Attributes come in three groups: vehicles, cycles, pedestrians
    of_vehicles, of_cycles = Attribute.CYCLE_WITH_RIDER, Attribute.PEDESTRIAN_MOVING
    kind = torch.arange(logits.shape[-1], device=logits.device)
    group = (kind >= of_vehicles).long() + (kind >= of_cycles).long()
    cycle = (category == Category.MOTORCYCLE) | (category == Category.BICYCLE)
    wanted = torch.where(cycle, 1, torch.where(category == Category.PEDESTRIAN, 2, 0))
    return logits.masked_fill(group != wanted[..., None], -torch.inf)


SAME_M = 1.0
"""A proposal nearer than this to a taken one counts as the same object, found as another class."""


@torch.no_grad()
def take_proposals(
    carried_m: Float[Tensor, "b C 2"], proposals_m: Float[Tensor, "b Q 2"], reach_m: float
) -> tuple[Int[Tensor, "b C"], Int[Tensor, "b Q_C"]]:
    """Return the proposal that each carried agent takes, or -1, and the best Q - C of those that are left.

    Carried agents choose one after another, each the nearest proposal within `reach_m` that is left. Later
    agents cannot choose proposals within `SAME_M` of it; these come last among those that are left.

    Args:
        carried_m: where the carried agents are expected, those that choose first being first.
        proposals_m: centres of the proposals, the best first.
        reach_m: maximum distance.
    """
    batch, count = carried_m.shape[:2]
    item = torch.arange(batch, device=carried_m.device)
    # Distances from carried agents to proposals; those out of reach cannot be taken
    away_m = torch.cdist(carried_m, proposals_m)
    away_m = torch.where(away_m <= reach_m, away_m, torch.inf)
    taken = torch.full((batch, count), -1, dtype=torch.long, device=carried_m.device)
    is_free = torch.ones(proposals_m.shape[:2], dtype=torch.bool, device=carried_m.device)
    # Agents choose in order, in all items of the batch at once
    for agent in range(count):
        away, nearest = torch.where(is_free, away_m[:, agent], torch.inf).min(dim=-1)
        near = away.isfinite()
        taken[near, agent] = nearest[near]
        # Proposals next to the taken one are the same object as another class
        at_m = proposals_m[item, nearest][:, None]
        same = (proposals_m - at_m).norm(dim=-1) < SAME_M
        same[item, nearest] = True
        is_free = is_free & ~(same & near[:, None])
    group = (~is_free).int().scatter_add(1, taken.clamp_min(0), (taken >= 0).int())  # 0 left, 1 same, 2 taken
    # A stable sort keeps the order of probability within each group
    order = group.argsort(dim=-1, stable=True)
    return taken, order[:, : proposals_m.shape[1] - count]
