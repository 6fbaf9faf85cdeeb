"""Sums over all associations in each connected component, exact where that is affordable."""

from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from foredrive.sets.assignment import solve
from foredrive.sets.frontier import plan_sweep, sum_sweep

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")


class Scaled(NamedTuple):
    """Weights of a component, rescaled by rows and columns.

    The best association weighs 1, and no factor exceeds 1.
    """

    cost: Float[ndarray, "R C"]
    free: Float[ndarray, "R"]
    """Input of `assignment`, with a finite cost in place of infinity."""
    column_free: Float[ndarray, "C"]
    """Cost of a column that no row takes. It is already subtracted from `cost`."""
    column: Int[ndarray, "R"]
    """Column of each row in the best association; C if it has none."""
    bad_rows: Bool[ndarray, "R"]
    bad_columns: Bool[ndarray, "C"]
    log_pair: Float[ndarray, "R C"]
    row_alone: Float[ndarray, "R"]
    column_alone: Float[ndarray, "C"]
    log_column_scale: Float[ndarray, "C"]
    """Logarithm of the factor by which the weights of each column were multiplied."""
    log_best: float
    """Logarithm of the unscaled weight of the best association; -inf if none is possible."""


class Components(NamedTuple):
    """Members of the connected components, sorted by component.

    Component n is the slice start[n] : start[n + 1].
    """

    row: Int[ndarray, "_"]
    row_start: Int[ndarray, "components_1"]
    column: Int[ndarray, "_"]
    column_start: Int[ndarray, "components_1"]
    edge: Int[ndarray, "_"]
    edge_start: Int[ndarray, "components_1"]


class ComponentSums(NamedTuple):
    """Total of all components that could be summed exactly."""

    log_sum: float
    share: Float[ndarray, "E"]
    """Probability of each edge."""
    log_freed: Float[ndarray, "C"]
    """log(sum without the column / sum), valid where the sum is positive."""
    best: Int[ndarray, "C"]
    """Row of each column in the most likely association; -1 if it has none."""
    bad_rows: Bool[ndarray, "R"]
    bad_columns: Bool[ndarray, "C"]
    too_large: Int[ndarray, "_"]
    """Components that were not summed because they are too large."""


@_kernel
@no_type_check
def find_components(row: Int[ndarray, "E"], column: Int[ndarray, "E"], rows: int, columns: int) -> Components:
    """Find the connected components that have an edge. Members are in increasing order."""
    # Union-find: the root of a component is its smallest node. Columns are numbered after the rows.
    parent = np.arange(rows + columns)
    for e in range(len(row)):
        a, b = _root(parent, row[e]), _root(parent, rows + column[e])
        if a != b:
            parent[max(a, b)] = min(a, b)
    # Number the components in the order of their first edges. Nodes without an edge have none.
    number, count = np.full(rows + columns, -1), np.int64(0)
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
    """Sum each component that needs at most `max_states` numbers, and all nodes without an edge.

    See `ComponentSums` for the result.
    """
    # Nodes without an edge contribute their weights alone
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
        # Copy the edges of the component into a dense matrix of its own rows and columns.
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
        # Write its results to the places of its members in the whole scene.
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
    """Sum a component exactly, if that is affordable.

    The sweep runs over the side (rows or columns) that needs fewer states. If no association is possible, the
    pairs are those of the association with the fewest impossible members.

    Returns:
        Whether the component was summed, the logarithm of its sum, the probability of each pair, and
        `column_freed` of `AssignmentTotals`.
    """
    rows, columns = scaled.log_pair.shape
    # Impossible: report the pairs of the association with the fewest impossible members
    if scaled.log_best == -np.inf:
        pair = np.zeros((rows, columns))
        for r in range(rows):
            if scaled.column[r] < columns:
                pair[r, scaled.column[r]] = 1.0
        return True, -np.inf, pair, np.zeros(columns)
    pair = np.exp(scaled.log_pair)
    # The sweep may run over rows or columns; take the cheaper direction
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
    """Rescale the weights by the dual prices of the best assignment."""
    rows, columns = log_pair.shape
    # Best assignment with its dual prices: they scale every weight to at most 1
    cost, free, column_free = _costs(log_pair, log_row, log_column)
    column, row_price, column_price = _solve_shorter_side(cost, free, column_free)
    taken = np.zeros(columns + 1, np.bool_)
    row_alone, bad_rows = np.zeros(rows), np.zeros(rows, np.bool_)
    log_scaled, log_best = np.empty((rows, columns)), 0.0
    for r in range(rows):
        taken[column[r]] = True
        # Weight of the best association, unscaled
        log_best += log_row[r] if column[r] == columns else log_pair[r, column[r]]
        if log_row[r] > -np.inf:
            row_alone[r] = np.exp(row_price[r] - free[r])
        else:
            bad_rows[r] = column[r] == columns
        for c in range(columns):  # values above 0 come from rounding
            # Reduced costs are ≥ 0, so scaled logarithms are ≤ 0, and 0
            # for the pairs of the best association
            log_scaled[r, c] = min(row_price[r] + column_price[c] - cost[r, c], 0.0)
    column_alone, bad_columns = np.zeros(columns), np.zeros(columns, np.bool_)
    log_column_scale = np.empty(columns)
    for c in range(columns):
        log_best += 0.0 if taken[c] else log_column[c]
        log_column_scale[c] = column_price[c] + column_free[c]
        if log_column[c] > -np.inf:
            # The alone weight of a column after scaling by its price
            column_alone[c] = np.exp(column_price[c])
        else:
            bad_columns[c] = not taken[c]
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
        log_column_scale,
        log_best,
    )


@_kernel
@no_type_check
def _costs(log_pair, log_row, log_column):
    """Return the input of `assignment`: pairs less their columns' costs, rows alone, and columns alone.

    A zero weight of a row or column alone costs more than any possible gain from paying it.
    """
    rows, columns = log_pair.shape
    price = _price_of_the_impossible(log_pair, log_row, log_column)
    cost, free, column_free = np.empty((rows, columns)), np.empty(rows), np.empty(columns)
    for c in range(columns):
        # A zero weight becomes a large finite cost
        column_free[c] = price if log_column[c] == -np.inf else -log_column[c]
    for r in range(rows):
        free[r] = price if log_row[r] == -np.inf else -log_row[r]
        for c in range(columns):
            # A column's own cost is paid by all, and saved by the pair that takes it
            cost[r, c] = -log_pair[r, c] - column_free[c]
    return cost, free, column_free


@_kernel
@no_type_check
def _solve_shorter_side(cost, free, column_free):
    """Return the best assignment and its prices. It is solved by columns if there are fewer of them."""
    rows, columns = cost.shape
    if rows <= columns:
        return solve(cost, free)
    # Transposed: prices of rows and columns change places, and the column costs are put back
    of_column, column_price, row_price = solve(*turn_costs(cost, free, column_free))
    column = np.full(rows, columns)
    for c in range(columns):
        if of_column[c] < rows:
            column[of_column[c]] = c
        column_price[c] -= column_free[c]
    for r in range(rows):
        row_price[r] += free[r]
    return column, row_price, column_price


@_kernel
@no_type_check
def turn_costs(cost, free, column_free):
    """Return `cost` and `free` of the transposed problem. The totals differ by Σ free - Σ column_free."""
    rows, columns = cost.shape
    turned = np.empty((columns, rows))
    for c in range(columns):
        for r in range(rows):
            turned[c, r] = cost[r, c] + column_free[c] - free[r]
    return turned, column_free


@_kernel
@no_type_check
def _price_of_the_impossible(log_pair, log_row, log_column):
    """Return a finite cost in place of infinity. It exceeds any possible gain from paying it."""
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
        # Path halving keeps the trees flat
        parent[node] = parent[parent[node]]
        node = parent[node]
    return node


@_kernel
@no_type_check
def _group(of, count):
    """Group indices by `of` (-1 is no group). Return the indices by group, and the start of each group."""
    # Counting sort by group
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
