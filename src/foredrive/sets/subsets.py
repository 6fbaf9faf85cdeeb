"""The sum over all partial assignments of rows to columns, by dynamic programming over subsets of columns."""

from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Float
from numpy import ndarray

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")


class AssignmentTotals(NamedTuple):
    """The weight of all assignments together, and which share of it each pair has."""

    total: float
    pair: Float[ndarray, "R C"]
    """Share of the total in which the row has the column; zeros if the total is 0."""


def sum_assignments(
    pair: Float[ndarray, "R C"], row_alone: Float[ndarray, "R"], column_alone: Float[ndarray, "C"]
) -> AssignmentTotals:
    """Sum of products of weights: one for every pair, every row alone and every column alone.

    All weights must be non-negative. Exact, in (R + 1) · 2^C numbers of memory and C times the operations.
    With weights of at most 1, a product that underflows takes less than 1e-300 off the total.
    """
    total, shares = _sum(
        *(np.ascontiguousarray(w, dtype=np.float64) for w in (pair, row_alone, column_alone))
    )
    return AssignmentTotals(float(total), shares)


@_kernel
@no_type_check
def _sum(pair, row_alone, column_alone):
    """Forward over the rows from the empty set, then back; their product at a pair is what a pair has."""
    rows, columns = pair.shape
    subsets = 1 << columns
    ahead = np.zeros((rows + 1, subsets))  # rows before r took exactly the subset
    ahead[0, 0] = 1.0
    for r in range(rows):
        for s in range(subsets):
            ahead[r + 1, s] = ahead[r, s] * row_alone[r]
        for c in range(columns):
            weight, bit = pair[r, c], 1 << c
            if weight == 0.0:
                continue
            for s in range(subsets):
                if s & bit:
                    ahead[r + 1, s] += ahead[r, s ^ bit] * weight
    behind = np.ones(subsets)  # rows from r on, when those before took the subset
    for c in range(columns):
        for s in range(subsets):
            if not s & (1 << c):
                behind[s] *= column_alone[c]
    total = 0.0
    for s in range(subsets):
        total += ahead[rows, s] * behind[s]
    shares = np.zeros((rows, columns))
    earlier = np.empty(subsets)
    for r in range(rows - 1, -1, -1):
        for s in range(subsets):
            earlier[s] = behind[s] * row_alone[r]
        for c in range(columns):
            weight, bit = pair[r, c], 1 << c
            if weight == 0.0:
                continue
            share = 0.0
            for s in range(subsets):
                if not s & bit:
                    after = behind[s | bit] * weight
                    share += ahead[r, s] * after
                    earlier[s] += after
            shares[r, c] = share / total if total > 0.0 else 0.0
        behind, earlier = earlier, behind
    return total, shares
