"""Probability-based detection quality: perfect, by hand, and as it should fall."""

import math

import numpy as np
import pytest

from foredrive.tasks.detection.pdq import PdqCounts, count_pdq, pdq, pixel_quality

BOX = np.array([[10.0, 10.0, 20.0, 30.0]])
SHARP = np.full((1, 4), 1e-3)
LABEL = np.array([1])


def quality(mean: np.ndarray, std: np.ndarray, p: float) -> float:
    return pixel_quality(mean, std, np.array([[1 - p, p]]), BOX, LABEL).item()


def test_sure_and_right_is_perfect_but_for_the_class() -> None:
    assert quality(BOX, SHARP, 1.0) == pytest.approx(1.0, abs=1e-6)
    assert quality(BOX, SHARP, 0.49) == pytest.approx(0.7, abs=1e-6)


def test_one_row_in_doubt_by_hand() -> None:
    """The lower edge at 29.5 ± σ passes through the middles of the last of 20 rows: they are in with 1/2."""
    shifted = np.array([[10.0, 10.0, 20.0, 29.5]])
    std = np.array([[1e-3, 1e-3, 1e-3, 0.01]])
    assert quality(shifted, std, 1.0) == pytest.approx(math.sqrt(math.exp(-math.log(2) / 20)), abs=1e-6)


def test_background_counts_as_much_as_foreground() -> None:
    """The same with a row too many, of which the detection is as unsure."""
    shifted = np.array([[10.0, 10.0, 20.0, 30.5]])
    std = np.array([[1e-3, 1e-3, 1e-3, 0.01]])
    assert quality(shifted, std, 1.0) == pytest.approx(math.sqrt(math.exp(-math.log(2) / 20)), abs=1e-6)


def test_a_shift_is_forgiven_to_those_who_doubt_themselves() -> None:
    shifted = BOX + np.array([3.0, 0.0, 3.0, 0.0])
    assert quality(shifted, np.full((1, 4), 3.0), 1.0) > 10 * quality(shifted, SHARP, 1.0)


def test_boxes_that_do_not_meet_are_false_and_missed() -> None:
    found = np.array([[40.0, 10.0, 50.0, 30.0], *BOX])
    values = pixel_quality(found, np.full((2, 4), 1e-3), np.tile([0.0, 1.0], (2, 1)), BOX, LABEL)
    counts = count_pdq(values)
    assert counts[1:] == (1, 1, 0)
    assert pdq([counts, PdqCounts(0.0, 0, 0, 2)]) == pytest.approx(0.25, abs=1e-6)
    assert math.isnan(pdq([]))
