"""Losses of the head of affordances."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.losses.affordances import distance_loss, light_loss, presence_loss, speed_loss
from foredrive.losses.centres import centre_loss, centre_target
from foredrive.models.tasks.affordances import AffordanceSet
from foredrive.models.tasks.plane import cell_middles
from foredrive.scene.affordances import Affordances
from foredrive.scene.traffic_light import LightState

SPREAD_M = 0.7
"""Standard deviation of the Gaussian around a person in the map of those who cross."""


@dataclass(frozen=True)
class AffordanceLossWeights:
    """Weights of the terms of the affordances' losses."""

    light: float = 1.0
    light_m: float = 0.5
    lead: float = 0.5
    lead_m: float = 0.5
    lead_mps: float = 0.1
    crossing: float = 0.2


def affordance_losses(
    found: AffordanceSet, truth: Affordances, weights: AffordanceLossWeights
) -> dict[str, Float[Tensor, ""]]:
    """Return weighted losses by name. What the log of an item does not tell trains nothing."""
    there = truth.light_known & (truth.light != LightState.NONE)
    lead = truth.lead_known & truth.lead
    return {
        "light": weights.light * light_loss(found.light_logits, truth.light, truth.light_known),
        "light_m": weights.light_m * distance_loss(found.light_m, truth.light_m, there),
        "lead": weights.lead * presence_loss(found.lead_logit, truth.lead, truth.lead_known),
        "lead_m": weights.lead_m * distance_loss(found.lead_m, truth.lead_m, lead),
        "lead_mps": weights.lead_mps * speed_loss(found.lead_mps, truth.lead_mps, lead),
        "crossing": weights.crossing * _crossing_loss(found, truth),
    }


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
