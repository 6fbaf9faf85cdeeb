"""The sum over all associations of detections with objects: exact in small components, bounded in large ones.

An association pairs some detections with one object each. The other detections are absent, and the other
objects belong to the background. Its weight is the product of the weights of all pairs, absent detections and
background objects (PMB density, thesis eq. 3.10-3.12, where each summand is one association).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from foredrive.errors import InputError
from foredrive.sets.assignment import RankedAssignments, k_best_assignments
from foredrive.sets.component import Components, Scaled, find_components, scale, sum_components, turn_costs
from foredrive.sets.frontier import list_true
from foredrive.sets.gating import bound_left_out, gate, thin

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")
_ROUNDS, _CHEAPEST = 50, 1e-100


class Interval(NamedTuple):
    """An interval [`log_lower`, `log_upper`] that contains the logarithm of a sum."""

    log_lower: float
    log_upper: float
    share: Float[ndarray, "R C"]
    """Probability of each pair, given that one of the summed associations is true."""
    best: Int[ndarray, "C"]
    """Row of each column in the most likely association; -1 if it has none."""


def bound_component(scaled: Scaled, k: int) -> Interval:
    """Bound the sum from below by the `k` best associations and from above by independent choices.

    At least one association must be possible.
    """
    rows, columns = scaled.log_pair.shape
    # Weights relative to the best association, so that they do not underflow
    column, cost = _k_best(scaled, k)
    weight = np.exp(cost[0] - cost)
    # Associations with an impossible member weigh nothing
    weight *= ~((column < 0) & (scaled.row_alone == 0)).any(1)
    for c in np.flatnonzero(scaled.column_alone == 0):
        weight *= (column == c).any(1)
    # Share of each pair: the weights of the associations that contain it
    share = np.zeros((rows, columns))
    which, row = np.nonzero(column >= 0)
    np.add.at(share, (row, column[which, row]), weight[which] / weight.sum())
    best = np.full(columns + 1, -1)
    best[scaled.column] = np.arange(rows)
    log_lower = scaled.log_best + float(np.log(weight.sum()))
    # All associations have been listed: the sum is exact
    if len(weight) < k:
        return Interval(log_lower, log_lower, share, best[:columns])
    return Interval(log_lower, max(log_lower, bound_choices(scaled)), share, best[:columns])


def bound_choices(scaled: Scaled) -> float:
    """Return an upper bound of the logarithm of the sum: the smaller `choice_bound` of rows and columns."""
    pair = np.exp(scaled.log_pair)
    by_row = choice_bound(pair, scaled.row_alone, scaled.column_alone)
    by_column = choice_bound(np.ascontiguousarray(pair.T), scaled.column_alone, scaled.row_alone)
    return scaled.log_best + min(by_row, by_column)


def _k_best(scaled: Scaled, k: int) -> RankedAssignments:
    """Rank the `k` best assignments, with the smaller side as rows of the problem.

    The costs are those of the untransposed problem, up to a constant.
    """
    rows, columns = scaled.log_pair.shape
    # More rows than columns: solve the transposed problem and turn the result back
    if rows <= columns:
        return k_best_assignments(scaled.cost, scaled.free, k)
    turned_cost, turned_free = turn_costs(scaled.cost, scaled.free, scaled.column_free)
    turned = k_best_assignments(turned_cost, turned_free, k)
    column = np.full((len(turned.cost), rows), -1)
    which, c = np.nonzero(turned.column >= 0)
    column[which, turned.column[which, c]] = c
    return RankedAssignments(column, turned.cost)


@_kernel
@no_type_check
def choice_bound(
    pair: Float[ndarray, "R C"], row_alone: Float[ndarray, "R"], column_alone: Float[ndarray, "C"]
) -> float:
    """Return an upper bound of the logarithm of the sum over assignments.

    The weights are as in `sum_assignments` and at most 1. Give every column j a cost c_j ≥ its alone weight,
    and let the rows choose independently. This includes every assignment, so the sum is at most Π_j c_j Π_i
    (alone_i + Σ_j pair_ij / c_j). The bound is smallest when each column is chosen once on average.
    Sinkhorn's iteration converges to these costs.
    """
    # Lists of the possible columns of each row: the matrix is sparse
    column, start = list_true(pair > 0.0)
    cost, log_smallest = np.ones(pair.shape[1]), np.inf
    for _ in range(_ROUNDS):
        # log of Π_j c_j Π_i (alone_i + Σ_j pair_ij / c_j)
        log_bound = np.log(cost).sum()
        chosen = np.zeros(pair.shape[1])
        for r in range(len(pair)):
            choices = column[start[r] : start[r + 1]]
            total = row_alone[r]
            for c in choices:
                total += pair[r, c] / cost[c]
            log_bound += np.log(total)
            # Mean number of rows that choose the column
            for c in choices:
                chosen[c] += pair[r, c] / cost[c] / total
        log_smallest = min(log_smallest, log_bound)
        # Sinkhorn step: raise the cost of a column that is chosen more than once on average.
        cost = np.maximum(np.maximum(column_alone, cost * chosen), _CHEAPEST)
    return log_smallest


_THINNING_NATS = (1e-6, 1e-4, 1e-2, 0.1, 1.0, 10.0)
"""Steps of the thinning of a large component: limit of the loss in nats, until the component can be summed.
"""
_LOOSE_NATS = 1.0
"""Width in nats of an interval from which a second upper bound is computed."""


@dataclass(frozen=True)
class AssociationSum:
    """The logarithm of the sum over associations, as an interval, and the distribution over associations."""

    log_lower: float
    """Logarithm of the weights that were summed; -inf if no association is possible."""
    log_upper: float
    """Proven upper bound of the logarithm of the sum."""
    detection: Int[ndarray, "E"]
    """Detection of each pair with a probability above 0. All other pairs have probability 0."""
    object: Int[ndarray, "E"]
    """Object of each of these pairs."""
    probability: Float[ndarray, "E"]
    """Probability that the pair belongs together."""
    absent: Float[ndarray, "M"]
    """Probability that a detection has no object."""
    background: Float[ndarray, "N"]
    """Probability that an object has no detection."""
    best: Int[ndarray, "N"]
    """Detection of each object in the most likely association; -1 for background."""
    impossible_detections: Int[ndarray, "_"]
    """Certain detections without an object, in the association with the fewest impossible members."""
    impossible_objects: Int[ndarray, "_"]
    """Objects without a detection that the background cannot explain, in the same association."""

    @property
    def pair(self) -> Float[ndarray, "M N"]:
        """Return the probability that detection i and object j belong together."""
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
    """Sum the weights of all associations. -inf is the logarithm of a zero weight.

    First, unlikely pairs are left out (gating), at a loss of at most `gate_nats` in the logarithm. The
    remaining pairs form connected components. A component is summed exactly if that takes at most
    `max_states` numbers. From a larger component, the least likely pairs are left out step by step until its
    parts can be summed. A part that still cannot be summed contributes its `k` best associations. The
    interval of the result contains everything that was left out. If a component has no possible association,
    the sum is zero; the probabilities are then those of the association with the fewest impossible members.

    Raises:
        InputError: a weight is NaN or infinite (the message names it), or `k` is below 1.
    """
    if k < 1:
        raise InputError(f"k is {k}: at least the best association must be listed")
    log_pair, log_absent, log_background = (
        np.ascontiguousarray(log, dtype=np.float64) for log in (log_pair, log_absent, log_background)
    )
    _check("pair (detection, object)", log_pair)
    _check("absent detection", log_absent)
    _check("background object", log_background)
    # Leave out what cannot matter, then sum the components of what is left
    row, column, lost_nats = gate(log_pair, log_absent, log_background, gate_nats)
    sum_large = partial(_sum_large, k=k, max_states=max_states)
    sums = _sum_kept(log_pair, log_absent, log_background, row, column, max_states, sum_large)
    return AssociationSum(
        # Alone is what no pair accounts for; rounding may leave the range
        sums.log_lower, sums.log_upper + lost_nats, sums.row, sums.column, sums.share,
        np.clip(1.0 - np.bincount(sums.row, sums.share, len(log_absent)), 0.0, 1.0),
        np.clip(1.0 - np.bincount(sums.column, sums.share, len(log_background)), 0.0, 1.0),
        sums.best, np.flatnonzero(sums.bad_rows), np.flatnonzero(sums.bad_columns),
    )  # fmt: skip


@dataclass
class _Found:
    """Result for a scene or a part of it. Rows are detections, columns are objects."""

    log_lower: float
    log_upper: float
    """Bounds of the logarithm of the sum over associations of kept pairs."""
    row: Int[ndarray, "E"]
    """Row of each kept pair."""
    column: Int[ndarray, "E"]
    share: Float[ndarray, "E"]
    log_freed: Float[ndarray, "C"]
    """Upper bound of log(sum without the column / sum), for each column."""
    best: Int[ndarray, "C"]
    bad_rows: Bool[ndarray, "R"]
    bad_columns: Bool[ndarray, "C"]


def _sum_kept(
    log_pair: Float[ndarray, "R C"],
    log_row: Float[ndarray, "R"],
    log_column: Float[ndarray, "C"],
    row: Int[ndarray, "E"],
    column: Int[ndarray, "E"],
    max_states: int,
    sum_large: Callable[[ndarray, ndarray, ndarray], _Found],
) -> _Found:
    """Sum every component of the kept pairs. `sum_large` handles components that are too large."""
    components = find_components(row, column, len(log_row), len(log_column))
    log_edge = log_pair[row, column]
    exact = sum_components(components, row, column, log_edge, log_row, log_column, max_states)
    sums = _Found(
        exact.log_sum, exact.log_sum, row, column, exact.share, exact.log_freed, exact.best,
        exact.bad_rows, exact.bad_columns,
    )  # fmt: skip
    if len(exact.too_large) == 0:
        return sums
    parts, summed = [], np.ones(len(row), bool)
    # Components that were too large to be summed: a dense matrix of each one
    for n in exact.too_large:
        i, j, edge = _members(components, n)
        here = np.full((len(i), len(j)), -np.inf)
        here[np.searchsorted(i, row[edge]), np.searchsorted(j, column[edge])] = log_edge[edge]
        part = sum_large(here, log_row[i], log_column[j])
        sums.log_lower += part.log_lower
        sums.log_upper += part.log_upper
        # Indices of the part become those of the whole
        sums.best[j] = np.where(part.best < 0, -1, i[part.best])
        sums.log_freed[j] = part.log_freed
        summed[edge] = False
        parts.append((i[part.row], j[part.column], part.share))
    # Pairs that were summed exactly, and those kept in the large components
    sums.row, sums.column, sums.share = (
        np.concatenate(arguments)
        for arguments in zip((row[summed], column[summed], exact.share[summed]), *parts, strict=True)
    )
    return sums


def _members(
    components: Components, n: np.integer
) -> tuple[Int[ndarray, "_"], Int[ndarray, "_"], Int[ndarray, "_"]]:
    """Return the rows, columns and edges of component `n`."""
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
) -> _Found:
    """Sum a subset of the pairs of a component that is too large, and bound the contribution of the rest."""
    sums = _sum_thinned(log_pair, log_row, log_column, k, max_states, _THINNING_NATS)
    # Pairs left out by the thinning: bound their contribution
    left_out = log_pair > -np.inf
    left_out[sums.row, sums.column] = False
    row, column = np.nonzero(left_out)
    alone = log_row[row] > -np.inf  # thinning keeps all pairs of rows that cannot be alone
    log_weight = np.full(len(row), np.inf)
    log_weight[alone] = (log_pair[row, column] + sums.log_freed[column])[alone] - log_row[row][alone]
    sums.log_upper += bound_left_out(log_weight, row, column)
    # A wide interval may have a better bound from independent choices
    if sums.log_upper - sums.log_lower > _LOOSE_NATS:
        sums.log_upper = min(sums.log_upper, bound_choices(scale(log_pair, log_row, log_column)))
    return sums


def _sum_thinned(
    log_pair: Float[ndarray, "R C"],
    log_row: Float[ndarray, "R"],
    log_column: Float[ndarray, "C"],
    k: int,
    max_states: int,
    thinning_nats: tuple[float, ...],
) -> _Found:
    """Leave out pairs until the rest can be summed. If it never can, sum the k best associations."""
    # Thin more and more; what cannot be summed even then is bounded
    scaled = scale(log_pair, log_row, log_column)
    if thinning_nats:
        row, column = thin(scaled, thinning_nats[0])
        sum_large = partial(_sum_thinned, k=k, max_states=max_states, thinning_nats=thinning_nats[1:])
        return _sum_kept(log_pair, log_row, log_column, row, column, max_states, sum_large)
    interval = bound_component(scaled, k)
    row, column = np.nonzero(log_pair > -np.inf)
    return _Found(
        interval.log_lower, interval.log_upper, row, column, interval.share[row, column], -log_column,
        interval.best, np.zeros(len(log_row), bool), np.zeros(len(log_column), bool),
    )  # fmt: skip


def _check(name: str, log_weight: Float[ndarray, "..."]) -> None:
    valid = log_weight < np.inf
    if not valid.all():
        where = tuple(np.argwhere(~valid)[0].tolist())
        raise InputError(f"weight of {name} {where} is {log_weight[where]}: it must be finite, or zero")
