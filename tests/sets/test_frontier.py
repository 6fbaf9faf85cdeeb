"""Sums over assignments by a moving frontier: against enumeration and closed forms, however large."""

import itertools
import math

import numpy as np
import pytest

from foredrive.sets.associations import bound_component, sum_associations
from foredrive.sets.component import scale
from foredrive.sets.frontier import plan_sweep, sum_assignments

ANY = 1 << 40


def enumerate_sum(
    pair: np.ndarray, row_alone: np.ndarray, column_alone: np.ndarray
) -> tuple[float, np.ndarray]:
    """The sum over all assignments, and what those with each pair add to it."""
    rows, columns = pair.shape
    total, shares = 0.0, np.zeros(pair.shape)
    for choice in itertools.product(range(-1, columns), repeat=rows):
        taken = [c for c in choice if c >= 0]
        if len(set(taken)) < len(taken):
            continue
        weight = math.prod(row_alone[r] if c < 0 else pair[r, c] for r, c in enumerate(choice))
        weight *= math.prod(column_alone[c] for c in range(columns) if c not in taken)
        total += weight
        for r, c in enumerate(choice):
            if c >= 0:
                shares[r, c] += weight
    return total, shares


def test_equal_to_enumeration_whatever_is_possible() -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        rows, columns = rng.integers(1, 6, 2)
        pair = rng.random((rows, columns)) ** 3 * (rng.random((rows, columns)) < rng.uniform(0.2, 1))
        row_alone = rng.random(rows) * (rng.random(rows) < 0.9)
        column_alone = rng.random(columns) * (rng.random(columns) < 0.9)
        expected, shares = enumerate_sum(pair, row_alone, column_alone)
        got = sum_assignments(pair, row_alone, column_alone)
        if expected == 0:
            assert got.log_total == -np.inf
            assert (got.pair == 0).all()
        else:
            assert got.log_total == pytest.approx(math.log(expected), abs=1e-12)
            np.testing.assert_allclose(got.pair, shares / expected, atol=1e-12)
            for r in range(rows):
                rest, _ = enumerate_sum(np.delete(pair, r, 0), np.delete(row_alone, r), column_alone)
                assert got.row_freed[r] == pytest.approx(rest / expected, rel=1e-9)
            for c in range(columns):
                rest, _ = enumerate_sum(np.delete(pair, c, 1), row_alone, np.delete(column_alone, c))
                assert got.column_freed[c] == pytest.approx(rest / expected, rel=1e-9)


def test_a_long_chain_has_a_narrow_frontier() -> None:
    """Row n may take columns n and n + 1, all weights 1: Z_n = 3 Z_{n-1} - Z_{n-2}, in whatever order."""
    n = 400
    rng = np.random.default_rng(1)
    pair = (np.eye(n, n + 1) + np.eye(n, n + 1, 1))[rng.permutation(n)][:, rng.permutation(n + 1)]
    sweep = plan_sweep(pair > 0, ANY)
    assert sweep.size.max() <= 8
    log_z, ratio = 0.0, 3.0  # Z_1 / Z_0
    for _ in range(n):
        log_z += math.log(ratio)
        ratio = 3.0 - 1.0 / ratio
    got = sum_assignments(pair, np.ones(n), np.ones(n + 1))
    assert got.log_total == pytest.approx(log_z, rel=1e-12)
    assert (got.pair.sum(1) < 1).all()


def test_sums_that_no_float_could_hold() -> None:
    """500 rows, each with a column of its own, of weight 1e100 or 1e-100 in turn."""
    weight = np.where(np.arange(500) % 2 == 0, 1e100, 1e-100)
    got = sum_assignments(np.diag(weight), np.zeros(500), np.ones(500))
    assert got.log_total == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(got.pair, np.eye(500))


def test_a_plan_stops_where_it_needs_too_much() -> None:
    assert plan_sweep(np.ones((30, 30), bool), 1 << 20).states > 1 << 20
    assert plan_sweep(np.ones((30, 3), bool), 1 << 20).states == 29 * 8 + 8


def test_a_street_of_objects_is_summed_exactly() -> None:
    """300 detections of 200 objects along a line, in one component: nothing but gating is left in doubt."""
    rng = np.random.default_rng(2)
    true = np.arange(200.0)
    at = rng.choice(true, 300) + rng.normal(0, 0.2, 300)
    log_pair = -0.5 * ((at[:, None] - true) / 0.2) ** 2
    log_absent, log_background = np.full(300, -1.0), np.full(200, -5.0)
    result = sum_associations(log_pair, log_absent, log_background)
    assert 0 <= result.log_upper - result.log_lower <= 1e-6
    part = bound_component(scale(log_pair, log_absent, log_background), 25)
    assert part.log_lower < result.log_lower - 1  # what listing associations misses
    assert part.log_upper > result.log_upper


def test_bounds_hold_where_the_sum_is_known() -> None:
    """All pairs alike and nobody alone: the sum is the number of permutations."""
    n = 8
    ones, never = np.zeros((n, n)), np.full(n, -np.inf)
    part = bound_component(scale(ones, never, never), 100)
    assert part.log_lower == pytest.approx(math.log(100), abs=1e-9)
    assert math.lgamma(n + 1) <= part.log_upper <= n * math.log(n) + 1e-9
