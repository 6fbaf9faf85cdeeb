"""Matching of queries to objects over time: a carried query stays with the object that it was matched to."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.heads.detection_losses import MatchingLossConfig, best_matching
from foredrive.heads.detection_network import BoxSet
from foredrive.sets import LabelledBoxes

NOBODY = -1
"""Owner of a query that was matched to no object."""
RELEASED_M = 4.0
"""Distance from which on a carried query is no longer held to its object."""


@dataclass(frozen=True)
class Held:
    """The queries of one frame that carry on an object of the frame before."""

    query: Int[Tensor, "h"]
    match: Int[Tensor, "h"]
    """The object of each of `query` at now."""
    bound: Bool[Tensor, "Q"]
    """Queries that carry on an object, also one that has left: they can have no other."""


def held_objects(
    source: Int[Tensor, "Q"],
    owner: Int[Tensor, "_Q"],
    track_id: Int[Tensor, "N"],
    away_m: Float[Tensor, "Q N"],
) -> Held:
    """Return which queries have to find which objects (MOTR, Zeng et al. 2022, §3.3).

    A query that is `RELEASED_M` away from its object has lost it: both are free.

    Args:
        source: index of each query in the frame before, or -1.
        owner: identity of the object that each query of the frame before was matched to, or `NOBODY`.
        track_id: identity of each object at now.
        away_m: distance of each query from each object, m.
    """
    # Object that the query carried on, if any
    query_track = torch.where(source >= 0, owner[source.clamp_min(0)], NOBODY)
    # Its row among the objects at now
    has_same_track = (query_track[:, None] == track_id) & (query_track[:, None] != NOBODY)
    # A query that is far from its object is free, and the object is free as well
    is_released = (has_same_track & (away_m >= RELEASED_M)).any(dim=1)
    has_same_track = has_same_track & ~is_released[:, None]
    query, match = has_same_track.nonzero(as_tuple=True)
    return Held(query, match, (query_track != NOBODY) & ~is_released)


def matching_beside(
    predicted: BoxSet, truth: LabelledBoxes, held: Held, config: MatchingLossConfig
) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
    """Return queries and their objects: the held ones, and the best matching of all others."""
    # Queries and objects without a partner are matched optimally
    free_query = (~held.bound).nonzero()[:, 0]
    free = torch.ones(len(truth.label), dtype=torch.bool, device=held.match.device)
    free[held.match] = False
    free_object = free.nonzero()[:, 0]
    query, match = best_matching(predicted[free_query], truth[free_object], config)
    return torch.cat([held.query, free_query[query]]), torch.cat([held.match, free_object[match]])


def owners(
    query: Int[Tensor, "n"], match: Int[Tensor, "n"], track_id: Int[Tensor, "N"], queries: int
) -> Int[Tensor, "Q"]:
    """Return the identity of the object of each query, or `NOBODY`."""
    owner = torch.full((queries,), NOBODY, dtype=torch.long, device=query.device)
    owner[query] = track_id[match].long()
    return owner
