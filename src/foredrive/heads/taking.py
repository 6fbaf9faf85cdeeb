"""Proposals at which carried agents go on."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

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
