"""Best and K best assignments: against enumeration and SciPy, and the prices against what defines them."""

import itertools

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from foredrive.sets.assignment import best_assignment, k_best_assignments


def enumerate_assignments(cost: np.ndarray, free: np.ndarray) -> dict[tuple[int, ...], float]:
    """Every partial assignment of finite cost."""
    rows, columns = cost.shape
    totals = {}
    for choice in itertools.product(range(-1, columns), repeat=rows):
        taken = [c for c in choice if c >= 0]
        if len(set(taken)) < len(taken):
            continue
        total = sum(free[r] if c < 0 else cost[r, c] for r, c in enumerate(choice))
        if np.isfinite(total):
            totals[choice] = total
    return totals


def random_costs(rng: np.random.Generator, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    cost = rng.normal(-1.0, 3.0, (rows, columns))
    cost[rng.random(cost.shape) < 0.25] = np.inf
    return cost, rng.normal(0.0, 2.0, rows)


def test_the_k_best_are_those_that_enumeration_finds() -> None:
    rng = np.random.default_rng(0)
    for _ in range(400):
        cost, free = random_costs(rng, rng.integers(0, 5), rng.integers(0, 6))
        every = enumerate_assignments(cost, free)
        k = int(rng.integers(1, 60))
        ranked = k_best_assignments(cost, free, k)
        expected = sorted(every.values())[:k]
        np.testing.assert_allclose(ranked.cost, expected, atol=1e-9)
        found = [tuple(int(c) for c in row) for row in ranked.column]
        assert len(set(found)) == len(found)
        np.testing.assert_allclose([every[choice] for choice in found], expected, atol=1e-9)


def test_ties_are_all_found() -> None:
    """Four rows that may share four columns in any way: 209 partial assignments, in five groups by size."""
    ranked = k_best_assignments(-np.ones((4, 4)), np.zeros(4), 500)
    sizes, counts = np.unique(ranked.cost, return_counts=True)
    np.testing.assert_allclose(sizes, [-4, -3, -2, -1, 0], atol=1e-12)
    assert counts.tolist() == [24, 96, 72, 16, 1]


@pytest.mark.parametrize("shape", [(30, 50), (50, 30)])
def test_the_best_is_scipys_and_its_prices_prove_it(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    for _ in range(10):
        cost, free = random_costs(rng, *shape)
        own = np.full((shape[0], shape[0]), np.inf)
        np.fill_diagonal(own, free)
        padded = np.concatenate([cost, own], axis=1)
        expected = padded[linear_sum_assignment(padded)].sum()
        column, u, v = best_assignment(cost, free)
        rows = np.arange(shape[0])
        total = np.where(column < 0, free, cost[rows, column]).sum()
        assert total == pytest.approx(expected, abs=1e-9)
        assert (cost - u[:, None] - v >= -1e-9).all()
        assert (free - u >= -1e-9).all()
        assert (v <= 1e-12).all()
        assert u.sum() + v.sum() == pytest.approx(
            expected, abs=1e-9
        )  # so no price is paid for unused columns


def test_ranks_stay_right_over_many_cuts_of_a_larger_problem() -> None:
    """The K best of two independent blocks are the cheapest sums of one assignment of each."""
    rng = np.random.default_rng(2)
    blocks = [random_costs(rng, 4, 4) for _ in range(2)]
    cost = np.full((8, 8), np.inf)
    cost[:4, :4], cost[4:, 4:] = blocks[0][0], blocks[1][0]
    every = [list(enumerate_assignments(*block).values()) for block in blocks]
    expected = np.sort(np.add.outer(*every).ravel())[:2000]
    ranked = k_best_assignments(cost, np.concatenate([blocks[0][1], blocks[1][1]]), 2000)
    np.testing.assert_allclose(ranked.cost, expected, atol=1e-8)
