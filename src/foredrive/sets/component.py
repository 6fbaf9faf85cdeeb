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
    scaled = _scale(log_pair, log_row, log_column)
    column, bad_rows, bad_columns = scaled.column, scaled.bad_rows, scaled.bad_columns
    has = column[:, None] == np.arange(len(log_column))
    if bad_rows.any() or bad_columns.any():
        return Part(-np.inf, -np.inf, has.astype(float), column, bad_rows, bad_columns)
    log_best = float(log_pair[has].sum() + log_row[column < 0].sum() + log_column[~has.any(0)].sum())
    if is_small(len(log_row), len(log_column), max_states):
        total, share = sum_assignments(scaled.pair.T, scaled.column_alone, scaled.row_alone)
        log_sum = log_best + float(np.log(total))
        return Part(log_sum, log_sum, share.T, column, bad_rows, bad_columns)
    ranked = k_best_assignments(scaled.cost, scaled.free, k)
    weight = np.exp(ranked.cost[0] - ranked.cost)
    weight *= ~((ranked.column < 0) & (log_row == -np.inf)).any(1)
    for c in np.flatnonzero(log_column == -np.inf):
        weight *= (ranked.column == c).any(1)
    pair = np.zeros(log_pair.shape)
    which, row = np.nonzero(ranked.column >= 0)
    np.add.at(pair, (row, ranked.column[which, row]), weight[which] / weight.sum())
    log_sum = log_best + float(np.log(weight.sum()))
    log_upper = (
        log_sum if len(weight) < k else log_best + float(min(log.sum() for log in scaled.log_totals()))
    )
    return Part(log_sum, log_upper, pair, column, bad_rows, bad_columns)


def gate_by_price(
    log_pair: Float[ndarray, "R C"],
    log_row: Float[ndarray, "R"],
    log_column: Float[ndarray, "C"],
    budget_nats: float,
) -> tuple[Bool[ndarray, "R C"], float]:
    """Pairs to keep so that the others add no more than the budget to the log of the sum; what they add.

    Scaled, the best association weighs 1 and is kept. All that have a given pair weigh no more than the pair
    times what the other rows (or columns) can choose from, each without regard to the rest. Nothing is left
    out where no association is possible.
    """
    scaled = _scale(log_pair, log_row, log_column)
    if scaled.bad_rows.any() or scaled.bad_columns.any():
        return log_pair > -np.inf, 0.0
    by_row, by_column = scaled.log_totals()
    log_share = scaled.log_pair + min(by_row.sum() - by_row[:, None], by_column.sum() - by_column, key=np.max)
    kept = log_share > np.log(budget_nats / max(log_pair.size, 1))
    return kept, float(np.log1p(np.exp(log_share[~kept]).sum()))


class _Scaled(NamedTuple):
    """Weights times such powers that the best association weighs 1 and no factor of any is larger."""

    cost: Float[ndarray, "R C"]
    free: Float[ndarray, "R"]
    """What `assignment` works on: the impossible has a finite price."""
    column: Int[ndarray, "R"]
    bad_rows: Bool[ndarray, "R"]
    bad_columns: Bool[ndarray, "C"]
    log_pair: Float[ndarray, "R C"]
    pair: Float[ndarray, "R C"]
    row_alone: Float[ndarray, "R"]
    column_alone: Float[ndarray, "C"]

    def log_totals(self) -> tuple[Float[ndarray, "R"], Float[ndarray, "C"]]:
        """What each row, and what each column, has to choose from.

        Rows that choose without regard to each other leave no association out, but have some columns twice:
        the product over all rows, or over all columns, bounds the sum over associations.
        """
        return np.log(self.row_alone + self.pair.sum(1)), np.log(self.column_alone + self.pair.sum(0))


def _scale(
    log_pair: Float[ndarray, "R C"], log_row: Float[ndarray, "R"], log_column: Float[ndarray, "C"]
) -> _Scaled:
    no_row, no_column = log_row == -np.inf, log_column == -np.inf
    price = _price_of_the_impossible(log_pair, log_row, log_column)
    cost = -log_pair - np.where(no_column, price, -log_column)
    free = np.where(no_row, price, -log_row)
    column, row_price, column_price = best_assignment(cost, free)
    taken = np.zeros(len(log_column), bool)
    taken[column[column >= 0]] = True
    log_scaled = np.minimum(row_price[:, None] + column_price - cost, 0.0)  # above 0 by rounding alone
    row_alone = np.where(no_row, 0.0, np.exp(row_price - free))
    column_alone = np.where(no_column, 0.0, np.exp(column_price))
    bad = no_row & (column < 0), no_column & ~taken
    return _Scaled(cost, free, column, *bad, log_scaled, np.exp(log_scaled), row_alone, column_alone)


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
