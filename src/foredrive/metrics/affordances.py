"""Metrics of affordances: pure functions of estimates and truth."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.scene.affordances import AffordanceEstimate, Affordances

LIGHT_M = 40.0
LEAD_M = 40.0
CROSSING_M = 20.0
"""Distances up to which affordances are judged."""
MATCHED_M = 2.0
"""A person is found if an estimate lies at most this far away."""
PROBABLE = 0.3
"""Probability from which an estimate of a crossing person counts: a missed one is worse than a false one."""


@dataclass(frozen=True)
class CrossingCounts:
    """Counts of people who cross, over some frames."""

    true: int
    found: int
    estimated: int
    right: int


def light_right(estimate: AffordanceEstimate, truth: Affordances) -> Bool[Tensor, "b"]:
    """Return whether the most probable state of the next light is the true one."""
    return estimate.light.argmax(-1) == truth.light


def lead_error_m(estimate: AffordanceEstimate, truth: Affordances) -> Float[Tensor, "b"]:
    """Return the absolute error of the gap to the lead vehicle, m."""
    return (estimate.lead_m - truth.lead_m).abs()


def crossing_counts(estimate: AffordanceEstimate, truth: Affordances, front_m: float) -> CrossingCounts:
    """Count the people who cross within `CROSSING_M` of the front bumper, over the frames that tell.

    A true person is found if any probable estimate lies within `MATCHED_M`, an estimate within `CROSSING_M`
    is right if any person who crosses, also further away, does.

    Args:
        front_m: x of the front bumper in the ego frame.
    """
    probable = (estimate.crossing >= PROBABLE) & truth.crossing_known[:, None]
    there = truth.crossing & truth.crossing_known[:, None]
    front = truth.crossing_xy.new_tensor([front_m, 0.0])
    near_true = there & ((truth.crossing_xy - front).norm(dim=-1) <= CROSSING_M)
    near_estimate = probable & ((estimate.crossing_xy - front).norm(dim=-1) <= CROSSING_M)
    close = torch.cdist(truth.crossing_xy, estimate.crossing_xy) <= MATCHED_M
    found = near_true & (close & probable[:, None]).any(-1)
    right = near_estimate & (close & there[..., None]).any(-2)
    counts = (near_true, found, near_estimate, right)
    return CrossingCounts(*(int(count.sum()) for count in counts))
