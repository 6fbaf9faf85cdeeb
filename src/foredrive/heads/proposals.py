"""Dense proposals: the probability of an object's centre in each cell, and the box around it."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from foredrive.heads.detection_network import TYPICAL_LOG_LWH
from foredrive.heads.plane import Plane
from foredrive.scene.record import Record

BOX_NUMBERS = (2, 1, 3, 2, 2)
"""Numbers of a cell's box: shift, height, size, heading, velocity."""
RARE_LOGIT = -4.0
"""Initial logit of a centre: about 1 cell in 50, so that empty cells do not drown the first steps."""


@dataclass(frozen=True)
class CentreMap(Record):
    """For each cell of a plane, whether a centre lies in it, and the box around that centre."""

    logits: Float[Tensor, "*b K y x"]
    """Logit of a centre of each class."""
    xy: Float[Tensor, "*b y x 2"]
    """Centre, m, ego frame."""
    z: Float[Tensor, "*b y x"]
    log_lwh: Float[Tensor, "*b y x 3"]
    heading: Float[Tensor, "*b y x 2"]
    """Sine and cosine, not normalised."""
    velocity: Float[Tensor, "*b y x 2"]


@dataclass(frozen=True)
class Proposals(Record):
    """The Q most probable centres."""

    cell: Int[Tensor, "b Q"]
    """Cell of the plane, x running faster."""
    label: Int[Tensor, "b Q"]
    logits: Float[Tensor, "b Q K"]
    xy: Float[Tensor, "b Q 2"]
    z: Float[Tensor, "b Q"]
    log_lwh: Float[Tensor, "b Q 3"]
    heading: Float[Tensor, "b Q 2"]
    velocity: Float[Tensor, "b Q 2"]


class CentreHead(nn.Module):
    """Convolutions from a plane to a `CentreMap` (CenterPoint, Yin et al. 2021).

    Args:
        width: channels of the plane.
        classes: K.
    """

    def __init__(self, width: int, classes: int) -> None:
        super().__init__()
        self.classes = classes
        self.shared = nn.Sequential(nn.Conv2d(width, width, 3, padding=1), nn.ReLU())
        self.out = nn.Conv2d(width, classes + sum(BOX_NUMBERS), 1)
        assert self.out.bias is not None
        with torch.no_grad():
            self.out.bias[:classes] = RARE_LOGIT

    def forward(self, plane: Plane) -> CentreMap:
        """Return the centres of a plane."""
        out = self.out(self.shared(plane.features))
        logits, boxes = out[:, : self.classes], out[:, self.classes :].permute(0, 2, 3, 1)
        shift, z, size, heading, velocity = boxes.split(BOX_NUMBERS, dim=-1)
        # Boxes relative to the middle of their cell, in units of its edge
        return CentreMap(
            logits=logits,
            xy=plane.middle_m.view(*out.shape[2:], 2) + plane.cell_m * shift,
            z=z[..., 0],
            log_lwh=size + size.new_tensor(TYPICAL_LOG_LWH),
            heading=heading,
            velocity=velocity,
        )


@torch.no_grad()
def best_proposals(centres: CentreMap, count: int) -> Proposals:
    """Return the most probable pairs of a class and a cell, where no neighbouring cell is more probable.

    As in TransFusion (Bai et al. 2022, §3.3). Nothing passes a gradient.
    """
    logits = centres.logits
    # A cell is a peak if no neighbour has a larger logit of the same class
    peak = F.max_pool2d(logits, 3, stride=1, padding=1) == logits
    cells = logits[0, 0].numel()
    # Rank classes and cells together; flattened index = class · cells + cell
    ranked = torch.where(peak, logits, -torch.inf).flatten(1)
    best = ranked.topk(min(count, ranked.shape[1]), dim=1).indices
    label, cell = best // cells, best % cells

    def chosen(values: Float[Tensor, "b y x *d"]) -> Tensor:
        flat = values.flatten(1, 2)
        index = cell.view(*cell.shape, *[1] * (flat.dim() - 2)).expand(-1, -1, *flat.shape[2:])
        return flat.gather(1, index)

    return Proposals(
        cell=cell,
        label=label,
        logits=chosen(logits.permute(0, 2, 3, 1)),
        xy=chosen(centres.xy),
        z=chosen(centres.z),
        log_lwh=chosen(centres.log_lwh),
        heading=chosen(centres.heading),
        velocity=chosen(centres.velocity),
    )
