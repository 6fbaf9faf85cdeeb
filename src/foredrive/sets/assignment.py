"""The best and the K best partial assignments of rows to columns, by shortest augmenting paths.

A row takes one column at `cost[row, column]`, or none at `free[row]`; a column that no row takes costs
nothing. Prices (`row_price`, `column_price` ≤ 0) keep `cost - row_price - column_price ≥ 0`, with equality
where a row has its column, so that after a change one augmenting path mends a solution.

Sources: Jonker and Volgenant (1987) for the paths; Murty (1968) for the partition of what is left into
disjoint subproblems; Miller, Stone and Cox (1997) for starting each from the solution it was cut from.
"""

from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")


class Assignment(NamedTuple):
    """The best assignment and the prices that prove it."""

    column: Int[ndarray, "R"]
    """Column of each row; -1: none."""
    row_price: Float[ndarray, "R"]
    column_price: Float[ndarray, "C"]
    """Never positive; 0 where no row has the column."""


class RankedAssignments(NamedTuple):
    """Distinct assignments in order of cost."""

    column: Int[ndarray, "k R"]
    """Column of each row; -1: none."""
    cost: Float[ndarray, "k"]


class _Search(NamedTuple):
    """Where a search for a path stands, by node."""

    distance: Float[ndarray, "nodes"]
    before: Int[ndarray, "nodes"]
    """The row from which a node is reached, or `_BY_UNUSED`."""
    done: Bool[ndarray, "nodes"]
    row_of: Int[ndarray, "nodes"]
    """The row that has the node; -1: it is unused."""


_BY_UNUSED = -2


def best_assignment(cost: Float[ndarray, "R C"], free: Float[ndarray, "R"]) -> Assignment:
    """The assignment of least cost.

    Entries of `cost` may be +inf (forbidden) or negative; `free` must be finite. Fastest with R ≤ C.
    """
    column, row_price, column_price = solve(_as_costs(cost), _as_costs(free))
    return Assignment(np.where(column == cost.shape[1], -1, column), row_price, column_price)


def k_best_assignments(cost: Float[ndarray, "R C"], free: Float[ndarray, "R"], k: int) -> RankedAssignments:
    """The k assignments of least cost, or all there are of finite cost if they are fewer. k is at least 1."""
    column, total = _rank(_as_costs(cost), _as_costs(free), k)
    return RankedAssignments(np.where(column == cost.shape[1], -1, column), total)


def _as_costs(values: Float[ndarray, "..."]) -> Float[ndarray, "..."]:
    return np.ascontiguousarray(values, dtype=np.float64)


@_kernel
@no_type_check
def solve(cost, free):
    """`best_assignment` within kernels: add the rows one after the other.

    Column C stands for none, of which every row has its own.
    """
    rows, columns = cost.shape
    column_of = np.full(rows, -1)
    row_of = np.full(columns, -1)
    u, v = np.zeros(rows), np.zeros(columns)
    distance = np.empty(columns)
    before = np.empty(columns, np.int64)  # the row from which a column is reached
    done = np.empty(columns, np.bool_)
    for start in range(rows):
        distance[:] = np.inf
        done[:] = False
        row, reached = start, 0.0
        none_distance, none_row = np.inf, -1
        while True:
            to_none = reached + free[row] - u[row]
            if to_none < none_distance:
                none_distance, none_row = to_none, row
            nearest, end = np.inf, columns
            for c in range(columns):
                if done[c]:
                    continue
                d = reached + cost[row, c] - u[row] - v[c]
                if d < distance[c]:
                    distance[c] = d
                    before[c] = row
                if distance[c] < nearest:
                    nearest, end = distance[c], c
            if none_distance <= nearest:
                reached, end = none_distance, columns
                break
            reached = nearest
            if row_of[end] < 0:
                break
            done[end] = True
            row = row_of[end]
        u[start] += reached
        for c in range(columns):
            if done[c]:
                u[row_of[c]] += reached - distance[c]
                v[c] -= reached - distance[c]
        row = none_row if end == columns else before[end]
        while True:
            if end < columns:
                row_of[end] = row
            end, column_of[row] = column_of[row], end
            if row == start:
                break
            row = before[end]
    return column_of, u, v


@_kernel
@no_type_check
def _rank(cost, free, k):
    """Murty's partition: a subproblem is cut at each of its open rows, the rows before keeping theirs."""
    rows, columns = cost.shape
    column_of, total = np.empty((k, rows), np.int64), np.empty(k)
    u, v = np.empty((k, rows)), np.zeros((k, columns + rows))
    first_open = np.zeros(k, np.int64)  # rows before it keep their columns
    banned = np.zeros((k, columns + 1), np.bool_)  # what the first open row must not take
    no_ban = np.zeros(columns + 1, np.bool_)
    waiting = np.full(k, np.inf)  # costs of as many subproblems as are still asked for, in rising order
    parent_of, row_cut = np.empty(k, np.int64), np.empty(k, np.int64)
    nodes = columns + rows
    search = _Search(
        np.empty(nodes), np.empty(nodes, np.int64), np.empty(nodes, np.bool_), np.empty(nodes, np.int64)
    )

    column_of[0], u[0], v[0, :columns] = solve(cost, free)
    total[0] = 0.0
    for r in range(rows):
        c = column_of[0, r]
        total[0] += free[r] if c == columns else cost[r, c]
    count = 1
    while count < k:
        parent, wanted = count - 1, k - count
        for r in range(first_open[parent], rows):
            room = waiting[wanted - 1] - total[parent]
            ban = banned[parent] if r == first_open[parent] else no_ban
            extra, _, _ = _reroute(cost, free, column_of[parent], u[parent], v[parent], r, ban, room, search)
            if extra < room:
                _insert(waiting, parent_of, row_cut, wanted, total[parent] + extra, parent, r)
        if waiting[0] == np.inf:
            break
        parent, r, total[count] = parent_of[0], row_cut[0], waiting[0]
        _drop_first(waiting, parent_of, row_cut)
        column_of[count], u[count], v[count], first_open[count] = column_of[parent], u[parent], v[parent], r
        if r == first_open[parent]:
            banned[count] = banned[parent]
        extra, reached_unused, unused = _reroute(
            cost, free, column_of[count], u[count], v[count], r, banned[count], np.inf, search
        )
        banned[count, column_of[parent, r]] = True
        _apply(column_of[count], u[count], v[count], r, extra, reached_unused, unused, search)
        count += 1
    return column_of[:count], total[:count]


@_kernel
@no_type_check
def _insert(waiting, parent_of, row_cut, wanted, cost, parent, row):
    """Put a subproblem into its place among the `wanted` cheapest; the dearest falls off."""
    place = wanted - 1
    while place > 0 and waiting[place - 1] > cost:
        waiting[place], parent_of[place] = waiting[place - 1], parent_of[place - 1]
        row_cut[place] = row_cut[place - 1]
        place -= 1
    waiting[place], parent_of[place], row_cut[place] = cost, parent, row


@_kernel
@no_type_check
def _drop_first(waiting, parent_of, row_cut):
    waiting[:-1], parent_of[:-1], row_cut[:-1] = waiting[1:].copy(), parent_of[1:].copy(), row_cut[1:].copy()
    waiting[-1] = np.inf


@_kernel
@no_type_check
def _reroute(cost, free, column_of, u, v, start, ban, room, search):
    """Shortest way to give row `start` another column when rows before it keep theirs and it loses its own.

    Nodes are the columns, then each row's own "none". Unused nodes are alike: think of idle rows that have
    them, at no cost. A path that reaches one may go on to any node, which becomes unused in turn; it ends at
    the node that `start` gives up. Returns its length (inf if that is not below `room`), the distance of the
    first unused node on it (inf: there is none), and that node.
    """
    rows, columns = cost.shape
    distance, before, done, row_of = search
    distance[:] = np.inf
    done[:] = False
    row_of[:] = -1
    for r in range(rows):
        node = column_of[r] if column_of[r] < columns else columns + r
        row_of[node] = r
        if r < start:
            done[node] = done[columns + r] = True
    target = column_of[start] if column_of[start] < columns else columns + start
    row, reached, reached_unused, unused = start, 0.0, np.inf, -1
    while True:
        if row >= 0:
            offset = reached - u[row]
            for c in range(columns):
                d = offset + cost[row, c] - v[c]
                if d < distance[c] and not done[c] and not (row == start and (ban[c] or c == target)):
                    distance[c], before[c] = d, row
            own = columns + row
            d = offset + free[row] - v[own]
            if d < distance[own] and not done[own] and not (row == start and (ban[columns] or own == target)):
                distance[own], before[own] = d, row
        nearest, end = room, -1
        for x in range(columns + rows):
            if distance[x] < nearest and not done[x]:
                nearest, end = distance[x], x
        if end < 0:
            return np.inf, reached_unused, unused
        reached = nearest
        if end == target:
            return reached, reached_unused, unused
        done[end] = True
        row = row_of[end]
        if row < 0:
            reached_unused, unused = reached, end
            for x in range(columns + rows):
                if done[x]:
                    continue
                if row_of[x] < 0:
                    done[x] = True
                elif reached - v[x] < distance[x]:
                    distance[x], before[x] = reached - v[x], _BY_UNUSED


@_kernel
@no_type_check
def _apply(column_of, u, v, start, length, reached_unused, unused, search):
    """Follow a path that `_reroute` found: new columns, and prices that fit them."""
    distance, before, done, row_of = search
    rows = len(u)
    columns = len(v) - rows
    rise = length - reached_unused if reached_unused < np.inf else 0.0  # unused nodes keep their price of 0
    for x in range(len(v)):
        r = row_of[x]
        if r < start:  # unused, or kept by its row
            continue
        v[x] += rise
        u[r] -= rise
        if r == start:
            u[r] += length
        elif done[x]:
            v[x] += distance[x] - length
            u[r] += length - distance[x]
    end = column_of[start] if column_of[start] < columns else columns + start
    while True:
        row = before[end]
        if row == _BY_UNUSED:
            end = unused
            row = before[end]
        given_up = column_of[row] if column_of[row] < columns else columns + row
        column_of[row] = end if end < columns else columns
        if row == start:
            break
        end = given_up
