"""Selection of the pairs that matter in a sum over associations, with bounds on the others."""

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
    """Return the kept pairs, and a bound on the contribution of the others to the logarithm of the sum.

    Removing the left-out pairs of an association gives an association of kept pairs. Adding such a pair back
    multiplies its weight by the odds of the pair against "absent and background". Hence sum ≤ (sum over kept
    pairs) · Π_j (1 + Σ_i odds_ij), over the left-out pairs. Odds are infinite for certain detections and for
    objects without background. There, prices decide instead (see `_prices`).
    """
    # Infinite odds need the second test by prices
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
    """Leave out the pairs with the smallest odds, at a total loss within the budget.

    Return the kept pairs and the loss in nats. Pairs with odds of at least 1 are always kept. The pairs left
    out are in no best association.
    """
    # Pairs with odds below half the budget over their number can all be left out
    log_min_odds = np.log(0.5 * budget_nats / max(log_pair.size, 1))
    row, column, log_odds, lost_nats = _list_odds(log_pair, log_row, log_column, log_min_odds)
    # Of the rest, leave out the least likely ones as far as the other half of the budget goes
    unlikely = np.flatnonzero(log_odds < 0.0)
    unlikely = unlikely[np.argsort(log_odds[unlikely])]
    total = np.cumsum(np.exp(log_odds[unlikely]))
    left_out = total <= 0.5 * budget_nats
    kept = np.ones(len(row), bool)
    kept[unlikely[left_out]] = False
    return row[kept], column[kept], lost_nats + float(total[left_out].max(initial=0.0))


@_kernel
@no_type_check
def _list_odds(log_pair, log_row, log_column, log_min_odds):
    """List the pairs with log-odds above `log_min_odds`.

    Return their rows, columns and log-odds, and a bound on the contribution of the other pairs to the
    logarithm.
    """
    rows, columns = log_pair.shape
    row, column = np.empty(rows * columns, np.int64), np.empty(rows * columns, np.int64)
    odds, count, lost = np.empty(rows * columns), 0, np.zeros(columns)
    for r in range(rows):
        for c in range(columns):
            if log_pair[r, c] == -np.inf:
                continue
            # Odds of the pair against both members being alone
            log_odds = log_pair[r, c] - log_row[r] - log_column[c]
            if log_odds > log_min_odds:
                row[count], column[count], odds[count], count = r, c, log_odds, count + 1
            elif log_odds > log_min_odds - _NEGLIGIBLE_NATS:
                # Tiny odds are bounded together below; the others are added up by column
                lost[c] += np.exp(log_odds)
    lost += rows * np.exp(log_min_odds - _NEGLIGIBLE_NATS)
    return row[:count].copy(), column[:count].copy(), odds[:count].copy(), np.log1p(lost).sum()


@_kernel
@no_type_check
def _prices(scaled):
    """Return log-prices by row and by column. They bound the weight of all associations with a pair.

    This weight is at most the weight of the pair times the product, over the other rows (or columns), of the
    sum of all their choices, each made independently. The best association weighs 1, so its pairs are always
    kept.
    """
    rows, columns = scaled.log_pair.shape
    # Every choice is at most 1; pairs too small to matter are bounded by their number
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
    # The smaller of both bounds: independent choices of the rows, or of the columns
    if by_row.sum() <= by_column.sum():
        return by_row - by_row.sum(), np.zeros(columns)
    return np.zeros(rows), by_column - by_column.sum()


def thin(scaled: Scaled, limit_nats: float) -> tuple[Int[ndarray, "E"], Int[ndarray, "E"]]:
    """Return the pairs to keep when about `limit_nats` may be lost, by an estimate of `bound_left_out`.

    The pairs of the best association and of rows that cannot be alone are always kept.
    """
    # Keep the pairs with the largest charges; the others add up to at most the limit
    row, column, charge = _estimate_charges(np.exp(scaled.log_pair), scaled.row_alone, scaled.column_alone)
    order = np.argsort(charge)
    kept = np.empty(len(row), bool)
    kept[order] = np.cumsum(charge[order]) > limit_nats
    kept |= (scaled.column[row] == column) | (scaled.row_alone[row] == 0)
    return row[kept], column[kept]


@_kernel
@no_type_check
def _estimate_charges(pair, row_alone, column_alone):
    """Return the possible pairs and an estimate of the term of each in `bound_left_out`.

    The estimate comes from belief propagation, which is exact on trees.
    """
    row, column = np.nonzero(pair)
    weight, to_column, to_row = np.empty(len(row)), np.empty(len(row)), np.zeros(len(row))
    for e in range(len(row)):
        weight[e] = pair[row[e], column[e]]

    # The message along a pair is its weight over the sum of all other choices of the sending node. `total` is
    # the sum of all choices of a node, so that of the others is `total` less the message from the other end.
    # Rounding could make it smaller than the choice of being alone, which is always among them.
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
    # 1 / total of the column estimates (sum without the column) / sum.
    charge = np.empty(len(row))
    for e in range(len(row)):
        charge[e] = weight[e] / max(row_alone[row[e]], _TINY) / max(total[column[e]], _TINY)
    return row, column, charge


def bound_left_out(
    log_weight: Float[ndarray, "E"], row: Int[ndarray, "E"], column: Int[ndarray, "E"]
) -> float:
    """Bound the contribution of left-out pairs to the logarithm of a sum, from above.

    `log_weight` is the logarithm of (weight of the pair / weight of the row alone) · (sum without the column
    / sum).

    Let S be the sum over the kept pairs. Consider associations with left-out pairs between rows I and columns
    J. Their weight is that of these pairs times S without I and J. With the rows of I alone, S without I and
    J is a part of S without J. So all of them together weigh at most Σ Π_pairs (w_ij / alone_i) · (S without
    J).

    For two columns, (S without both) · S ≤ product of S without each: the difference is a sum of squares over
    the paths between the columns, with positive sign if the paths have an even number of edges (Heilmann and
    Lieb 1972). Hence (S without J) / S is at most the product of this ratio for each column of J. The whole
    is at most the product of 1 + Σ over columns, or over rows.
    """
    with np.errstate(over="ignore"):
        weight = np.exp(log_weight)
    # Π (1 + Σ) over the columns, or over the rows; the smaller one is the bound
    return float(min(np.log1p(np.bincount(index, weight)).sum() for index in (row, column)))
