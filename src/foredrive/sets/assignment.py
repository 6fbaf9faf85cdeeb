"""The best and the K best partial assignments of rows to columns, by shortest augmenting paths.

A row takes one column at `cost[row, column]`, or no column at `free[row]`. A column that no row takes costs
nothing. The dual prices (`row_price`, and `column_price` ≤ 0) satisfy `cost - row_price - column_price ≥ 0`,
with equality for assigned pairs. Because of this, one augmenting path repairs a solution after a change.

Sources: Jonker and Volgenant (1987) for the augmenting paths; Murty (1968) for the partition of the remaining
assignments into disjoint subproblems; Miller, Stone and Cox (1997) for starting each subproblem from the
solution of its parent.
"""

from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")


class Assignment(NamedTuple):
    """The best assignment and the dual prices that prove its optimality."""

    column: Int[ndarray, "R"]
    """Column of each row; -1 if it has none."""
    row_price: Float[ndarray, "R"]
    column_price: Float[ndarray, "C"]
    """Never positive. 0 where the column is not assigned."""


class RankedAssignments(NamedTuple):
    """Distinct assignments in order of increasing cost."""

    column: Int[ndarray, "k R"]
    """Column of each row; -1 if it has none."""
    cost: Float[ndarray, "k"]


class _Search(NamedTuple):
    """State of a shortest-path search, by node."""

    distance: Float[ndarray, "nodes"]
    before: Int[ndarray, "nodes"]
    """Row from which the node is reached, or `_BY_UNUSED`."""
    done: Bool[ndarray, "nodes"]
    row_of: Int[ndarray, "nodes"]
    """Row that holds the node; -1 if the node is unused."""


class _Solution(NamedTuple):
    """An assignment with its prices."""

    column: Int[ndarray, "R"]
    """C: no column."""
    row_price: Float[ndarray, "R"]
    node_price: Float[ndarray, "C_R"]
    """The price of each column, then of each row's "no column"."""


class _Path(NamedTuple):
    """A path that `_reroute` has found."""

    length: float
    """inf: there is none that is short enough."""
    reached_unused: float
    """Distance of the first unused node on it; inf if it has none."""
    unused: int
    """That node; -1 if it has none."""


class _Subproblems(NamedTuple):
    """The cheapest unsolved subproblems in order of their costs; inf where there are fewer."""

    cost: Float[ndarray, "k"]
    parent: Int[ndarray, "k"]
    """The ranked assignment that is split."""
    row: Int[ndarray, "k"]
    """The row that must not take its own column."""


_BY_UNUSED = -2


def best_assignment(cost: Float[ndarray, "R C"], free: Float[ndarray, "R"]) -> Assignment:
    """Return the assignment of minimum cost.

    Entries of `cost` may be +inf (forbidden) or negative. `free` must be finite. It is fastest with R ≤ C.
    """
    column, row_price, column_price = solve(_as_costs(cost), _as_costs(free))
    return Assignment(np.where(column == cost.shape[1], -1, column), row_price, column_price)


def k_best_assignments(cost: Float[ndarray, "R C"], free: Float[ndarray, "R"], k: int) -> RankedAssignments:
    """Return the k (≥ 1) assignments of minimum cost, or all of finite cost if there are fewer."""
    column, total = _rank(_as_costs(cost), _as_costs(free), k)
    return RankedAssignments(np.where(column == cost.shape[1], -1, column), total)


def _as_costs(values: Float[ndarray, "..."]) -> Float[ndarray, "..."]:
    return np.ascontiguousarray(values, dtype=np.float64)


@_kernel
@no_type_check
def solve(cost, free):
    """Solve `best_assignment` inside a kernel: add one row after the other.

    Return the column of each row, the row prices and the column prices. Column C means "no column". Every row
    has its own such column, so these never conflict.
    """
    # cost Float64[R C], free Float64[R]
    rows, columns = cost.shape
    column_of, row_of = np.full(rows, -1), np.full(columns, -1)
    u, v = np.zeros(rows), np.zeros(columns)
    distance = np.empty(columns)
    before = np.empty(columns, np.int64)  # the row from which a column is reached
    done = np.empty(columns, np.bool_)
    for start in range(rows):
        length, end, row = _shortest_path(cost, free, u, v, row_of, start, distance, before, done)
        # Update the prices of the rows and columns on the search tree, so that reduced costs stay ≥ 0 and are
        # 0 for assigned pairs.
        u[start] += length
        for c in range(columns):
            if done[c]:
                u[row_of[c]] += length - distance[c]
                v[c] -= length - distance[c]
        # Augment: follow the path backwards. Each row takes its new column and gives up its old one.
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
def _shortest_path(cost, free, u, v, row_of, start, distance, before, done):
    """Find the shortest path from the unassigned row `start` to a free end, by Dijkstra on reduced costs.

    The path alternates between rows and the columns that they hold. It ends at an unassigned column, or at a
    reached row that takes "no column". `distance`, `before` and `done` are overwritten.

    Returns:
        The length of the path.
        The column at its end; C for "no column".
        The row before that end.
    """
    columns = len(v)
    distance[:] = np.inf
    done[:] = False
    row, reached = start, 0.0
    none_distance, none_row = np.inf, start
    # Path to the "no column" of the present row
    while True:
        to_none = reached + free[row] - u[row]
        if to_none < none_distance:
            none_distance, none_row = to_none, row
        nearest, end = np.inf, columns
        # Relax the edges from `row`, and find the nearest column that is not done.
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
            return none_distance, columns, none_row
        if row_of[end] < 0:
            return nearest, end, before[end]
        # The nearest column is assigned: its row needs another column.
        reached, done[end] = nearest, True
        row = row_of[end]


@_kernel
@no_type_check
def _rank(cost, free, k):
    """Return the k best assignments and their costs, by Murty's partition.

    Every ranked assignment is split into one subproblem per open row r: the rows before r keep their columns,
    and r must not take its own. Only the cost of a subproblem is computed at first. Its assignment is
    computed when it is the cheapest one left.
    """
    # cost Float64[R C], free Float64[R]. Prices of "no column" nodes follow those of the columns
    rows, columns = cost.shape
    column_of, total = np.empty((k, rows), np.int64), np.empty(k)
    u, v = np.empty((k, rows)), np.zeros((k, columns + rows))
    first_open = np.zeros(k, np.int64)  # rows before it keep their columns
    banned = np.zeros((k, columns + 1), np.bool_)  # columns that the first open row must not take
    no_ban = np.zeros(columns + 1, np.bool_)
    waiting = _Subproblems(np.full(k, np.inf), np.empty(k, np.int64), np.empty(k, np.int64))
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
        # Split the assignment that was ranked last. A subproblem that costs more than the `wanted` cheapest
        # ones cannot be ranked: `room` is the largest extra cost that is still of interest.
        parent, wanted = count - 1, k - count
        for r in range(first_open[parent], rows):
            room = waiting.cost[wanted - 1] - total[parent]
            ban = banned[parent] if r == first_open[parent] else no_ban
            solution = _Solution(column_of[parent], u[parent], v[parent])
            extra = _reroute(cost, free, solution, r, ban, room, search).length
            if extra < room:
                _insert(waiting, wanted, total[parent] + extra, parent, r)
        if waiting.cost[0] == np.inf:
            break
        # The cheapest waiting subproblem is the next assignment. Solve it, starting from its parent's
        # solution.
        parent, r, total[count] = waiting.parent[0], waiting.row[0], waiting.cost[0]
        _drop_first(waiting)
        column_of[count], u[count], v[count], first_open[count] = column_of[parent], u[parent], v[parent], r
        # Bans accumulate while the same row is cut again. Otherwise only the parent's column is banned.
        if r == first_open[parent]:
            banned[count] = banned[parent]
        solution = _Solution(column_of[count], u[count], v[count])
        path = _reroute(cost, free, solution, r, banned[count], np.inf, search)
        banned[count, column_of[parent, r]] = True
        _apply(solution, r, path, search)
        count += 1
    return column_of[:count], total[:count]


@_kernel
@no_type_check
def _insert(waiting, wanted, cost, parent, row):
    """Insert a subproblem into the sorted list of the `wanted` cheapest ones. The last one drops out."""
    place = wanted - 1
    while place > 0 and waiting.cost[place - 1] > cost:
        _copy(waiting, place - 1, place)
        place -= 1
    waiting.cost[place], waiting.parent[place], waiting.row[place] = cost, parent, row


@_kernel
@no_type_check
def _drop_first(waiting):
    """Remove the cheapest subproblem from the sorted list."""
    for place in range(1, len(waiting.cost)):
        _copy(waiting, place, place - 1)
    waiting.cost[-1] = np.inf


@_kernel
@no_type_check
def _copy(waiting, place, to):
    waiting.cost[to] = waiting.cost[place]
    waiting.parent[to], waiting.row[to] = waiting.parent[place], waiting.row[place]


@_kernel
@no_type_check
def _reroute(cost, free, solution, start, ban, room, search):
    """Find the shortest path that gives row `start` another node. Rows before `start` keep theirs.

    Nodes are the C columns, followed by each row's own "no column" node. `start` must not take a node in
    `ban`, nor the node that it holds now (`target`). The path ends at `target`, which `start` gives up.

    An unused node behaves as if an idle row held it at zero cost. A path that reaches an unused node may
    continue to any node. That node then becomes unused. Returns the `_Path`, if it is shorter than `room`.
    """
    columns, (column_of, u, v) = cost.shape[1], solution
    distance, before, done, row_of = search
    _reset(search, column_of, columns, start)
    target = column_of[start] if column_of[start] < columns else columns + start
    row, reached, reached_unused, unused = start, 0.0, np.inf, -1
    while True:
        if row >= 0:
            # Relax the edges from `row` to the columns and to its own "no column" node.
            offset = reached - u[row]
            for c in range(columns):
                d = offset + cost[row, c] - v[c]
                if d < distance[c] and not done[c] and not (row == start and (ban[c] or c == target)):
                    distance[c], before[c] = d, row
            own = columns + row
            d = offset + free[row] - v[own]
            if d < distance[own] and not done[own] and not (row == start and (ban[columns] or own == target)):
                distance[own], before[own] = d, row
        # Continue with the nearest node that is not done.
        nearest, end = room, -1
        for x in range(len(distance)):
            if distance[x] < nearest and not done[x]:
                nearest, end = distance[x], x
        if end < 0:
            return _Path(np.inf, reached_unused, unused)
        reached = nearest
        if end == target:
            return _Path(reached, reached_unused, unused)
        done[end] = True
        row = row_of[end]
        if row < 0:  # it happens once: all unused nodes are done afterwards
            reached_unused, unused = reached, end
            _relax_from_unused(v, reached, search)


@_kernel
@no_type_check
def _reset(search, column_of, columns, start):
    """Begin a search: note the row of each used node. The nodes of rows before `start` are not available."""
    distance, _, done, row_of = search
    distance[:] = np.inf
    done[:] = False
    row_of[:] = -1
    for r in range(len(column_of)):
        node = column_of[r] if column_of[r] < columns else columns + r
        row_of[node] = r
        if r < start:
            done[node] = done[columns + r] = True


@_kernel
@no_type_check
def _relax_from_unused(v, reached, search):
    """Continue a path from the first unused node that it reaches. All unused nodes are equivalent from here.

    An idle row has cost 0, so its reduced cost to node x is -v[x] ≥ 0.
    """
    distance, before, done, row_of = search
    for x in range(len(v)):
        if done[x]:
            continue
        if row_of[x] < 0:
            done[x] = True
        elif reached - v[x] < distance[x]:
            distance[x], before[x] = reached - v[x], _BY_UNUSED


@_kernel
@no_type_check
def _apply(solution, start, path, search):
    """Apply the path found by `_reroute` in place: update the assignment and the prices."""
    column_of, u, v = solution
    length, reached_unused, unused = path
    distance, before, done, row_of = search
    rows = len(u)
    columns = len(v) - rows
    # Dijkstra's update lowers the price of a node nearer than the end by `length` - distance, and raises that
    # of its row by as much. It would lower the prices of unused nodes, too, which must stay 0. `rise` is that
    # amount: it is added back to every node, and taken from every row.
    rise = length - reached_unused if reached_unused < np.inf else 0.0
    for x in range(len(v)):
        r = row_of[x]
        if r < start:  # the node is unused, or its row is fixed
            continue
        v[x] += rise
        u[r] -= rise
        if r == start:
            u[r] += length
        elif done[x]:
            v[x] += distance[x] - length
            u[r] += length - distance[x]
    # Follow the path backwards from the node that `start` gives up.
    end = column_of[start] if column_of[start] < columns else columns + start
    while True:
        row = before[end]
        if row == _BY_UNUSED:
            # An idle row took this node and freed `unused`, so the path continues from there.
            end = unused
            row = before[end]
        given_up = column_of[row] if column_of[row] < columns else columns + row
        column_of[row] = end if end < columns else columns
        if row == start:
            break
        end = given_up
