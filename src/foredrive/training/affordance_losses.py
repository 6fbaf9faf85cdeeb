"""Losses of the head of affordances."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.losses.affordances import distance_loss, light_loss, presence_loss, speed_loss
from foredrive.losses.centres import centre_loss, centre_target
from foredrive.models.tasks.affordances import AffordanceSet
from foredrive.models.tasks.plane import cell_middles
from foredrive.scene import CameraRig
from foredrive.scene.affordances import Affordances
from foredrive.scene.traffic_light import LightState

BESIDE_LAMP = 0.8
"""Target of the cells around that of a lamp: a lamp may lie on their border."""
SPREAD_M = 0.7
"""Standard deviation of the Gaussian around a person in the map of those who cross."""


@dataclass(frozen=True)
class AffordanceLossWeights:
    """Weights of the terms of the affordances' losses."""

    light: float = 1.0
    lamps: float = 0.3
    """Of the lamps in the images, where their places are known."""
    light_m: float = 0.5
    lead: float = 0.5
    lead_m: float = 0.5
    lead_mps: float = 0.1
    crossing: float = 0.2


def affordance_losses(
    found: AffordanceSet, truth: Affordances, weights: AffordanceLossWeights, rig: CameraRig | None = None
) -> dict[str, Float[Tensor, ""]]:
    """Return weighted losses by name. What the log of an item does not tell trains nothing.

    Args:
        found: of b items.
        truth: of b items.
        weights: weights of the terms.
        rig: cameras at now, [b C]. Without it, lamps are not supervised in place.
    """
    there = truth.light_known & (truth.light != LightState.NONE)
    lead = truth.lead_known & truth.lead
    speed = lead & truth.lead_mps.isfinite()  # boxes of some logs have no velocity
    return {
        "light": weights.light * light_loss(found.light_logits, truth.light, truth.light_known),
        "lamps": weights.lamps * _lamp_loss(found, truth, rig),
        "light_m": weights.light_m * distance_loss(found.light_m, truth.light_m, there),
        "lead": weights.lead * presence_loss(found.lead_logit, truth.lead, truth.lead_known),
        "lead_m": weights.lead_m * distance_loss(found.lead_m, truth.lead_m, lead),
        "lead_mps": weights.lead_mps * speed_loss(found.lead_mps, truth.lead_mps, speed),
        "crossing": weights.crossing * _crossing_loss(found, truth),
    }


def _lamp_loss(found: AffordanceSet, truth: Affordances, rig: CameraRig | None) -> Float[Tensor, ""]:
    """Return the focal loss of the lamps of the next light in the images, over the items that tell."""
    items = truth.lamps_known.nonzero()[:, 0].tolist()
    if not items or rig is None:
        return 0.0 * found.lamp_logits.sum()
    b, c, h, w, colours = found.lamp_logits.shape
    points = truth.lamp_xyz[:, None].expand(b, c, -1, -1)
    in_camera = transform_points(inverse_se3(rig.T_ego_cam), points)
    uv, _, inside = project(in_camera, rig.K, rig.dist, rig.size_hw)
    inside = inside & truth.lamp[:, None]
    cell = (uv * w / rig.size_hw[1]).floor().long()
    target = found.lamp_logits.new_zeros(b, c, colours, h, w)
    for item, camera, lamp in inside.nonzero().tolist():
        colour = int(truth.light[item]) - 1
        x, y = cell[item, camera, lamp].tolist()
        if colour >= 0 and y < h and x < w:
            around = target[item, camera, colour, max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
            around.clamp_min_(BESIDE_LAMP)
            target[item, camera, colour, y, x] = 1.0
    return centre_loss(found.lamp_logits.permute(0, 1, 4, 2, 3)[items], target[items])


def _crossing_loss(found: AffordanceSet, truth: Affordances) -> Float[Tensor, ""]:
    """Return the focal loss of the map of people who cross, over the items that tell."""
    items = truth.crossing_known.nonzero()[:, 0].tolist()
    if not items:
        return 0.0 * found.crossing_logits.sum()
    rows, columns = found.crossing_logits.shape[-2:]
    lower = found.crossing_logits.new_tensor(found.lower_m)
    upper = lower + found.cell_m * lower.new_tensor([columns, rows])
    middle_m = cell_middles(found.lower_m, found.cell_m, (rows, columns)).to(lower)
    targets = []
    for item in items:
        xy = truth.crossing_xy[item]
        xy = xy[truth.crossing[item] & ((xy >= lower) & (xy < upper)).all(-1)]
        label, spread_m = xy.new_zeros(len(xy), dtype=torch.long), xy.new_full((len(xy),), SPREAD_M)
        targets.append(centre_target(xy, label, spread_m, middle_m.view(rows, columns, 2), found.cell_m, 1))
    return centre_loss(found.crossing_logits[items, None], torch.stack(targets))
