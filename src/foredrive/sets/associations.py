"""The sum over all associations of detections with objects: exact in small components, bounded elsewhere.

An association pairs some detections with one object each; the other detections are absent and the other
objects are background. Its weight is the product of what every pair, absent detection and background object
weighs (PMB density, thesis eq. 3.10-3.12, where each summand is one association).
"""

from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from foredrive.errors import InputError
from foredrive.sets.component import Components, find_components, scale, sum_components
from foredrive.sets.interval import bound_component

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")
_COARSER_NATS = (1e-7, 1e-4, 0.1, 1.0, 10.0)
"""What may be gated of components that are too large to be summed, until they are not."""
_NEGLIGIBLE_NATS = 40.0


@dataclass(frozen=True)
class AssociationSum:
    """Logarithm of the sum over associations, as an interval, and the distribution over associations."""

    log_lower: float
    """What was summed; -inf if no association is possible."""
    log_upper: float
    """No more than this was missed by gating and by listing only the best associations."""
    detection: Int[ndarray, "E"]
    """Detection of each pair that may belong together; all other pairs have probability 0."""
    object: Int[ndarray, "E"]
    """Object of each of these pairs."""
    probability: Float[ndarray, "E"]
    """That the pair belongs together."""
    absent: Float[ndarray, "M"]
    """Probability that a detection has no object."""
    background: Float[ndarray, "N"]
    """Probability that an object has no detection."""
    best: Int[ndarray, "N"]
    """Detection of each object in the most likely association; -1: background."""
    impossible_detections: Int[ndarray, "_"]
    """Detections that are certain and yet without an object, in the association with fewest such faults."""
    impossible_objects: Int[ndarray, "_"]
    """Objects that no detection and no background explains, in the same association."""

    @property
    def pair(self) -> Float[ndarray, "M N"]:
        """Probability that detection i and object j belong together."""
        pair = np.zeros((len(self.absent), len(self.background)))
        pair[self.detection, self.object] = self.probability
        return pair


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
    `max_states` numbers. A larger one is gated again, a little less strictly each time, up to 10 nats; what
    is too large even then is summed over its `k` best associations. The interval of the result holds what
    either may have missed. A component without any possible association makes the sum zero; its
    probabilities are then those of the association with fewest impossible members.

    Raises `InputError` for weights that are NaN or infinite, naming them.
    """
    log_pair, log_absent, log_background = (
        np.ascontiguousarray(log, dtype=np.float64) for log in (log_pair, log_absent, log_background)
    )
    _check("pair (detection, object)", log_pair)
    _check("absent detection", log_absent)
    _check("background object", log_background)
    found = _sum_gated(log_pair, log_absent, log_background, k, max_states, gate_nats)
    return AssociationSum(
        found.log_lower, found.log_upper, found.row, found.column, found.share,
        np.clip(1.0 - np.bincount(found.row, found.share, len(log_absent)), 0.0, 1.0),
        np.clip(1.0 - np.bincount(found.column, found.share, len(log_background)), 0.0, 1.0),
        found.best, np.flatnonzero(found.bad_rows), np.flatnonzero(found.bad_columns),
    )  # fmt: skip


@dataclass
class _Found:
    """What is known of a scene, or of a part of it; detections are rows, objects columns."""

    log_lower: float
    log_upper: float
    row: Int[ndarray, "E"]
    column: Int[ndarray, "E"]
    share: Float[ndarray, "E"]
    best: Int[ndarray, "C"]
    bad_rows: Bool[ndarray, "R"]
    bad_columns: Bool[ndarray, "C"]


def _sum_gated(
    log_pair: Float[ndarray, "R C"],
    log_row: Float[ndarray, "R"],
    log_column: Float[ndarray, "C"],
    k: int,
    max_states: int,
    gate_nats: float,
) -> _Found:
    """Gate, and sum every component; one that is too large is gated again, less strictly."""
    row, column, lost_nats = _gate(log_pair, log_row, log_column, gate_nats)
    components = find_components(row, column, len(log_row), len(log_column))
    log_edge = log_pair[row, column]
    exact = sum_components(components, row, column, log_edge, log_row, log_column, max_states)
    found = _Found(
        exact.log_sum, exact.log_sum + lost_nats, row, column, exact.share, exact.best,
        exact.bad_rows, exact.bad_columns,
    )  # fmt: skip
    for n in exact.too_large:
        i, j, edge = _members(components, n)
        here = np.full((len(i), len(j)), -np.inf)
        where = np.searchsorted(i, row[edge]), np.searchsorted(j, column[edge])
        here[where] = log_edge[edge]
        part = _sum_large(here, log_row[i], log_column[j], k, max_states, gate_nats)
        found.log_lower += part.log_lower
        found.log_upper += part.log_upper
        share = np.zeros(here.shape)
        share[part.row, part.column] = part.share
        found.share[edge] = share[where]
        found.best[j] = np.where(part.best < 0, -1, i[part.best])
    return found


def _members(
    components: Components, n: np.integer
) -> tuple[Int[ndarray, "_"], Int[ndarray, "_"], Int[ndarray, "_"]]:
    """Rows, columns and edges of a component."""
    return (
        components.row[slice(*components.row_start[n : n + 2])],
        components.column[slice(*components.column_start[n : n + 2])],
        components.edge[slice(*components.edge_start[n : n + 2])],
    )


def _sum_large(
    log_pair: Float[ndarray, "R C"],
    log_row: Float[ndarray, "R"],
    log_column: Float[ndarray, "C"],
    k: int,
    max_states: int,
    gate_nats: float,
) -> _Found:
    """Gate a component that is too large less strictly, or bound it."""
    for coarser_nats in _COARSER_NATS:
        if coarser_nats > gate_nats:
            return _sum_gated(log_pair, log_row, log_column, k, max_states, coarser_nats)
    interval = bound_component(scale(log_pair, log_row, log_column), k)
    row, column = np.nonzero(interval.share)
    return _Found(
        interval.log_lower, interval.log_upper, row, column, interval.share[row, column], interval.best,
        np.zeros(len(log_row), bool), np.zeros(len(log_column), bool),
    )  # fmt: skip


def _check(name: str, log_weight: Float[ndarray, "..."]) -> None:
    valid = log_weight < np.inf
    if not valid.all():
        where = tuple(np.argwhere(~valid)[0].tolist())
        raise InputError(f"weight of {name} {where} is {log_weight[where]}: it must be finite, or zero")


def _gate(
    log_pair: Float[ndarray, "R C"],
    log_row: Float[ndarray, "R"],
    log_column: Float[ndarray, "C"],
    budget_nats: float,
) -> tuple[Int[ndarray, "E"], Int[ndarray, "E"], float]:
    """Pairs that are kept, and a bound on what the others add to the logarithm of the sum.

    An association without its left-out pairs is one of those that stay; each pair put back multiplies its
    weight by the pair's odds against being absent and background. Hence sum ≤ (sum of those that stay) ·
    Π_j (1 + Σ_i odds_ij), over the pairs left out. Prices decide where odds are infinite: at certain
    detections and objects without background.
    """
    infinite = bool((log_row == -np.inf).any() or (log_column == -np.inf).any())
    by_odds = (0.5 if infinite else 1.0) * budget_nats
    row, column, log_odds, lost_nats = _list_odds(
        log_pair, log_row, log_column, np.log(0.5 * by_odds / max(log_pair.size, 1))
    )
    kept, more_nats = _keep_likely(log_odds, 0.5 * by_odds)
    row, column, lost_nats = row[kept], column[kept], lost_nats + more_nats
    if infinite:
        log_kept = np.full(log_pair.shape, -np.inf)
        log_kept[row, column] = log_pair[row, column]
        kept, more_nats = _gate_by_price(log_kept, log_row, log_column, row, column, 0.5 * budget_nats)
        row, column, lost_nats = row[kept], column[kept], lost_nats + more_nats
    return row, column, lost_nats


def _keep_likely(log_share: Float[ndarray, "E"], budget: float) -> tuple[Bool[ndarray, "E"], float]:
    """All but the least, as many as together are no more than the budget; what these add to the logarithm.

    None of at least 1 is left out: pairs whose odds are smaller are in no best association.
    """
    share = np.exp(np.minimum(log_share, 0.0))
    order = np.argsort(share)
    total = np.cumsum(share[order])
    out = order[(total <= budget) & (log_share[order] < 0.0)]
    kept = np.ones(len(share), bool)
    kept[out] = False
    return kept, float(share[out].sum())


@_kernel
@no_type_check
def _list_odds(log_pair, log_row, log_column, log_least):
    """Pairs of larger odds than the least, these, and what all others may add to the logarithm."""
    rows, columns = log_pair.shape
    row, column = np.empty(rows * columns, np.int64), np.empty(rows * columns, np.int64)
    odds, count, lost = np.empty(rows * columns), 0, np.zeros(columns)
    for r in range(rows):
        for c in range(columns):
            if log_pair[r, c] == -np.inf:
                continue
            log_odds = log_pair[r, c] - log_row[r] - log_column[c]
            if log_odds > log_least:
                row[count], column[count], odds[count], count = r, c, log_odds, count + 1
            elif log_odds > log_least - _NEGLIGIBLE_NATS:
                lost[c] += np.exp(log_odds)
    lost += rows * np.exp(log_least - _NEGLIGIBLE_NATS)
    return row[:count].copy(), column[:count].copy(), odds[:count].copy(), np.log1p(lost).sum()


def _gate_by_price(
    log_pair: Float[ndarray, "R C"],
    log_row: Float[ndarray, "R"],
    log_column: Float[ndarray, "C"],
    row: Int[ndarray, "E"],
    column: Int[ndarray, "E"],
    budget_nats: float,
) -> tuple[Bool[ndarray, "E"], float]:
    """Which of the pairs to keep so that the others add no more than the budget; what they add.

    Scaled, the best association weighs 1 and is kept. All that have a given pair weigh no more than the pair
    times what the other rows (or columns) can choose from, each without regard to the rest. Nothing is left
    out where no association is possible.
    """
    scaled = scale(log_pair, log_row, log_column)
    if scaled.log_best == -np.inf:
        return np.ones(len(row), bool), 0.0
    log_scaled = scaled.log_pair[row, column]
    pair = np.exp(log_scaled)
    by_row = np.log(scaled.row_alone + np.bincount(row, pair, len(log_row)))
    by_column = np.log(scaled.column_alone + np.bincount(column, pair, len(log_column)))
    of_rows, of_columns = by_row.sum() - by_row, by_column.sum() - by_column
    others = of_rows[row] if of_rows.max() <= of_columns.max() else of_columns[column]
    kept, lost = _keep_likely(log_scaled + others, budget_nats)
    has = scaled.column[row] == column
    return kept | has, float(np.log1p(lost))
