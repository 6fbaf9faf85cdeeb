"""Average precision on cases worked out by hand."""

import math

import numpy as np
import pytest

from foredrive.tasks.objects.matching import (
    average_precision_coco,
    average_precision_nuscenes,
    descending,
    match_greedily,
    mean_of_valid,
    overlaps,
)


def test_overlaps_by_hand() -> None:
    boxes = np.array([[0.0, 0.0, 2.0, 2.0], [0.0, 0.0, 0.0, 0.0]])
    others = np.array([[1.0, 0.0, 3.0, 2.0], [5.0, 5.0, 6.0, 6.0]])
    np.testing.assert_allclose(overlaps(boxes, others), [[1 / 3, 0.0], [0.0, 0.0]])


def test_the_best_scored_takes_its_object_first() -> None:
    """The second would be closer to the only object, but is scored lower."""
    closeness = np.array([[-1.5], [-0.5]])
    order = descending(np.array([0.9, 0.8]))
    assert match_greedily(order, closeness, -2.0).tolist() == [0, -1]
    assert match_greedily(order, closeness, -1.0).tolist() == [-1, 0]
    assert match_greedily(order[::-1], closeness, -2.0).tolist() == [-1, 0]
    assert match_greedily(order, np.zeros((2, 0)), 0.0).tolist() == [-1, -1]


def test_equal_scores_are_ordered_as_each_data_set_does() -> None:
    """COCO's sort is stable; the devkit's is reversed as a whole."""
    score = np.array([0.5, 0.9, 0.5])
    assert descending(score).tolist() == [1, 0, 2]
    assert descending(score, ties_reversed=True).tolist() == [1, 2, 0]
    hit = np.array([True, False, False])  # the hit comes second, or last
    assert average_precision_coco(score, hit, 1) == pytest.approx(1 / 2)
    # The precision rises linearly with recall, to 1/3: above 0.1 at recall 0.31 … 1, whose sum is 45.85.
    assert average_precision_nuscenes(score, hit, 1) == pytest.approx((45.85 / 3 - 70 * 0.1) / 90 / 0.9)


def test_average_precision_of_coco_by_hand() -> None:
    """Hit, false, hit of two objects: precision 1 up to recall .5, then 2/3."""
    score, hit = np.array([0.2, 0.9, 0.5]), np.array([True, True, False])
    assert average_precision_coco(score, hit, 2) == pytest.approx((51 + 50 * 2 / 3) / 101)
    assert average_precision_coco(score[:0], hit[:0], 2) == 0.0
    assert math.isnan(average_precision_coco(score, hit, 0))


def test_average_precision_of_nuscenes_by_hand() -> None:
    """All hits: precision 1 throughout. Half of the objects found: only recall up to .5 counts."""
    score, hit = np.array([0.9, 0.8]), np.array([True, True])
    assert average_precision_nuscenes(score, hit, 2) == pytest.approx(1.0)
    assert average_precision_nuscenes(score, hit, 4) == pytest.approx(40 / 90)
    assert average_precision_nuscenes(score, ~hit, 2) == 0.0


def test_classes_without_objects_do_not_count() -> None:
    assert mean_of_valid([0.5, math.nan]) == 0.5
    assert math.isnan(mean_of_valid([math.nan]))
