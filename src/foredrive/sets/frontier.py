"""The sum over all partial assignments of rows to columns, by dynamic programming over a moving frontier.

Rows are added one after the other. The frontier is the set of columns that both an added row and a later row
may take. Only for these columns the state must record whether they are taken: each has a bit, and a subset of
taken columns is an integer. Objects compete only for nearby detections, so the frontier stays narrow in large
scenes.
"""

from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")
_WIDEST, _CHEAP = 40, 1 << 10


class AssignmentTotals(NamedTuple):
    """The total weight of all assignments, and its parts. The parts are zero if the total is 0."""

    log_total: float
    pair: Float[ndarray, "R C"]
    """Share of the total in which the row takes the column."""
    row_freed: Float[ndarray, "R"]
    """(Total without the row) / total. Times the row's alone weight, it is the probability that the row is
    alone."""
    column_freed: Float[ndarray, "C"]


class Sweep(NamedTuple):
    """The order in which rows are added, and the bits that store the columns of the frontier.

    A column that no row may take has `first`, `last` and `slot` -1.
    """

    row: Int[ndarray, "R"]
    """Rows in the order in which they are added."""
    first: Int[ndarray, "C"]
    """Place in that order of the first row that may take the column."""
    last: Int[ndarray, "C"]
    """Place in that order of the last row that may take the column."""
    slot: Int[ndarray, "C"]
    """Bit that stores whether the column is taken. It is in use from the column's first row to its last."""
    size: Int[ndarray, "R"]
    """Number of subsets stored at each row."""
    states: int
    """Number of subsets stored over all rows."""


def sum_assignments(
    pair: Float[ndarray, "R C"], row_alone: Float[ndarray, "R"], column_alone: Float[ndarray, "C"]
) -> AssignmentTotals:
    """Sum, over all assignments, the product of the weights of pairs, rows alone and columns alone.

    All weights must be non-negative. The sum is exact. It needs as many numbers of memory as `plan_sweep`
    returns in `states`. Partial sums are stored relative to the largest one of their row. Very uneven weights
    would underflow; scaling by the prices of the best assignment prevents that.
    """
    pair, row_alone, column_alone = (
        np.ascontiguousarray(w, dtype=np.float64) for w in (pair, row_alone, column_alone)
    )
    return sum_sweep(pair, row_alone, column_alone, plan_sweep(pair > 0, np.iinfo(np.int64).max))


@_kernel
@no_type_check
def plan_sweep(possible: Bool[ndarray, "R C"], max_states: int) -> Sweep:
    """Plan a sweep from row 0, or from the row where that sweep ends if this needs fewer numbers.

    `states` is the number of values. If it exceeds `max_states`, the plan is incomplete and must not be used.
    """
    column, start = list_true(possible)
    row, row_start = list_true(np.ascontiguousarray(possible.T))
    # Start at row 0; from the row where this sweep ends, another may be narrower
    sweep = _plan_from(np.int64(0), column, start, row, row_start, max_states)
    if sweep.states <= _CHEAP:
        return sweep
    again = _plan_from(sweep.row[-1], column, start, row, row_start, max_states)
    return sweep if sweep.states <= again.states else again


@_kernel
@no_type_check
def list_true(mask):
    """Return the column indices of the true entries, row by row, and the start of each row in that list."""
    rows, columns = mask.shape
    start, count = np.zeros(rows + 1, np.int64), 0
    column = np.empty(mask.sum(), np.int64)
    for r in range(rows):
        for c in range(columns):
            if mask[r, c]:
                column[count], count = c, count + 1
        start[r + 1] = count
    return column, start


@_kernel
@no_type_check
def _plan_from(next_row, column, start, row, row_start, max_states):
    """Plan greedily: of the rows that touch the frontier, add the one that widens it least."""
    rows, columns = len(start) - 1, len(row_start) - 1
    order, size, states = np.empty(rows, np.int64), np.zeros(rows, np.int64), 0
    first, last, slot = np.full(columns, -1), np.full(columns, -1), np.full(columns, -1)
    added, user = np.zeros(rows, np.bool_), np.full(_WIDEST, -1)  # the column that uses each bit; -1: none
    waiting = row_start[1:] - row_start[:-1]  # rows that may take the column and are not added yet
    unseen = 0  # all rows before it are added
    for place in range(rows):
        order[place], added[next_row] = next_row, True
        choices = column[start[next_row] : start[next_row + 1]]
        for c in choices:
            # A column that is seen for the first time gets the lowest free bit.
            if first[c] < 0:
                free = 0
                while free < _WIDEST - 1 and user[free] >= 0:
                    free += 1
                first[c], slot[c], user[free] = place, free, c
        # The subsets are indexed by all bits up to the highest bit in use.
        top = -1
        for bit in range(_WIDEST):
            if user[bit] >= 0:
                top = bit
        size[place] = 1 << (top + 1)
        states += size[place]
        # After the last row of a column its bit is free again.
        for c in choices:
            waiting[c] -= 1
            if waiting[c] == 0:
                last[c], user[slot[c]] = place, -1
        # Too large: stop. The last row added is stored at the end, where `plan_sweep` reads it.
        if states > max_states:
            order[-1] = next_row
            break
        next_row, smallest = -1, np.iinfo(np.int64).max
        for bit in range(top + 1):
            if user[bit] < 0:
                continue
            for r in row[row_start[user[bit]] : row_start[user[bit] + 1]]:
                if added[r]:
                    continue
                # Score of row r: +2 for each column that it adds to the frontier, -1 for each that it closes.
                wider = 0
                for c in column[start[r] : start[r + 1]]:
                    wider += 2 * (first[c] < 0) - (waiting[c] == 1)
                if wider < smallest or (wider == smallest and r < next_row):
                    next_row, smallest = r, wider
        if next_row < 0:  # the frontier is empty: continue with the next component
            while unseen < rows and added[unseen]:
                unseen += 1
            next_row = unseen
    return Sweep(order, first, last, slot, size, states)


@_kernel
@no_type_check
def sum_sweep(pair, row_alone, column_alone, sweep):
    """Sweep forward and back over the rows. The products of both sweeps give the share of each pair."""
    # Offset of each row's subsets in one flat array
    start = np.zeros(len(pair) + 1, np.int64)
    start[1:] = np.cumsum(sweep.size)
    ahead = np.zeros(start[-1])
    log_total = _sweep_forward(pair, row_alone, column_alone, sweep, start, ahead)
    rows, columns = pair.shape
    totals = AssignmentTotals(log_total, np.zeros((rows, columns)), np.zeros(rows), np.zeros(columns))
    if log_total > -np.inf:
        totals.column_freed[:] = 1.0 / column_alone
        _sweep_back(pair, row_alone, column_alone, sweep, start, ahead, totals)
    return totals


@_kernel
@no_type_check
def _sweep_forward(pair, row_alone, column_alone, sweep, start, ahead):
    """Fill `ahead`, and return the logarithm of the total.

    `ahead[start[place] + s]` is the weight of all choices of the rows before `place` that take exactly the
    subset s of the frontier's columns, relative to the largest of its row.
    """
    # pair Float64[R C], row_alone Float64[R], column_alone Float64[C]
    column, weight, bit_of = _no_choices(pair)
    # Columns that no row may take are certainly alone
    log_total = np.log(column_alone[sweep.last < 0]).sum()
    state = np.zeros(sweep.size.max())
    state[0] = 1.0
    for place in range(len(pair)):
        size = sweep.size[place]
        ahead[start[place] : start[place + 1]] = state[:size]
        count = _choices(pair, sweep, place, column, weight, bit_of)
        alone = row_alone[sweep.row[place]]
        for s in range(size - 1, -1, -1):  # downwards: state[s ^ bit] must be the value before this row
            # The row is alone, or it takes column n, which was free in the subset without its bit.
            total = state[s] * alone
            for n in range(count):
                if s & bit_of[n]:
                    total += state[s ^ bit_of[n]] * weight[n]
            state[s] = total
        for n in range(count):
            # No later row may take the column: add its alone weight where it is free, and clear its bit.
            if sweep.last[column[n]] == place:
                bit, none = bit_of[n], column_alone[column[n]]
                for s in range(size):
                    if not s & bit:
                        state[s] = state[s] * none + state[s | bit]
                        state[s | bit] = 0.0
        # Rescale against underflow. `log_total` keeps the factor.
        largest = state[:size].max()
        if largest == 0.0:
            return -np.inf
        log_total += np.log(largest)
        state[:size] /= largest
    return log_total + np.log(state[0])


@_kernel
@no_type_check
def _sweep_back(pair, row_alone, column_alone, sweep, start, ahead, totals):
    """Fill `totals` in a backward sweep.

    `after[s]` is the weight of all later choices, given that the earlier rows have taken the subset s.
    """
    column, weight, bit_of = _no_choices(pair)
    after, state = np.zeros(sweep.size.max()), np.zeros(sweep.size.max())
    after[0] = 1.0
    for place in range(len(pair) - 1, -1, -1):
        size, row = sweep.size[place], sweep.row[place]
        before = ahead[start[place] : start[place + 1]]
        count = _choices(pair, sweep, place, column, weight, bit_of)
        for n in range(count - 1, -1, -1):
            # Undo the clearing of the bit: a free column contributes its alone weight, a taken one
            # contributes 1.
            if sweep.last[column[n]] == place:
                bit, none = bit_of[n], column_alone[column[n]]
                for s in range(size):
                    if not s & bit:
                        after[s | bit] = after[s]
                        after[s] *= none
        left = 0.0
        for s in range(size):
            state[s] = after[s] * row_alone[row]
            left += before[s] * after[s]
        # `left` is the total without this row, `whole` the total with it, both up to the same factor. `state`
        # becomes `after` of the row before.
        whole = left * row_alone[row]
        # A pair sets a bit of a subset: its share is before · weight · after, summed over subsets without it.
        for n in range(count):
            share, bit = 0.0, bit_of[n]
            for s in range(size):
                if not s & bit:
                    with_pair = after[s | bit] * weight[n]
                    state[s] += with_pair
                    share += before[s] * with_pair
            totals.pair[row, column[n]] = share
            whole += share
        totals.pair[row] /= whole
        totals.row_freed[row] = left / whole
        # The columns whose last row is this one leave the frontier here: compute their total without the
        # column.
        for n in range(count):
            if sweep.last[column[n]] == place:
                freed = _without(n, row_alone[row], weight[:count], bit_of, before, after)
                totals.column_freed[column[n]] = freed / whole
        for n in range(count):
            if sweep.first[column[n]] == place:  # no earlier row can take it, so its bit cannot be set
                for s in range(size):
                    if s & bit_of[n]:
                        state[s] = 0.0
        state[:size] /= state[:size].max()
        state[size:] = 0.0
        after, state = state, after


@_kernel
@no_type_check
def _without(n, alone, weight, bit_of, before, after):
    """Return the total at a row if column n did not exist. The row is the last one that may take n.

    Subsets with column n are skipped. `after` is read at subsets with its bit set, because there it does not
    include the column's alone weight.
    """
    total, bit = 0.0, bit_of[n]
    for s in range(len(before)):
        if s & bit:
            continue
        reached = before[s] * alone
        for m in range(len(weight)):
            if s & bit_of[m]:
                reached += before[s ^ bit_of[m]] * weight[m]
        total += reached * after[s | bit]
    return total


@_kernel
@no_type_check
def _no_choices(pair):
    columns = pair.shape[1]
    return np.empty(columns, np.int64), np.empty(columns), np.empty(columns, np.int64)


@_kernel
@no_type_check
def _choices(pair, sweep, place, column, weight, bit_of):
    """Write the columns that a row may take, their weights and their bits into the three arrays.

    Return their number.
    """
    row, count = sweep.row[place], 0
    for c in range(pair.shape[1]):
        if pair[row, c] > 0.0:
            column[count], weight[count], bit_of[count] = c, pair[row, c], 1 << sweep.slot[c]
            count += 1
    return count
