"""The head of road users: a set of boxes with velocity, attribute and motion."""

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from foredrive.models.detection import LOG_STD_RANGE, TYPICAL_LOG_LWH, BoxSet
from foredrive.models.tasks.decoder import DecoderConfig, PlaceEmbedding, QueryDecoderLayer
from foredrive.models.tasks.plane import Plane, PlaneFeatures
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
_BOX = (len(AGENT_CLASSES) + 1, 3, 3, 2, 7, 2, len(Attribute))
"""Numbers of a query: logits, shift and height, size, heading, log stds, velocity, attribute."""


@dataclass(frozen=True)
class MotionConfig:
    """Sizes of the forecast of each agent's motion."""

    modes: int = 6
    steps: int = 12
    dt_s: float = 0.5
    decoder: DecoderConfig = field(default_factory=lambda: DecoderConfig(layers=1))


@dataclass(frozen=True)
class AgentHeadConfig:
    """Sizes of an `AgentHead`. The defaults are for towns on two cores."""

    queries: int = 100
    decoder: DecoderConfig = field(default_factory=DecoderConfig)
    motion: MotionConfig | None = field(default_factory=MotionConfig)
    """None: no forecasts."""


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

    def agents(self, dt_s: float) -> Agents:
        """Return the most probable class of each query, with its probability as the score.

        Args:
            dt_s: time between the steps of the futures.
        """
        mean, heading = self.boxes.mean, self.boxes.heading
        score, label = self.boxes.logits.softmax(dim=-1)[..., :-1].max(dim=-1)
        categories = torch.tensor([int(kind) for kind in AGENT_CLASSES], device=label.device)
        return Agents(
            centre=mean[..., :3],
            size_lwh=mean[..., 3:].exp(),
            yaw=torch.atan2(heading[..., 0], heading[..., 1]),
            velocity=self.velocity,
            category=categories[label],
            score=score,
            attribute=_possible(self.attribute, categories[label]).argmax(dim=-1),
            track_id=torch.full_like(label, -1),
            future_xy=self.future_xy,
            log_prob=self.log_prob,
            dt_s=dt_s,
        )


class AgentHead(nn.Module):
    """Queries that look for road users. Each refines the position of its box from layer to layer.

    A query reads the plane at its own position, attends to the other queries and to the whole plane (the
    refinement is that of Deformable DETR, Zhu et al. 2021, with plain attention).

    Args:
        plane: the module that makes the planes.
        config: sizes.
    """

    def __init__(self, plane: PlaneFeatures, config: AgentHeadConfig) -> None:
        super().__init__()
        width = plane.width
        self.content = nn.Parameter(0.02 * torch.randn(config.queries, width))
        self.start_m = nn.Parameter(spread_points(plane, config.queries))
        self.place = PlaceEmbedding(width)
        self.read = nn.Linear(width, width)
        self.layers = nn.ModuleList(
            QueryDecoderLayer(width, config.decoder) for _ in range(config.decoder.layers)
        )
        self.out = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, sum(_BOX))
        )
        final = self.out[-1]
        assert isinstance(final, nn.Linear)
        with torch.no_grad():  # start with a low probability of existence and at the queries' positions
            final.weight[_BOX[0] : _BOX[0] + 3] *= 0.1
            final.bias[len(AGENT_CLASSES)] = 4.0
        self.motion = None if config.motion is None else MotionModes(width, config.motion)

    def forward(self, plane: Plane, motion_plane: Plane | None = None) -> list[AgentSet]:
        """Return the agents after each layer; the last has the forecasts.

        Args:
            plane: features of detection.
            motion_plane: features of motion. None: no forecasts.
        """
        batch, cells = len(plane.features), plane.cells
        cell_place = self.place(plane.share(plane.middle_m))[None]
        queries = self.content.expand(batch, -1, -1)
        at_m = self.start_m.expand(batch, -1, -1)
        found = []
        for layer in self.layers:
            queries = queries + self.read(plane.at(at_m))
            queries = layer(queries, self.place(plane.share(at_m)), cells, cell_place)
            found.append(self._agents(queries, at_m, plane.cell_m))
            at_m = found[-1].boxes.mean[..., :2].detach()
        found[-1] = replace(found[-1], query=queries)
        if self.motion is not None and motion_plane is not None:
            found[-1] = self.motion(queries, found[-1], motion_plane, self.place)
        return found

    def _agents(
        self, queries: Float[Tensor, "b Q W"], at_m: Float[Tensor, "b Q 2"], cell_m: float
    ) -> AgentSet:
        logits, shift, size, heading, log_std, velocity, attribute = self.out(queries).split(_BOX, dim=-1)
        log_std = log_std.clamp(*LOG_STD_RANGE)
        log_lwh = size + size.new_tensor(TYPICAL_LOG_LWH)
        boxes = BoxSet(
            logits=logits,
            mean=torch.cat([at_m + cell_m * shift[..., :2], shift[..., 2:], log_lwh], dim=-1),
            log_std=log_std[..., :6],
            heading=nn.functional.normalize(heading, dim=-1, eps=1e-3),
            log_std_yaw=log_std[..., 6],
        )
        return AgentSet(boxes, velocity, attribute)


class MotionModes(nn.Module):
    """Alternative motions of each agent, as the difference from its constant velocity.

    A query for each agent and mode attends to all others and to the plane. Differences are along and across
    the heading, so that one mode means the same for agents of all headings. Positions, headings and
    velocities pass no gradient to the boxes.

    Args:
        width: channels of the queries.
        config: sizes.
    """

    def __init__(self, width: int, config: MotionConfig) -> None:
        super().__init__()
        self.config = config
        self.mode = nn.Parameter(torch.randn(config.modes, width))
        self.layers = nn.ModuleList(
            QueryDecoderLayer(width, config.decoder) for _ in range(config.decoder.layers)
        )
        self.out = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 2 * config.steps + 1))

    def forward(
        self, queries: Float[Tensor, "b Q W"], agents: AgentSet, plane: Plane, place: PlaceEmbedding
    ) -> AgentSet:
        """Return the agents with their futures."""
        config, (_b, q, _) = self.config, queries.shape
        centre, heading = agents.boxes.mean[..., :2].detach(), agents.boxes.heading.detach()
        modes = (queries[:, :, None] + self.mode).flatten(1, 2)
        at = place(plane.share(centre)).repeat_interleave(config.modes, dim=1)
        cell_place = place(plane.share(plane.middle_m))[None]
        for layer in self.layers:
            modes = layer(modes, at, plane.cells, cell_place)
        out = self.out(modes).unflatten(1, (q, config.modes))
        change = config.dt_s * out[..., :-1].unflatten(-1, (config.steps, 2)).cumsum(dim=-2)
        sin, cos = heading[:, :, None, None, 0], heading[:, :, None, None, 1]
        along, across = change.unbind(-1)
        moved = torch.stack([cos * along - sin * across, sin * along + cos * across], dim=-1)
        t_s = config.dt_s * torch.arange(1, config.steps + 1, device=queries.device)
        steady = centre[:, :, None] + agents.velocity.detach()[:, :, None] * t_s[:, None]
        return replace(
            agents, future_xy=steady[:, :, None] + moved, log_prob=out[..., -1].log_softmax(dim=-1)
        )


def _possible(logits: Float[Tensor, "*n A"], category: Int[Tensor, "*n"]) -> Float[Tensor, "*n A"]:
    """Leave out the attributes that a category cannot have."""
    of_vehicles, of_cycles = Attribute.CYCLE_WITH_RIDER, Attribute.PEDESTRIAN_MOVING
    kind = torch.arange(logits.shape[-1], device=logits.device)
    group = (kind >= of_vehicles).long() + (kind >= of_cycles).long()
    cycle = (category == Category.MOTORCYCLE) | (category == Category.BICYCLE)
    wanted = torch.where(cycle, 1, torch.where(category == Category.PEDESTRIAN, 2, 0))
    return logits.masked_fill(group != wanted[..., None], -torch.inf)


def spread_points(plane: PlaneFeatures, count: int) -> Float[Tensor, "count 2"]:
    """Return points at about equal distances over a plane, m."""
    rows, columns = plane.shape_yx
    per_row = math.ceil(math.sqrt(count * columns / rows))
    n_rows = math.ceil(count / per_row)
    index = torch.arange(count)
    share = torch.stack([(index % per_row + 0.5) / per_row, (index // per_row + 0.5) / n_rows], dim=-1)
    return torch.tensor(plane.lower_m) + share * plane.cell_m * torch.tensor([columns, rows])
