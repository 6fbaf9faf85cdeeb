"""The head of instance occupancy: where each detected vehicle is, now and in the beliefs that are imagined.

As in UniAD's OccFormer (Hu et al. 2023, section 3.4), the mask of an agent is the dot product of a feature of
the agent and the features of the plane's pixels. Here the pixels of later steps come from the world model's
imagined beliefs, and the product corrects the agent's box moved at constant velocity.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from foredrive.geometry.se3 import inverse_se3
from foredrive.heads.agents_head import AGENT_CLASSES, AgentSet
from foredrive.heads.plane import Plane, PlanePyramid, cell_middles, moved_over_ground
from foredrive.scene.boxes import VEHICLES
from foredrive.scene.map_elements import PlaneSpec
from foredrive.scene.record import Record

MARGIN_M = 0.25
"""The truth's cells are about half a cell of 0.5 m larger than a box, on each side."""
FARTHEST = 4.0
"""Distance in half boxes beyond which the prior does not fall any more."""
MIN_SCORE, MIN_PROBABILITY = 0.3, 0.5
"""Agents and cells below these are no part of a prediction."""
_IS_VEHICLE = torch.tensor([kind in VEHICLES for kind in AGENT_CLASSES])


@dataclass(frozen=True)
class InstanceHeadConfig:
    """Sizes of an `InstanceHead`."""

    width: int = 16
    """Channels of the dot product."""
    steps: int = 4
    """Number of imagined key frames."""
    dt_s: float = 0.5
    """Time between key frames."""


@dataclass(frozen=True)
class InstanceSet(Record):
    """The output of the head for Q agents and S = 1 + imagined key frames."""

    embedding: Float[Tensor, "*b Q S w"]
    sharpness: Float[Tensor, "*b Q S"]
    """Weight of the moved box, above 0."""
    pixels: Float[Tensor, "*b S w y x"]
    """Features of the cells of the volume's plane, all in the ego frame at now. 0 where they are unknown."""
    lower_m: tuple[float, float]
    cell_m: float
    dt_s: float


class InstanceHead(nn.Module):
    """Features of agents and of pixels whose products are instance masks.

    Args:
        planes: the module that makes the planes.
        config: sizes.
    """

    def __init__(self, planes: PlanePyramid, config: InstanceHeadConfig) -> None:
        super().__init__()
        self.config = config
        self.shape_yx, fine = planes.shape_yx, planes.fine_width
        self.pixels = nn.Sequential(
            nn.Conv2d(fine, fine, 3, padding=1), nn.ReLU(), nn.Conv2d(fine, config.width, 1)
        )
        self.agent = nn.Sequential(
            nn.LayerNorm(planes.width),
            nn.Linear(planes.width, planes.width),
            nn.ReLU(),
            nn.Linear(planes.width, (config.steps + 1) * (config.width + 1)),
        )
        final = self.agent[-1]
        assert isinstance(final, nn.Linear)
        with torch.no_grad():  # start with boxes at constant velocity
            final.weight *= 0.1
            final.bias.zero_()
            final.bias.view(config.steps + 1, -1)[:, -1] = 3.0

    def forward(
        self,
        query: Float[Tensor, "b Q W"],
        now: Plane,
        later: list[Plane],
        T_now_later: Float[Tensor, "b K 4 4"],
    ) -> InstanceSet:
        """Return the features of agents and pixels.

        Args:
            query: features of the agents.
            now: plane of the present.
            later: planes of K imagined beliefs, each in its own ego frame. Of steps that the world model does
                not imagine, boxes at constant velocity remain.
            T_now_later: the ego frames of these beliefs -> the ego frame at now.
        """
        out = self.agent(query).unflatten(-1, (self.config.steps + 1, self.config.width + 1))
        seen = [self.pixels(now.features)]
        middle = cell_middles(now.lower_m, now.cell_m, self.shape_yx).to(now.features.device)
        T_later_now = inverse_se3(T_now_later)
        for step, plane in enumerate(later):
            # Places of now's cells in the ego frame of the imagined step
            carried_xy = moved_over_ground(T_later_now[:, step], middle)
            moved = Plane(self.pixels(plane.features), plane.lower_m, plane.cell_m).at(carried_xy)
            seen.append(moved.mT.unflatten(-1, self.shape_yx))
        # Zeros leave the box at constant velocity as the only prior of steps that are not imagined
        seen += [torch.zeros_like(seen[0])] * (self.config.steps - len(later))
        return InstanceSet(
            embedding=out[..., :-1],
            sharpness=nn.functional.softplus(out[..., -1]),
            pixels=torch.stack(seen, dim=1),
            lower_m=now.lower_m,
            cell_m=now.cell_m,
            dt_s=self.config.dt_s,
        )


def instance_logits(
    instances: InstanceSet, agents: AgentSet, rows: Int[Tensor, "n"], points_m: Float[Tensor, "P 2"]
) -> Float[Tensor, "n S P"]:
    """Return the logit of each point for some agents of an unbatched item.

    Boxes and velocities pass no gradient to the agents' head.

    Args:
        instances: output of the head.
        agents: the agents whose queries it read.
        rows: numbers of the agents.
        points_m: in the ego frame at now.
    """
    embedding, count = instances.embedding[rows], instances.embedding.shape[-2]
    mean, heading, velocity = (
        part[rows].detach() for part in (agents.boxes.mean, agents.boxes.heading, agents.velocity)
    )
    # Boxes at constant velocity
    t_s = instances.dt_s * torch.arange(count, device=mean.device)
    place = mean[:, None, :2] + velocity[:, None] * t_s[:, None]
    offset = points_m - place[:, :, None]
    # Offset from the box along and across its heading, in half boxes
    sin, cos = heading[:, None, None, 0], heading[:, None, None, 1]
    half = 0.5 * mean[:, 3:5].exp() + MARGIN_M
    along = (cos * offset[..., 0] + sin * offset[..., 1]).abs() / half[:, None, None, 0]
    across = (cos * offset[..., 1] - sin * offset[..., 0]).abs() / half[:, None, None, 1]
    # 1 at the centre, 0 at the border of the box, negative beyond, bounded far away
    inside = 1.0 - torch.maximum(along, across).clamp_max(FARTHEST)
    plane = Plane(instances.pixels, instances.lower_m, instances.cell_m)
    pixels = plane.at(points_m.expand(count, -1, -1))
    # Scaled dot product of the agent's feature and the features of the pixels
    product = torch.einsum("nsw,spw->nsp", embedding.to(pixels), pixels) / embedding.shape[-1] ** 0.5
    return instances.sharpness[rows][..., None] * inside + product


def instance_raster(instances: InstanceSet, agents: AgentSet, spec: PlaneSpec) -> Int[Tensor, "b S Y X"]:
    """Return the vehicle of each cell of a grid, its query's number + 1; 0 for none.

    Vehicles are agents of UniAD's seven classes with a score of at least `MIN_SCORE`, and cells have a
    probability of at least `MIN_PROBABILITY`. Of several vehicles, a cell belongs to that of the highest
    product of probability and score, as in UniAD: so two queries on one vehicle do not share its cells.
    """
    count = instances.embedding.shape[-2]
    points = cell_middles(spec.lower_m, spec.cell_m, spec.shape_yx).to(instances.embedding.device)
    raster = torch.zeros(len(instances.embedding), count, len(points), dtype=torch.long, device=points.device)
    is_vehicle = _IS_VEHICLE.to(points.device)
    for item in range(len(raster)):
        score, label = agents[item].best_class()
        rows = ((score >= MIN_SCORE) & is_vehicle[label]).nonzero()[:, 0]
        if len(rows):
            probability = instance_logits(instances[item], agents[item], rows, points).sigmoid()
            inside = probability >= MIN_PROBABILITY
            # Of several vehicles at a cell, the product of probability and score decides
            which = (probability * inside * score[rows, None, None]).argmax(dim=0)
            raster[item] = torch.where(inside.any(dim=0), rows[which] + 1, 0)
    return raster.unflatten(-1, spec.shape_yx)
