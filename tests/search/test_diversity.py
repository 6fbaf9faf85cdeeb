"""Choosing few that differ, or that stand for many."""

import itertools

import numpy as np
import pytest

from foredrive.search.find import facility_location, k_centre


def on_circle(*degrees: float) -> np.ndarray:
    angle = np.deg2rad(degrees)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def test_k_centre_goes_to_the_farthest() -> None:
    vectors = on_circle(0, 10, 170, 90)
    assert k_centre(vectors, 3, np.array([1.0, 0.9, 0.9, 0.9])) == [0, 2, 3]
    assert k_centre(vectors, 9, np.ones(4)) == [0, 2, 3, 1]


def test_worth_weighs_distance() -> None:
    vectors = on_circle(0, 60, 180)
    assert k_centre(vectors, 2, np.array([1.0, 0.9, 0.1])) == [0, 1]  # 1 · 0.9 m against 2 · 0.1


def test_facility_location_takes_what_stands_for_most() -> None:
    vectors = on_circle(0, 5, 10, 180)
    assert facility_location(vectors, 2, np.ones(4)) == [1, 3]
    assert facility_location(vectors, 1, np.array([0.01, 0.01, 0.01, 9.0])) == [3]


def test_greedy_choices_are_as_good_as_proven() -> None:
    rng = np.random.default_rng(3)
    vectors = rng.normal(size=(9, 3))
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    distance = np.sqrt(np.maximum(2 - 2 * vectors @ vectors.T, 0))
    likeness = (1 + vectors @ vectors.T) / 2

    def radius(chosen: tuple[int, ...] | list[int]) -> float:
        return float(distance[:, list(chosen)].min(1).max())

    def covered(chosen: tuple[int, ...] | list[int]) -> float:
        return float(likeness[:, list(chosen)].max(1).sum())

    triples = list(itertools.combinations(range(9), 3))
    assert radius(k_centre(vectors, 3, np.ones(9))) <= 2 * min(map(radius, triples)) + 1e-9
    greedy = covered(facility_location(vectors, 3, np.ones(9)))
    assert greedy >= (1 - 1 / np.e) * max(map(covered, triples))


@pytest.mark.parametrize("choose", [k_centre, facility_location])
def test_of_none_none_are_chosen(choose: object) -> None:
    assert choose(np.zeros((0, 4)), 3, np.zeros(0)) == []
