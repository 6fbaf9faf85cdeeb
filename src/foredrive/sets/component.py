"""The sum over all associations within one connected component."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from foredrive.sets.assignment import best_assignment, k_best_assignments
from foredrive.sets.subsets import sum_assignments


class Part(NamedTuple):
    """Sum over associations of rows with columns; see `AssociationSum` for what the fields mean."""

    log_lower: float
    log_upper: float
    pair: Float[ndarray, "R C"]
    column: Int[ndarray, "R"]
    bad_rows: Bool[ndarray, "R"]
    bad_columns: Bool[ndarray, "C"]


def sum_component(
    log_pair: Float[ndarray, "R C"],
    log_row: Float[ndarray, "R"],
    log_column: Float[ndarray, "C"],
    k: int,
    max_states: int,
) -> Part:
    """Sum exactly if that takes at most `max_states` numbers, else over the `k` best associations.

    Fastest where there are no more rows than columns.
    """
    no_row, no_column = log_row == -np.inf, log_column == -np.inf
    price = _price_of_the_impossible(log_pair, log_row, log_column)
    column_cost = np.where(no_column, price, -log_column)
    cost = -log_pair - column_cost
    free = np.where(no_row, price, -log_row)
    column, row_price, column_price = best_assignment(cost, free)
    paired = np.zeros(log_pair.shape, bool)
    paired[np.flatnonzero(column >= 0), column[column >= 0]] = True
    bad_rows, bad_columns = no_row & ~paired.any(1), no_column & ~paired.any(0)
    if bad_rows.any() or bad_columns.any():
        return Part(-np.inf, -np.inf, paired.astype(float), column, bad_rows, bad_columns)
    log_best = float(log_pair[paired].sum() + log_row[column < 0].sum() + log_column[~paired.any(0)].sum())

    # With the prices, the best association weighs 1 and no factor of any is larger.
    pair_weight = np.exp(row_price[:, None] + column_price - cost)
    row_weight = np.where(no_row, 0.0, np.exp(row_price - free))
    column_weight = np.where(no_column, 0.0, np.exp(column_price))
    if is_small(len(log_row), len(log_column), max_states):
        total, share = sum_assignments(pair_weight.T, column_weight, row_weight)
        log_sum = log_best + float(np.log(total))
        return Part(log_sum, log_sum, share.T, column, bad_rows, bad_columns)

    ranked = k_best_assignments(cost, free, k)
    has = ranked.column[..., None] == np.arange(len(log_column))  # [k R C]
    possible = ~(no_row & ~has.any(2)).any(1) & ~(no_column & ~has.any(1)).any(1)
    weight = np.where(possible, np.exp(ranked.cost[0] - ranked.cost), 0.0)
    total = weight.sum()
    log_sum = log_best + float(np.log(total))
    # Rows that choose without regard to each other: no association is left out, but some have a column twice.
    by_rows = np.log(row_weight + pair_weight.sum(1)).sum()
    by_columns = np.log(column_weight + pair_weight.sum(0)).sum()
    log_upper = log_sum if len(weight) < k else log_best + float(min(by_rows, by_columns))
    return Part(log_sum, log_upper, np.tensordot(weight / total, has, 1), column, bad_rows, bad_columns)


def _price_of_the_impossible(
    log_pair: Float[ndarray, "R C"], log_row: Float[ndarray, "R"], log_column: Float[ndarray, "C"]
) -> float:
    """A finite cost in place of infinity that outweighs whatever could be gained by paying it."""
    every = np.concatenate([log_pair, log_row[:, None]], axis=1)
    largest = np.abs(np.where(every == -np.inf, 0.0, every)).max(1).sum()
    return float(1.0 + 2.0 * (largest + np.abs(np.where(log_column == -np.inf, 0.0, log_column)).sum()))


def is_small(rows: int, columns: int, max_states: int) -> bool:
    """Whether a component is summed exactly: subsets of the fewer, for each of the others."""
    return (max(rows, columns) + 1) << min(rows, columns, 62) <= max_states
