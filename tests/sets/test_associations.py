"""Sums over associations: equal to enumeration, bounded where not exact, located where zero."""

import itertools

import numpy as np
import pytest

from foredrive.errors import InputError
from foredrive.sets.associations import bound_component, sum_associations
from foredrive.sets.component import scale
from foredrive.sets.frontier import sum_assignments
from foredrive.sets.gating import bound_left_out


def enumerate_associations(
    log_pair: np.ndarray, log_absent: np.ndarray, log_background: np.ndarray
) -> tuple[float, np.ndarray]:
    """The logarithm of the sum and the probability of every pair, by listing all associations."""
    m, n = log_pair.shape
    logs, pairs = [], []
    for choice in itertools.product(range(-1, m), repeat=n):
        taken = [i for i in choice if i >= 0]
        if len(set(taken)) < len(taken):
            continue
        log = sum(log_background[j] if i < 0 else log_pair[i, j] for j, i in enumerate(choice))
        logs.append(log + sum(log_absent[i] for i in range(m) if i not in taken))
        pair = np.zeros((m, n))
        pair[taken, [j for j, i in enumerate(choice) if i >= 0]] = 1
        pairs.append(pair)
    top = max(logs)
    if top == -np.inf:
        return -np.inf, np.full((m, n), np.nan)
    weight = np.exp(np.array(logs) - top)
    return top + np.log(weight.sum()), np.tensordot(weight / weight.sum(), np.array(pairs), 1)


def random_scene(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Up to 5 detections and 4 objects on a line; some are certain, have no background or fit nothing."""
    m, n = rng.integers(0, 6), rng.integers(0, 5)
    spread = rng.choice([1.0, 5.0, 30.0])
    at, true = rng.normal(0, spread, m), rng.normal(0, spread, n)
    log_pair = -0.5 * (at[:, None] - true) ** 2 + np.log(rng.uniform(0.01, 1, (m, 1)))
    log_pair[rng.random((m, n)) < 0.1] = -np.inf
    log_absent = np.log1p(-rng.uniform(0, 1, m))
    log_absent[rng.random(m) < 0.05] = -np.inf
    log_background = rng.uniform(-12, 0, n)
    log_background[rng.random(n) < 0.1] = -np.inf
    return log_pair, log_absent, log_background


def test_equal_to_enumeration_in_2000_scenes() -> None:
    rng = np.random.default_rng(0)
    impossible = 0
    for _ in range(2000):
        scene = random_scene(rng)
        expected, pair = enumerate_associations(*scene)
        result = sum_associations(*scene)
        faults = len(result.impossible_detections) + len(result.impossible_objects)
        assert (faults > 0) == (expected == -np.inf)
        impossible += faults > 0
        if faults == 0:
            assert result.log_lower == pytest.approx(expected, abs=1e-9)
            assert result.log_lower <= expected + 1e-12 <= result.log_upper + 1e-11
            np.testing.assert_allclose(result.pair, pair, atol=1e-9)
    assert 100 < impossible < 1900


def test_the_best_associations_bound_the_sum_from_below_and_the_gap_from_above() -> None:
    rng = np.random.default_rng(1)
    missing: dict[int, list[float]] = {1: [], 3: [], 10_000: []}
    for _ in range(200):
        scene = random_scene(rng)
        expected, pair = enumerate_associations(*scene)
        if expected == -np.inf:
            continue
        for k in missing:
            for result in (bound_component(scale(*scene), k), sum_associations(*scene, k=k, max_states=0)):
                assert result.log_lower - 1e-9 <= expected <= result.log_upper + 1e-9
        for k, missed in missing.items():
            result = bound_component(scale(*scene), k)
            missed.append(expected - result.log_lower)
            if k == 10_000:  # all there are
                assert result.log_upper == pytest.approx(expected, abs=1e-9)
                assert result.log_lower == pytest.approx(expected, abs=1e-9)
                np.testing.assert_allclose(result.share, pair, atol=1e-9)
    assert np.mean(missing[1]) > np.mean(missing[3]) > np.mean(missing[10_000])


def test_gating_takes_off_no_more_than_it_says() -> None:
    rng = np.random.default_rng(2)
    lost = []
    for _ in range(300):
        scene = random_scene(rng)
        exact = sum_associations(*scene, gate_nats=1e-300)
        gated = sum_associations(*scene, gate_nats=0.3)
        if exact.log_lower > -np.inf:
            lost.append(exact.log_lower - gated.log_lower)
            assert -1e-9 <= lost[-1] <= gated.log_upper - gated.log_lower + 1e-9
            assert gated.log_upper - gated.log_lower <= 0.3 + 1e-9
    assert max(lost) > 1e-3


def test_what_left_out_pairs_add_is_bounded() -> None:
    """Whatever pairs are left out of scenes of any density; objects may have no background."""
    rng = np.random.default_rng(7)
    added, bound = [], []
    for _ in range(500):
        rows, columns = rng.integers(1, 7, 2)
        pair = rng.random((rows, columns)) ** rng.choice([1, 4, 16])
        alone, none = rng.uniform(0.01, 1, rows), rng.random(columns) * (rng.random(columns) < 0.8)
        kept = sum_assignments(np.where(rng.random(pair.shape) < 0.6, pair, 0.0), alone, none)
        if kept.log_total == -np.inf:
            continue
        row, column = np.nonzero((kept.pair == 0) & (pair > 0))
        log_weight = np.log(pair[row, column] / alone[row] * kept.column_freed[column])
        added.append(sum_assignments(pair, alone, none).log_total - kept.log_total)
        bound.append(bound_left_out(log_weight, row, column))
        assert added[-1] <= bound[-1] + 1e-12
    assert len(added) > 300
    assert np.median(np.array(bound) / np.maximum(added, 1e-3)) < 3  # and not by far


def test_distant_clusters_are_summed_exactly_however_many_they_are() -> None:
    """60 copies of one scene, far from each other, are 60 times its logarithm."""
    log_pair = np.log(np.array([[0.5, 0.2], [0.3, 0.4], [0.1, 0.6]]))
    log_absent, log_background = np.log([0.3, 0.5, 0.2]), np.log([0.01, 0.02])
    one, _ = enumerate_associations(log_pair, log_absent, log_background)
    apart = np.where(np.kron(np.eye(60), np.ones((3, 2))) > 0, np.tile(log_pair, (60, 60)), -np.inf)
    result = sum_associations(apart, np.tile(log_absent, 60), np.tile(log_background, 60))
    assert result.log_lower == pytest.approx(60 * one, abs=1e-9)
    assert result.log_upper == pytest.approx(60 * one, abs=1e-9)


def test_without_background_clusters_fall_apart_as_well() -> None:
    """30 pairs of detections with one object each: too many to be summed at once."""
    rng = np.random.default_rng(3)
    true = 100.0 * np.arange(30)
    at = np.repeat(true, 2) + rng.normal(size=60)
    log_pair = -0.5 * (at[:, None] - true) ** 2 - 1.0
    log_absent = np.log(rng.uniform(0.1, 0.9, 60))
    result = sum_associations(log_pair, log_absent, np.full(30, -np.inf))
    odds = np.exp(log_pair - log_absent[:, None]).reshape(30, 2, 30)
    expected = log_absent.sum() + np.log(odds[np.arange(30), :, np.arange(30)].sum(1)).sum()
    assert result.log_lower == pytest.approx(expected, abs=1e-9)
    assert 0 <= result.log_upper - result.log_lower <= 1e-9


def test_what_is_impossible_is_named() -> None:
    """Two certain detections of one object: one has none. Another object is explained by nothing."""
    certain, far = -np.inf, -np.inf
    result = sum_associations(
        np.array([[-1.0, far], [-2.0, far], [far, far]]),
        np.array([certain, certain, -0.1]),
        np.array([-3.0, far]),
    )
    assert result.log_lower == result.log_upper == -np.inf
    assert result.impossible_detections.tolist() == [1]  # detection 0 fits better
    assert result.impossible_objects.tolist() == [1]
    assert result.best.tolist() == [0, -1]


def test_a_certain_detection_is_never_traded_for_a_likelier_pair() -> None:
    """However unlikely the only object of a certain detection is: without it, the set is impossible."""
    result = sum_associations(np.array([[-1e6], [0.0]]), np.array([-np.inf, -1.0]), np.array([-2.0]))
    assert result.log_lower == pytest.approx(-1e6 - 1.0, abs=1e-9)
    assert result.best.tolist() == [0]


def test_wrong_weights_are_named() -> None:
    with pytest.raises(InputError, match=r"pair .*\(0, 1\) is nan"):
        sum_associations(np.array([[0.0, np.nan]]), np.zeros(1), np.zeros(2))
    with pytest.raises(InputError, match=r"background object \(1,\) is inf"):
        sum_associations(np.zeros((1, 2)), np.zeros(1), np.array([0.0, np.inf]))


def test_whatever_is_affordable_the_interval_holds_the_sum() -> None:
    """Dense scenes, with the exact value from ample memory: less and less of it widens, and never misses."""
    rng = np.random.default_rng(5)
    widths = []
    for certain in (False, True):
        at, true = rng.uniform(0, 6, 24), rng.uniform(0, 6, 12)
        log_pair = -0.5 * ((at[:, None] - true) / 0.7) ** 2
        log_absent = np.log(rng.uniform(0.1, 0.9, 24))
        log_background = np.full(12, -np.inf if certain else -3.0)
        exact = sum_associations(log_pair, log_absent, log_background, max_states=1 << 30)
        assert exact.log_upper - exact.log_lower <= 1e-9
        for max_states in (1 << 12, 1 << 7, 1 << 4, 0):
            result = sum_associations(log_pair, log_absent, log_background, max_states=max_states)
            assert result.log_lower <= exact.log_lower + 1e-9
            assert result.log_upper >= exact.log_upper - 1e-9
            widths.append(result.log_upper - result.log_lower)
            np.testing.assert_allclose(result.pair.sum(0) + result.background, 1.0, atol=1e-9)
    assert max(widths) > 1.0  # so that the bounds were put to the test
