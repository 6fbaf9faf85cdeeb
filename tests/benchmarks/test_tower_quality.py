"""Towers judged on views: average precision, naming without training."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_towers import PlainTowers

from benchmarks.common.tower_quality import average_precision
from foredrive.search.zero_shot import class_vectors, classify


def test_average_precision_by_hand() -> None:
    scores = np.array([0.9, 0.8, 0.7, 0.6])
    assert average_precision(scores, np.array([True, False, True, False])) == pytest.approx((1 + 2 / 3) / 2)
    assert average_precision(scores, np.array([False, False, False, True])) == pytest.approx(1 / 4)
    assert average_precision(scores, np.array([True, True, False, False])) == 1


@given(st.lists(st.booleans(), min_size=1, max_size=20).filter(any), st.integers(0, 99))
@settings(max_examples=40, deadline=None)
def test_no_order_is_better_than_the_right_one(true: list[bool], seed: int) -> None:
    truth = np.array(true)
    scores = np.random.default_rng(seed).random(len(true))
    assert average_precision(scores, truth) <= average_precision(truth.astype(float), truth) == 1


def test_views_are_named_by_the_texts_nearest_to_them() -> None:
    towers = PlainTowers()
    classes = class_vectors(towers, {"red": ("red", "a red thing"), "blue": ("blue",)})
    assert classes.shape == (2, 4)
    torch.testing.assert_close(classes.norm(dim=-1), torch.ones(2))
    images = torch.zeros(3, 3, 4, 4, dtype=torch.uint8)
    images[0, 0], images[1, 2], images[2, 0] = 200, 100, 90
    assert classify(towers.embed_images(images), classes).tolist() == [0, 1, 0]
