"""Bounds for the sum over all associations of a component that is too large to be summed exactly."""

from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from foredrive.sets.assignment import RankedAssignments, k_best_assignments
from foredrive.sets.component import Scaled, turn_costs
from foredrive.sets.frontier import list_true

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
    column, cost = _k_best(scaled, k)
    weight = np.exp(cost[0] - cost)
    weight *= ~((column < 0) & (scaled.row_alone == 0)).any(1)
    for c in np.flatnonzero(scaled.column_alone == 0):
        weight *= (column == c).any(1)
    share = np.zeros((rows, columns))
    which, row = np.nonzero(column >= 0)
    np.add.at(share, (row, column[which, row]), weight[which] / weight.sum())
    best = np.full(columns + 1, -1)
    best[scaled.column] = np.arange(rows)
    log_lower = scaled.log_best + float(np.log(weight.sum()))
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
    column, start = list_true(pair > 0.0)
    cost, log_smallest = np.ones(pair.shape[1]), np.inf
    for _ in range(_ROUNDS):
        log_bound = np.log(cost).sum()
        chosen = np.zeros(pair.shape[1])
        for r in range(len(pair)):
            choices = column[start[r] : start[r + 1]]
            total = row_alone[r]
            for c in choices:
                total += pair[r, c] / cost[c]
            log_bound += np.log(total)
            for c in choices:
                chosen[c] += pair[r, c] / cost[c] / total
        log_smallest = min(log_smallest, log_bound)
        # Sinkhorn step: raise the cost of a column that is chosen more than once on average.
        cost = np.maximum(np.maximum(column_alone, cost * chosen), _CHEAPEST)
    return log_smallest
