"""The sums over all associations within each connected component, exactly where that is affordable."""

from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from foredrive.sets.assignment import solve
from foredrive.sets.frontier import plan_sweep, sum_sweep

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")


class Scaled(NamedTuple):
    """Weights times such powers that the best association weighs 1 and no factor of any is larger."""

    cost: Float[ndarray, "R C"]
    free: Float[ndarray, "R"]
    """What `assignment` works on: the impossible has a finite price."""
    column_free: Float[ndarray, "C"]
    """What a column costs that no row takes; `cost` has it subtracted."""
    column: Int[ndarray, "R"]
    """Of the best association; C: none."""
    bad_rows: Bool[ndarray, "R"]
    bad_columns: Bool[ndarray, "C"]
    log_pair: Float[ndarray, "R C"]
    row_alone: Float[ndarray, "R"]
    column_alone: Float[ndarray, "C"]
    log_column_scale: Float[ndarray, "C"]
    """Logarithm of what the weights of a column were multiplied by."""
    log_best: float
    """What the best association weighs unscaled; -inf if none is possible."""


class Components(NamedTuple):
    """What lies in which component, in the order of the components."""

    row: Int[ndarray, "_"]
    row_start: Int[ndarray, "components_1"]
    column: Int[ndarray, "_"]
    column_start: Int[ndarray, "components_1"]
    edge: Int[ndarray, "_"]
    edge_start: Int[ndarray, "components_1"]


class ComponentSums(NamedTuple):
    """The components that could be summed exactly, together."""

    log_sum: float
    share: Float[ndarray, "E"]
    """Probability of each edge."""
    log_freed: Float[ndarray, "C"]
    """Logarithm of the sum without a column over the sum, where that is positive."""
    best: Int[ndarray, "C"]
    """Row of each column in the most likely association; -1: none."""
    bad_rows: Bool[ndarray, "R"]
    bad_columns: Bool[ndarray, "C"]
    too_large: Int[ndarray, "_"]
    """Components that are left to be summed."""


@_kernel
@no_type_check
def find_components(row: Int[ndarray, "E"], column: Int[ndarray, "E"], rows: int, columns: int) -> Components:
    """Connected components that have an edge; members in rising order."""
    parent = np.arange(rows + columns)
    for e in range(len(row)):
        a, b = _root(parent, row[e]), _root(parent, rows + column[e])
        if a != b:
            parent[max(a, b)] = min(a, b)
    number, count = np.full(rows + columns, -1), 0
    for e in range(len(row)):
        root = _root(parent, row[e])
        if number[root] < 0:
            number[root], count = count, count + 1
    of = np.empty(rows + columns, np.int64)
    for node in range(rows + columns):
        of[node] = number[_root(parent, node)]
    edge, edge_start = _group(of[row], count)
    member_row, row_start = _group(of[:rows], count)
    member_column, column_start = _group(of[rows:], count)
    return Components(member_row, row_start, member_column, column_start, edge, edge_start)


@_kernel
@no_type_check
def sum_components(components, row, column, log_edge, log_row, log_column, max_states):
    """Sum what takes at most `max_states` numbers, and what is in no component; see `ComponentSums`."""
    share, best, log_freed = np.zeros(len(row)), np.full(len(log_column), -1), -log_column
    alone, unpaired = np.ones(len(log_row), np.bool_), np.ones(len(log_column), np.bool_)
    alone[components.row] = False
    unpaired[components.column] = False
    bad_rows, bad_columns = alone & (log_row == -np.inf), unpaired & (log_column == -np.inf)
    log_sum = log_row[alone].sum() + log_column[unpaired].sum()
    too_large = np.empty(len(components.row_start) - 1, np.int64)
    left, place = 0, np.empty(max(len(log_row), len(log_column)), np.int64)
    column_place = np.empty(len(log_column), np.int64)
    for n in range(len(components.row_start) - 1):
        i = components.row[components.row_start[n] : components.row_start[n + 1]]
        j = components.column[components.column_start[n] : components.column_start[n + 1]]
        edges = components.edge[components.edge_start[n] : components.edge_start[n + 1]]
        for p in range(len(i)):
            place[i[p]] = p
        for p in range(len(j)):
            column_place[j[p]] = p
        log_pair = np.full((len(i), len(j)), -np.inf)
        for e in edges:
            log_pair[place[row[e]], column_place[column[e]]] = log_edge[e]
        scaled = scale(log_pair, log_row[i], log_column[j])
        solved, log_part, pair, freed = sum_scaled(scaled, max_states)
        if not solved:
            too_large[left], left = n, left + 1
            continue
        log_sum += log_part
        for e in edges:
            share[e] = pair[place[row[e]], column_place[column[e]]]
        for p in range(len(i)):
            bad_rows[i[p]] = scaled.bad_rows[p]
            if scaled.column[p] < len(j):
                best[j[scaled.column[p]]] = i[p]
        for p in range(len(j)):
            bad_columns[j[p]] = scaled.bad_columns[p]
            log_freed[j[p]] = np.log(freed[p]) + scaled.log_column_scale[p]
    return ComponentSums(log_sum, share, log_freed, best, bad_rows, bad_columns, too_large[:left])


@_kernel
@no_type_check
def sum_scaled(scaled, max_states):
    """Whether a component could be summed exactly, the logarithm of its sum, shares, and `column_freed`.

    The frontier runs over whichever side keeps it narrower. Where no association is possible the pairs are
    those of the association with fewest impossible members.
    """
    rows, columns = scaled.log_pair.shape
    if scaled.log_best == -np.inf:
        pair = np.zeros((rows, columns))
        for r in range(rows):
            if scaled.column[r] < columns:
                pair[r, scaled.column[r]] = 1.0
        return True, -np.inf, pair, np.zeros(columns)
    pair = np.exp(scaled.log_pair)
    sweep = plan_sweep(pair > 0.0, max_states)
    turned = np.ascontiguousarray(pair.T)
    other = plan_sweep(turned > 0.0, max_states)
    if min(sweep.states, other.states) > max_states:
        return False, 0.0, pair, np.zeros(columns)
    if sweep.states <= other.states:
        log_total, share, _, freed = sum_sweep(pair, scaled.row_alone, scaled.column_alone, sweep)
    else:
        log_total, turned, freed, _ = sum_sweep(turned, scaled.column_alone, scaled.row_alone, other)
        share = np.ascontiguousarray(turned.T)
    return True, scaled.log_best + log_total, share, freed


@_kernel
@no_type_check
def scale(
    log_pair: Float[ndarray, "R C"], log_row: Float[ndarray, "R"], log_column: Float[ndarray, "C"]
) -> Scaled:
    """Scale by the prices of the best assignment."""
    rows, columns = log_pair.shape
    price = _price_of_the_impossible(log_pair, log_row, log_column)
    no_row, no_column = log_row == -np.inf, log_column == -np.inf
    free, column_free = np.where(no_row, price, -log_row), np.where(no_column, price, -log_column)
    cost = -log_pair - column_free
    if rows <= columns:
        column, row_price, column_price = solve(cost, free)
    else:
        turned, turned_free = turn_costs(cost, free, column_free)
        of_column, column_price, row_price = solve(turned, turned_free)
        column = np.full(rows, columns)
        for c in range(columns):
            if of_column[c] < rows:
                column[of_column[c]] = c
        column_price -= column_free
        row_price += free
    taken = np.zeros(columns + 1, np.bool_)
    log_best = 0.0
    for r in range(rows):
        taken[column[r]] = True
        log_best += log_row[r] if column[r] == columns else log_pair[r, column[r]]
    for c in range(columns):
        log_best += 0.0 if taken[c] else log_column[c]
    log_scaled = np.empty((rows, columns))
    for r in range(rows):
        for c in range(columns):  # above 0 by rounding alone
            log_scaled[r, c] = min(row_price[r] + column_price[c] - cost[r, c], 0.0)
    row_alone = np.where(no_row, 0.0, np.exp(row_price - free))
    column_alone = np.where(no_column, 0.0, np.exp(column_price))
    bad_rows, bad_columns = no_row & (column == columns), no_column & ~taken[:-1]
    return Scaled(
        cost,
        free,
        column_free,
        column,
        bad_rows,
        bad_columns,
        log_scaled,
        row_alone,
        column_alone,
        column_price + column_free,
        log_best,
    )


@_kernel
@no_type_check
def turn_costs(cost, free, column_free):
    """`cost` and `free` of the same problem with columns as rows, but for Σ free - Σ column_free."""
    return np.ascontiguousarray(cost.T) + column_free[:, None] - free, column_free


@_kernel
@no_type_check
def _price_of_the_impossible(log_pair, log_row, log_column):
    """A finite cost in place of infinity that outweighs whatever could be gained by paying it."""
    total = 0.0
    for r in range(len(log_row)):
        largest = 0.0 if log_row[r] == -np.inf else abs(log_row[r])
        for c in range(len(log_column)):
            if log_pair[r, c] > -np.inf:
                largest = max(largest, abs(log_pair[r, c]))
        total += largest
    for c in range(len(log_column)):
        total += 0.0 if log_column[c] == -np.inf else abs(log_column[c])
    return 1.0 + 2.0 * total


@_kernel
@no_type_check
def _root(parent, node):
    while parent[node] != node:
        parent[node] = parent[parent[node]]
        node = parent[node]
    return node


@_kernel
@no_type_check
def _group(of, count):
    """Indices by the group they are `of` (those of -1 are in none), and where each group starts."""
    start = np.zeros(count + 1, np.int64)
    for group in of:
        if group >= 0:
            start[group + 1] += 1
    start = np.cumsum(start)
    member, end = np.empty(start[-1], np.int64), start[:-1].copy()
    for index in range(len(of)):
        if of[index] >= 0:
            member[end[of[index]]] = index
            end[of[index]] += 1
    return member, start
