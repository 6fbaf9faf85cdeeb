"""The head of affordances: the next light, the lead vehicle and people who will cross."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.errors import InputError
from foredrive.models.tasks.plane import Plane, PlanePyramid
from foredrive.models.tasks.proposals import RARE_LOGIT
from foredrive.scene.affordances import LEAD_RANGE_M, LIGHT_RANGE_M, AffordanceEstimate
from foredrive.scene.image_features import ImageFeatures
from foredrive.scene.record import Record
from foredrive.scene.traffic_light import LightState

DIRECTION_SCALE = 5.0
TYPICAL_CELL_RAD = 0.02
PLACE_SCALE_M = 20.0
SPEED_SCALE_MPS = 5.0
COLOURS = (LightState.RED, LightState.YELLOW, LightState.GREEN)
DISTANCES = 3
"""Numbers that are regressed: distance of the light, gap and speed of the lead vehicle."""


@dataclass(frozen=True)
class AffordanceHeadConfig:
    """Sizes of an `AffordanceHead`."""

    hidden: int = 64
    """Features kept of all pixels, and of all cells of the plane."""
    people: int = 8
    """Number of places where people may cross that an estimate lists."""


@dataclass(frozen=True)
class AffordanceSet(Record):
    """The output of the head."""

    light_logits: Float[Tensor, "b 4"]
    """Of each `LightState`: for NONE of the whole, for the others the largest of `lamp_logits`."""
    lamp_logits: Float[Tensor, "b C h w 3"]
    """For each cell of each image, whether a red, yellow or green lamp of the next light is there."""
    light_m: Float[Tensor, "b"]
    lead_logit: Float[Tensor, "b"]
    lead_m: Float[Tensor, "b"]
    lead_mps: Float[Tensor, "b"]
    crossing_logits: Float[Tensor, "b Y X"]
    """For each cell, whether a person stands there who will cross."""
    feature: Float[Tensor, "b _F"]
    """What the head has read of images and plane, for planners."""
    lower_m: tuple[float, float]
    cell_m: float
    people: int

    def estimate(self) -> AffordanceEstimate:
        """Return probabilities, and the most probable cells that are maxima among their neighbours."""
        p = self.crossing_logits.sigmoid()
        highest = F.max_pool2d(p[:, None], 5, stride=1, padding=2)[:, 0]
        found, cell = torch.where(p == highest, p, 0.0).flatten(1).topk(self.people)
        columns = p.shape[-1]
        index = torch.stack([cell % columns, cell // columns], dim=-1)
        return AffordanceEstimate(
            light=self.light_logits.softmax(-1),
            light_m=self.light_m,
            lead=self.lead_logit.sigmoid(),
            lead_m=self.lead_m,
            lead_mps=self.lead_mps,
            crossing_xy=p.new_tensor(self.lower_m) + (index + 0.5) * self.cell_m,
            crossing=found,
        )


class AffordanceHead(nn.Module):
    """An MLP on each pixel of the finest image features and on each cell of the plane, then their maxima.

    A lamp has a few pixels and lies above the volume, so it is read in the images: an MLP reads the features
    of a pixel together with the direction of its ray, and the maximum over all pixels of all cameras is kept
    for each of its outputs (PointNet, Qi et al. 2017). So a few pixels count as much as a wall, and the rig
    may change. The state of the light is where its lamp is most probable: one output a pixel for each colour,
    which is supervised in place where a log tells the places of lamps. The same is done with the cells of the
    plane and their places, for the lead vehicle. People who cross are a map of the plane.

    Args:
        planes: the module that makes the planes.
        channels: channels of the image features.
        config: sizes.
    """

    def __init__(self, planes: PlanePyramid, channels: int, config: AffordanceHeadConfig) -> None:
        super().__init__()
        hidden, self.people = config.hidden, config.people
        self.pixel = _pointwise(channels + 4, hidden)
        self.cell = _pointwise(planes.fine_width + 2, hidden)
        self.together = nn.Sequential(nn.Linear(2 * hidden, 2 * hidden), nn.ReLU())
        self.numbers = nn.Linear(2 * hidden, 2 + DISTANCES)
        self.lamp = nn.Linear(hidden, len(COLOURS))
        nn.init.constant_(self.lamp.bias, RARE_LOGIT)
        rare = nn.Conv2d(planes.fine_width, 1, 1)
        assert rare.bias is not None
        nn.init.constant_(rare.bias, RARE_LOGIT)
        self.crossing = nn.Sequential(
            nn.Conv2d(planes.fine_width, planes.fine_width, 3, padding=1), nn.ReLU(), rare
        )

    def forward(self, images: ImageFeatures | None, plane: Plane) -> AffordanceSet:
        """Return the affordances.

        Args:
            images: of now.
            plane: of now, in the resolution of the volume.

        Raises:
            InputError: the volumes were kept without image features.
        """
        if images is None:
            raise InputError("affordances are read in the images: this belief has none")
        read, lamps = self._of_images(images)
        feature = self.together(torch.cat([read, self._of_plane(plane)], dim=-1))
        numbers = self.numbers(feature).float()
        light_m, lead_m, lead_mps = numbers[:, -DISTANCES:].unbind(-1)
        return AffordanceSet(
            light_logits=torch.cat([numbers[:, :1], lamps.flatten(1, 3).amax(dim=1)], dim=-1),
            lamp_logits=lamps,
            light_m=0.5 * LIGHT_RANGE_M * (1 + light_m),
            lead_logit=numbers[:, 1],
            lead_m=0.5 * LEAD_RANGE_M * (1 + lead_m),
            lead_mps=SPEED_SCALE_MPS * (1 + lead_mps),
            crossing_logits=self.crossing(plane.features)[:, 0].float(),
            feature=feature,
            lower_m=plane.lower_m,
            cell_m=plane.cell_m,
            people=self.people,
        )

    def _of_images(self, images: ImageFeatures) -> tuple[Float[Tensor, "b F"], Float[Tensor, "b C h w 3"]]:
        """Return the maxima over all pixels, and the logits of lamps in each."""
        b, c, h, w, _ = images.values.shape
        fine = (images.cell_rad / TYPICAL_CELL_RAD).log().view(b, c, 1, 1, 1).expand(b, c, h, w, 1)
        inputs = torch.cat([images.values, DIRECTION_SCALE * images.direction, fine], dim=-1)
        valid = images.valid.view(b, c, 1, 1, 1)
        read = self.pixel(inputs)
        lamps = self.lamp(read).float()
        lamps = torch.where(valid > 0, lamps, 2 * RARE_LOGIT)
        return (read * valid).flatten(1, 3).amax(dim=1), lamps  # features are at least 0

    def _of_plane(self, plane: Plane) -> Float[Tensor, "b F"]:
        place = (plane.middle_m / PLACE_SCALE_M).expand(len(plane.features), -1, -1)
        highest: Tensor = self.cell(torch.cat([plane.cells, place], dim=-1)).amax(dim=1)
        return highest


def _pointwise(inputs: int, hidden: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU())
