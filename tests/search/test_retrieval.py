"""Ranks and means over sequences, by hand and drawn again."""

import numpy as np
import pytest

from foredrive.search.retrieval import draw_sequences, match_rank, mean_and_interval, mean_of_groups


def test_draws_begin_with_all_sequences_and_bounds_hold_what_varies() -> None:
    drawn = draw_sequences(8, 500, seed=0)
    assert drawn.shape == (501, 8)
    assert drawn[0].tolist() == list(range(8))
    assert set(drawn[1:].ravel()) == set(range(8))
    share = np.array([1.0, 1, 1, 1, 0, 0, 0, 0])
    value, low, high = mean_and_interval(share[drawn].mean(axis=1))
    assert value == 0.5
    # the standard error of a mean of 8 is 0.18
    assert low == pytest.approx(0.125, abs=0.07)
    assert high == pytest.approx(0.875, abs=0.07)
    alike = np.full(8, 0.25)[drawn].mean(axis=1)
    assert mean_and_interval(alike) == (0.25, 0.25, 0.25)


def test_the_rank_of_the_own_item_counts_those_as_similar() -> None:
    gallery = np.eye(3)
    queries = np.array([[1.0, 0, 0], [0.8, 0.6, 0], [0, 0.6, 0.6]])
    np.testing.assert_array_equal(match_rank(queries, gallery), [1, 2, 2])  # right, beaten, a tie
    many = np.random.default_rng(0).normal(size=(1500, 8))
    many /= np.linalg.norm(many, axis=1, keepdims=True)
    assert (match_rank(many, many) == 1).all()


def test_a_mean_of_groups_by_hand() -> None:
    values, group, sequence = np.array([1.0, 0, 0, 1]), np.array([0, 0, 0, 1]), np.array([0, 0, 1, 1])
    drawn = np.array([[0, 1], [0, 0], [1, 1]])
    expected = [(1 / 3 + 1) / 2, 1 / 2, (0 + 1) / 2]  # the first sequence has nothing of the second group
    np.testing.assert_allclose(mean_of_groups(values, group, sequence, drawn), expected)
