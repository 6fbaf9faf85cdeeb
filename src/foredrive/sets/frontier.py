"""The sum over all partial assignments of rows to columns, by dynamic programming over a moving frontier.

Rows are added one after the other. Of the columns, only those that earlier and later rows compete for have to
be remembered as taken or not: the frontier. Objects compete for the detections around them, not for those at
the other end of the street, so it stays narrow in scenes that are large.
"""

from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")
_WIDEST, _CHEAP = 40, 1 << 10


class AssignmentTotals(NamedTuple):
    """The weight of all assignments together, and what it is made of; zeros if the total is 0."""

    log_total: float
    pair: Float[ndarray, "R C"]
    """Share of the total in which the row has the column."""
    row_freed: Float[ndarray, "R"]
    """The total without the row over the total: times the row's weight alone, its probability to be alone."""
    column_freed: Float[ndarray, "C"]


class Sweep(NamedTuple):
    """In which order rows are added, and where the columns they compete for are remembered.

    Of a column that no row may take, `first`, `last` and `slot` are -1.
    """

    row: Int[ndarray, "R"]
    """Rows in the order they are added."""
    first: Int[ndarray, "C"]
    """Place in that order of the first row that may take the column."""
    last: Int[ndarray, "C"]
    """Place of the last one."""
    slot: Int[ndarray, "C"]
    """Bit that says whether the column is taken, from its first row to its last."""
    size: Int[ndarray, "R"]
    """Number of subsets to keep at each row."""
    states: int
    """Number of subsets to keep, over all rows."""


def sum_assignments(
    pair: Float[ndarray, "R C"], row_alone: Float[ndarray, "R"], column_alone: Float[ndarray, "C"]
) -> AssignmentTotals:
    """Sum of products of weights: one for every pair, every row alone and every column alone.

    All weights must be non-negative. Exact, in as many numbers of memory as `plan_sweep` says. Partial sums
    are kept relative to the largest of their row: weights must not be so uneven that they underflow, which
    scaling by the best assignment's prices ensures.
    """
    pair, row_alone, column_alone = (
        np.ascontiguousarray(w, dtype=np.float64) for w in (pair, row_alone, column_alone)
    )
    return sum_sweep(pair, row_alone, column_alone, plan_sweep(pair > 0, np.iinfo(np.int64).max))


@_kernel
@no_type_check
def plan_sweep(possible: Bool[ndarray, "R C"], max_states: int) -> Sweep:
    """A sweep from the first row, or from where that one ended if it needs fewer numbers.

    `states` says how many; where they are more than `max_states`, the sweep is not planned to its end.
    """
    column, start = list_true(possible)
    row, row_start = list_true(possible.T)
    sweep = _plan_from(0, column, start, row, row_start, max_states)
    if sweep.states <= _CHEAP:
        return sweep
    again = _plan_from(sweep.row[-1], column, start, row, row_start, max_states)
    return sweep if sweep.states <= again.states else again


@_kernel
@no_type_check
def list_true(mask):
    """Columns at which row r is true, one row after the other, and where each row starts in that list."""
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
    """Add next, of the rows at the frontier, the one that widens it least."""
    rows, columns = len(start) - 1, len(row_start) - 1
    order, size, states = np.empty(rows, np.int64), np.zeros(rows, np.int64), 0
    first, last, slot = np.full(columns, -1), np.full(columns, -1), np.full(columns, -1)
    added, user = np.zeros(rows, np.bool_), np.full(_WIDEST, -1)  # the column that has a slot
    waiting = row_start[1:] - row_start[:-1]  # rows that may take the column and are not added
    unseen = 0  # rows before it are added
    for place in range(rows):
        order[place], added[next_row] = next_row, True
        mine = column[start[next_row] : start[next_row + 1]]
        for c in mine:
            if first[c] < 0:
                free = 0
                while free < _WIDEST - 1 and user[free] >= 0:
                    free += 1
                first[c], slot[c], user[free] = place, free, c
        top = -1
        for bit in range(_WIDEST):
            if user[bit] >= 0:
                top = bit
        size[place] = 1 << (top + 1)
        states += size[place]
        for c in mine:
            waiting[c] -= 1
            if waiting[c] == 0:
                last[c], user[slot[c]] = place, -1
        if states > max_states:
            order[-1] = next_row
            break
        next_row, least = -1, np.iinfo(np.int64).max
        for bit in range(top + 1):
            if user[bit] < 0:
                continue
            for r in row[row_start[user[bit]] : row_start[user[bit] + 1]]:
                if added[r]:
                    continue
                wider = 0
                for c in column[start[r] : start[r + 1]]:
                    wider += 2 * (first[c] < 0) - (waiting[c] == 1)
                if wider < least or (wider == least and r < next_row):
                    next_row, least = r, wider
        if next_row < 0:  # nothing is at the frontier
            while unseen < rows and added[unseen]:
                unseen += 1
            next_row = unseen
    return Sweep(order, first, last, slot, size, states)


@_kernel
@no_type_check
def sum_sweep(pair, row_alone, column_alone, sweep):
    """Forward over the rows, and back; their product at a pair is what the pair has."""
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
    """Fill `ahead`: from start[place] on, what each subset of columns weighs that rows before took."""
    column, weight, bit_of = _no_choices(pair)
    log_total = np.log(column_alone[sweep.last < 0]).sum()
    state = np.zeros(sweep.size.max())
    state[0] = 1.0
    for place in range(len(pair)):
        size = sweep.size[place]
        ahead[start[place] : start[place + 1]] = state[:size]
        count = _choices(pair, sweep, place, column, weight, bit_of)
        alone = row_alone[sweep.row[place]]
        for s in range(size - 1, -1, -1):  # downwards: a row takes one column at most
            total = state[s] * alone
            for n in range(count):
                if s & bit_of[n]:
                    total += state[s ^ bit_of[n]] * weight[n]
            state[s] = total
        for n in range(count):
            if sweep.last[column[n]] == place:
                bit, none = bit_of[n], column_alone[column[n]]
                for s in range(size):
                    if not s & bit:
                        state[s] = state[s] * none + state[s | bit]
                        state[s | bit] = 0.0
        largest = state[:size].max()
        if largest == 0.0:
            return -np.inf
        log_total += np.log(largest)
        state[:size] /= largest
    return log_total + np.log(state[0])


@_kernel
@no_type_check
def _sweep_back(pair, row_alone, column_alone, sweep, start, ahead, totals):
    """Fill the `totals`, with the weight of what follows, by subset that was taken before."""
    column, weight, bit_of = _no_choices(pair)
    after, state = np.zeros(sweep.size.max()), np.zeros(sweep.size.max())
    after[0] = 1.0
    for place in range(len(pair) - 1, -1, -1):
        size, row = sweep.size[place], sweep.row[place]
        before = ahead[start[place] : start[place + 1]]
        count = _choices(pair, sweep, place, column, weight, bit_of)
        for n in range(count - 1, -1, -1):
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
        whole = left * row_alone[row]
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
        for n in range(count):
            if sweep.last[column[n]] == place:
                freed = _without(n, row_alone[row], weight[:count], bit_of, before, after)
                totals.column_freed[column[n]] = freed / whole
        for n in range(count):
            if sweep.first[column[n]] == place:  # no row before could take it
                for s in range(size):
                    if s & bit_of[n]:
                        state[s] = 0.0
        state[:size] /= state[:size].max()
        state[size:] = 0.0
        after, state = state, after


@_kernel
@no_type_check
def _without(n, alone, weight, bit_of, before, after):
    """What a row's choices weigh together if column n, of which it is the last row, were not there.

    Where the column is taken already, what follows does not have its weight alone.
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
    """Columns that a row may take, into the three arrays; returns how many."""
    row, count = sweep.row[place], 0
    for c in range(pair.shape[1]):
        if pair[row, c] > 0.0:
            column[count], weight[count], bit_of[count] = c, pair[row, c], 1 << sweep.slot[c]
            count += 1
    return count
