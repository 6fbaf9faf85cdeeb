"""Which pairs matter to a sum over associations, and what the others add to it at most."""

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from foredrive.sets.component import Scaled, scale

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")
_NEGLIGIBLE_NATS = 40.0
_ROUNDS, _TINY = 20, 1e-280


def gate(
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
    row, column, lost_nats = _keep_likely(log_pair, log_row, log_column, by_odds)
    if not infinite:
        return row, column, lost_nats
    log_kept = np.full(log_pair.shape, -np.inf)
    log_kept[row, column] = log_pair[row, column]
    scaled = scale(log_kept, log_row, log_column)
    if scaled.log_best == -np.inf:  # no association is possible
        return row, column, lost_nats
    row_price, column_price = _prices(scaled)
    row, column, more_nats = _keep_likely(scaled.log_pair, row_price, column_price, 0.5 * budget_nats)
    return row, column, lost_nats + more_nats


def _keep_likely(
    log_pair: Float[ndarray, "R C"],
    log_row: Float[ndarray, "R"],
    log_column: Float[ndarray, "C"],
    budget_nats: float,
) -> tuple[Int[ndarray, "E"], Int[ndarray, "E"], float]:
    """All pairs but those of least odds, which together are no more than the budget; what these add.

    None of odds of at least 1 is left out: others are in no best association.
    """
    log_least = np.log(0.5 * budget_nats / max(log_pair.size, 1))
    row, column, log_odds, lost_nats = _list_odds(log_pair, log_row, log_column, log_least)
    few = np.flatnonzero(log_odds < 0.0)
    few = few[np.argsort(log_odds[few])]
    total = np.cumsum(np.exp(log_odds[few]))
    out = total <= 0.5 * budget_nats
    kept = np.ones(len(row), bool)
    kept[few[out]] = False
    return row[kept], column[kept], lost_nats + float(total[out].max(initial=0.0))


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


@_kernel
@no_type_check
def _prices(scaled):
    """What to take off a scaled pair, by row and by column, to bound what all associations with it weigh.

    They weigh no more than the pair times what the other rows (or columns) can choose from, each without
    regard to the rest. The best association weighs 1, so that nothing of it is ever left out.
    """
    rows, columns = scaled.log_pair.shape
    by_row, by_column = scaled.row_alone.copy(), scaled.column_alone.copy()
    by_row += columns * np.exp(-_NEGLIGIBLE_NATS)
    by_column += rows * np.exp(-_NEGLIGIBLE_NATS)
    for r in range(rows):
        for c in range(columns):
            if scaled.log_pair[r, c] > -_NEGLIGIBLE_NATS:
                pair = np.exp(scaled.log_pair[r, c])
                by_row[r] += pair
                by_column[c] += pair
    by_row, by_column = np.log(by_row), np.log(by_column)
    if by_row.sum() <= by_column.sum():
        return by_row - by_row.sum(), np.zeros(columns)
    return np.zeros(rows), by_column - by_column.sum()


def thin(scaled: Scaled, limit_nats: float) -> tuple[Int[ndarray, "E"], Int[ndarray, "E"]]:
    """Pairs that are kept when about `limit_nats` may be lost, by what `bound_left_out` is likely to say.

    Kept are, whatever they weigh, those of the best association and of rows that cannot be alone.
    """
    row, column, charge = _estimate_charges(np.exp(scaled.log_pair), scaled.row_alone, scaled.column_alone)
    order = np.argsort(charge)
    kept = np.empty(len(row), bool)
    kept[order] = np.cumsum(charge[order]) > limit_nats
    kept |= (scaled.column[row] == column) | (scaled.row_alone[row] == 0)
    return row[kept], column[kept]


@_kernel
@no_type_check
def _estimate_charges(pair, row_alone, column_alone):
    """Possible pairs, and what `bound_left_out` charges for each, by belief propagation: exact on trees."""
    row, column = np.nonzero(pair)
    weight, to_column, to_row = np.empty(len(row)), np.empty(len(row)), np.zeros(len(row))
    for e in range(len(row)):
        weight[e] = pair[row[e], column[e]]
    for _ in range(_ROUNDS):
        total = row_alone.copy()
        for e in range(len(row)):
            total[row[e]] += to_row[e]
        for e in range(len(row)):
            others = max(total[row[e]] - to_row[e], row_alone[row[e]])
            to_column[e] = weight[e] / max(others, _TINY)
        total = column_alone.copy()
        for e in range(len(row)):
            total[column[e]] += to_column[e]
        for e in range(len(row)):
            others = max(total[column[e]] - to_column[e], column_alone[column[e]])
            to_row[e] = weight[e] / max(others, _TINY)
    charge = np.empty(len(row))
    for e in range(len(row)):
        charge[e] = weight[e] / max(row_alone[row[e]], _TINY) / max(total[column[e]], _TINY)
    return row, column, charge


def bound_left_out(
    log_weight: Float[ndarray, "E"], row: Int[ndarray, "E"], column: Int[ndarray, "E"]
) -> float:
    """What pairs that were left out add to the logarithm of a sum at most.

    `log_weight` is that of the pair, over the row's alone, times the sum without the column over the sum.

    Associations with left-out pairs of rows I and columns J weigh what these do times what is left, S without
    I and J. With I alone that is a part of S without J: all of them together are at most
    Σ Π_pairs (w_ij / alone_i) · (S without J). Of two columns, (S without both) · S is no more than the
    product of S without either: the difference is a sum over the paths between them of squares, positive
    where paths have an even number of edges (Heilmann and Lieb 1972). Hence (S without J) / S is at most the
    product over J of that of each column, and the whole at most that over columns, or rows, of 1 + Σ.
    """
    with np.errstate(over="ignore"):
        weight = np.exp(log_weight)
    return float(min(np.log1p(np.bincount(each, weight)).sum() for each in (row, column)))
