"""Loss of a dense map of objects' centres (CenterNet, Zhou et al. 2019; CenterPoint, Yin et al. 2021)."""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor


def centre_target(
    xy: Float[Tensor, "N 2"],
    label: Int[Tensor, "N"],
    spread_m: Float[Tensor, "N"],
    middle_m: Float[Tensor, "y x 2"],
    cell_m: float,
    classes: int,
) -> Float[Tensor, "K y x"]:
    """Return a map with 1 in the cell of each centre and a Gaussian around it; the largest one counts.

    Args:
        xy: centres inside of the map, m.
        label: classes.
        spread_m: standard deviation of each Gaussian.
        middle_m: middles of the cells.
        cell_m: edge of a cell.
        classes: K.
    """
    target = xy.new_zeros(classes, *middle_m.shape[:2])
    away_m = (middle_m[None] - xy[:, None, None]).square().sum(-1)
    bump = (-0.5 * away_m / spread_m[:, None, None].square()).exp()
    cell = ((xy - middle_m[0, 0]) / cell_m + 0.5).floor().long()
    bump[torch.arange(len(xy)), cell[:, 1], cell[:, 0]] = 1.0
    index = label.long()[:, None, None].expand_as(bump)
    return target.scatter_reduce(0, index, bump, "amax")


def centre_loss(
    logits: Float[Tensor, "*n K y x"],
    target: Float[Tensor, "*n K y x"],
    alpha: float = 2.0,
    beta: float = 4.0,
) -> Float[Tensor, ""]:
    """Return the focal loss, lower near centres, per centre (CornerNet, Law and Deng 2018, eq. 1)."""
    p = logits.sigmoid()
    centre = target == 1.0
    found = (1 - p) ** alpha * F.logsigmoid(logits)
    empty = (1 - target) ** beta * p**alpha * F.logsigmoid(-logits)
    return -torch.where(centre, found, empty).sum() / centre.sum().clamp_min(1)
