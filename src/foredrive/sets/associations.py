"""The sum over all associations of detections with objects: exact in small components, bounded elsewhere.

An association pairs some detections with one object each; the other detections are absent and the other
objects are background. Its weight is the product of what every pair, absent detection and background object
weighs (PMB density, thesis eq. 3.10-3.12, where each summand is one association).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from foredrive.errors import InputError
from foredrive.sets.component import gate_by_price, is_small, sum_component

_COARSER, _COARSEST_NATS = 100.0, 0.1


@dataclass(frozen=True)
class AssociationSum:
    """Logarithm of the sum over associations, as an interval, and the distribution over associations."""

    log_lower: float
    """What was summed; -inf if no association is possible."""
    log_upper: float
    """No more than this was missed by gating and by listing only the best associations."""
    pair: Float[ndarray, "M N"]
    """Probability that detection i and object j belong together."""
    best: Int[ndarray, "N"]
    """Detection of each object in the most likely association; -1: background."""
    impossible_detections: Int[ndarray, "_"]
    """Detections that are certain and yet without an object, in the association with fewest such faults."""
    impossible_objects: Int[ndarray, "_"]
    """Objects that no detection and no background explains, in the same association."""

    @property
    def absent(self) -> Float[ndarray, "M"]:
        """Probability that a detection has no object."""
        return np.clip(1.0 - self.pair.sum(1), 0.0, 1.0)

    @property
    def background(self) -> Float[ndarray, "N"]:
        """Probability that an object has no detection."""
        return np.clip(1.0 - self.pair.sum(0), 0.0, 1.0)


def sum_associations(
    log_pair: Float[ndarray, "M N"],
    log_absent: Float[ndarray, "M"],
    log_background: Float[ndarray, "N"],
    *,
    k: int = 25,
    max_states: int = 1 << 21,
    gate_nats: float = 1e-10,
) -> AssociationSum:
    """Sum the weights of all associations; -inf is a weight of zero.

    Pairs are left out (gated) as long as that takes no more than `gate_nats` off the logarithm. What
    remains falls into connected components, each of which is summed exactly where that takes at most
    `max_states` numbers. A larger one is gated again, up to 0.1 nats; what is too large even then is
    summed over its `k` best associations. The interval of the result holds what either may have missed. A
    component without any possible association makes the sum zero; its probabilities are then those of the
    association with fewest impossible members.

    Raises `InputError` for weights that are NaN or infinite, naming them.
    """
    _check("pair (detection, object)", log_pair)
    _check("absent detection", log_absent)
    _check("background object", log_background)
    return _sum_gated(log_pair, log_absent, log_background, k, max_states, gate_nats)


def _sum_gated(
    log_pair: Float[ndarray, "M N"],
    log_absent: Float[ndarray, "M"],
    log_background: Float[ndarray, "N"],
    k: int,
    max_states: int,
    gate_nats: float,
) -> AssociationSum:
    """Gate, and sum every component; one that is too large is gated again, less strictly."""
    kept, lost_nats = _gate(log_pair, log_absent, log_background, gate_nats)
    log_kept = np.where(kept, log_pair, -np.inf)
    alone, unpaired = ~kept.any(1), ~kept.any(0)
    lower = upper = float(log_absent[alone].sum() + log_background[unpaired].sum())
    pair, best = np.zeros(log_pair.shape), np.full(len(log_background), -1)
    bad_detections, bad_objects = alone & (log_absent == -np.inf), unpaired & (log_background == -np.inf)
    for i, j in _components(kept):
        here = np.ix_(i, j)
        scene = log_kept[here], log_absent[i], log_background[j]
        if is_small(len(i), len(j), max_states) or gate_nats * _COARSER > _COARSEST_NATS:
            part = _sum_whole(*scene, k, max_states)
        else:
            part = _sum_gated(*scene, k, max_states, gate_nats * _COARSER)
        lower, upper = lower + part.log_lower, upper + part.log_upper
        pair[here] = part.pair
        best[j] = np.where(part.best < 0, -1, i[part.best])
        bad_detections[i[part.impossible_detections]] = True
        bad_objects[j[part.impossible_objects]] = True
    impossible = np.flatnonzero(bad_detections), np.flatnonzero(bad_objects)
    return AssociationSum(lower, upper + lost_nats, pair, best, *impossible)


def _sum_whole(
    log_pair: Float[ndarray, "M N"],
    log_absent: Float[ndarray, "M"],
    log_background: Float[ndarray, "N"],
    k: int,
    max_states: int,
) -> AssociationSum:
    """Sum one component with whichever are fewer as rows."""
    if len(log_absent) <= len(log_background):
        part = sum_component(log_pair, log_absent, log_background, k, max_states)
        best = np.full(len(log_background), -1)
        best[part.column[part.column >= 0]] = np.flatnonzero(part.column >= 0)
        pair, bad_detections, bad_objects = part.pair, part.bad_rows, part.bad_columns
    else:
        part = sum_component(log_pair.T, log_background, log_absent, k, max_states)
        pair, best, bad_detections, bad_objects = part.pair.T, part.column, part.bad_columns, part.bad_rows
    impossible = np.flatnonzero(bad_detections), np.flatnonzero(bad_objects)
    return AssociationSum(part.log_lower, part.log_upper, pair, best, *impossible)


def _check(name: str, log_weight: Float[ndarray, "..."]) -> None:
    wrong = np.argwhere(~(log_weight < np.inf))
    if len(wrong):
        where = tuple(wrong[0].tolist())
        raise InputError(f"weight of {name} {where} is {log_weight[where]}: it must be finite, or zero")


def _gate(
    log_pair: Float[ndarray, "M N"],
    log_absent: Float[ndarray, "M"],
    log_background: Float[ndarray, "N"],
    budget_nats: float,
) -> tuple[Bool[ndarray, "M N"], float]:
    """Pairs that are kept, and a bound on what the others add to the logarithm of the sum.

    An association without its left-out pairs is one of those that stay; each pair put back multiplies its
    weight by the pair's odds against being absent and background. Hence sum ≤ (sum of those that stay) ·
    Π_j (1 + Σ_i odds_ij), over the pairs left out. Prices decide where odds are infinite: at certain
    detections and objects without background.
    """
    with np.errstate(invalid="ignore"):
        log_odds = log_pair - log_absent[:, None] - log_background
    log_odds[log_pair == -np.inf] = -np.inf
    kept = log_odds > np.log(0.5 * budget_nats / max(log_odds.size, 1))
    left_out = np.exp(np.where(kept, -np.inf, log_odds))
    lost_nats = float(np.log1p(left_out.sum(0)).sum())
    if (log_odds == np.inf).any():
        log_kept = np.where(kept, log_pair, -np.inf)
        kept, more_nats = gate_by_price(log_kept, log_absent, log_background, 0.5 * budget_nats)
        lost_nats += more_nats
    return kept, lost_nats


def _components(kept: Bool[ndarray, "M N"]) -> list[tuple[Int[ndarray, "_"], Int[ndarray, "_"]]]:
    """Detections and objects of each connected component that has a pair."""
    m, n = kept.shape
    i, j = np.nonzero(kept)
    graph = coo_array((np.ones(len(i), np.int8), (i, j + m)), shape=(m + n, m + n))
    count, label = connected_components(graph, directed=False)
    by_label = np.split(np.argsort(label, kind="stable"), np.bincount(label, minlength=count).cumsum()[:-1])
    return [(group[group < m], group[group >= m] - m) for group in by_label if len(group) > 1]
