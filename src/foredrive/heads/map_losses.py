"""Set loss of map elements: kinds and points of the best matching (MapTR, Liao et al. 2023, §3.3)."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class MapLossWeights:
    """Weights of the terms, in the matching and in the loss."""

    kind: float = 2.0
    points: float = 0.5
    """Of the L1 distance of a point, per m. MapTR's 5 is for coordinates that are shares of the patch, summed
    over 20 points."""
    direction: float = 0.1
    """Of 1 - cos of the angle between edges. In the loss only."""


class MapLosses(NamedTuple):
    """Terms of the loss, without their weights."""

    kind: Float[Tensor, ""]
    points: Float[Tensor, ""]
    direction: Float[Tensor, ""]


def map_element_losses(
    logits: Float[Tensor, "E K"],
    points: Float[Tensor, "E P 2"],
    kind: Int[Tensor, "N"],
    orders: Float[Tensor, "N O P 2"],
    weights: MapLossWeights = MapLossWeights(),
) -> MapLosses:
    """Return the losses of one frame, each per true element.

    Args:
        logits: of each kind by itself.
        points: predicted points, m.
        kind: kinds of the true elements.
        orders: the same true points in every order that describes the same element (`equivalent_orders`).
        weights: weights of the matching's terms.
    """
    # The optimal assignment, and the order of true points that it found nearest
    element, match, order = _best_matching(logits, points, kind, orders, weights)
    target = torch.zeros_like(logits)
    target[element, kind[match]] = 1.0
    # Frames without elements divide by 1
    objects = max(len(kind), 1)
    true, predicted = orders[match, order], points[element]
    # Directions of edges between successive points
    edges, true_edges = (line[:, 1:] - line[:, :-1] for line in (predicted, true))
    turn = 1 - F.cosine_similarity(edges, true_edges, dim=-1, eps=1e-6)
    return MapLosses(
        kind=sigmoid_focal_loss(logits, target).sum() / objects,
        points=(predicted - true).abs().sum(-1).mean(-1).sum() / objects,
        direction=turn.mean(-1).sum() / objects,
    )


def equivalent_orders(points: Float[Tensor, "P 2"]) -> Float[Tensor, "O P 2"]:
    """Return all orders of points that describe the same element, O = 2 (P - 1).

    An open line runs either way. A closed one, whose last point is its first again, begins anywhere as well.
    The two orders of an open line are repeated, so that O is the same for all elements.
    """
    count = len(points) - 1
    # Both directions of the line
    ways = torch.stack([points, points.flip(0)])
    # An open line has no other start; the two orders are repeated to the common number
    if not torch.equal(points[0], points[-1]):
        return ways.repeat(count, 1, 1)
    # Every start of a closed line: cyclic shifts, closed again by index modulo count
    start = torch.arange(count)[:, None]
    index = (start + torch.arange(count + 1)) % count
    return ways[:, index].flatten(0, 1)


def sigmoid_focal_loss(
    logits: Float[Tensor, "*n"], target: Float[Tensor, "*n"], alpha: float = 0.25, gamma: float = 2.0
) -> Float[Tensor, "*n"]:
    """Return the focal loss of independent probabilities (Lin et al. 2017, eq. 5)."""
    entropy = F.binary_cross_entropy_with_logits(logits, target, reduction="none")
    p = logits.sigmoid()
    # Probability of the wrong answer: well classified entries weigh little
    missed = torch.where(target > 0, 1 - p, p)
    return torch.where(target > 0, alpha, 1 - alpha) * missed**gamma * entropy


@torch.no_grad()
def _best_matching(
    logits: Float[Tensor, "E K"],
    points: Float[Tensor, "E P 2"],
    kind: Int[Tensor, "N"],
    orders: Float[Tensor, "N O P 2"],
    weights: MapLossWeights,
) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"], Int[Tensor, "n"]]:
    """Return matched elements, the true elements, and the order in which the true points are the nearest.

    The cost of a kind is the focal loss of the kind less that of its absence, as in Deformable DETR.
    """
    from scipy.optimize import linear_sum_assignment  # not on every machine with a GPU

    # Cost of claiming a kind less the cost of denying it, for every element and kind
    yes, no = (sigmoid_focal_loss(logits, torch.full_like(logits, value)) for value in (1.0, 0.0))
    # Distance to a true element in its best order
    distance, order = (points[:, None, None] - orders).abs().sum(-1).mean(-1).min(dim=-1)  # [E N]
    cost = weights.kind * (yes - no)[:, kind] + weights.points * distance
    element, match = (
        torch.as_tensor(indices) for indices in linear_sum_assignment(cost.double().cpu().numpy())
    )
    return element.to(points.device), match.to(points.device), order[element, match]
