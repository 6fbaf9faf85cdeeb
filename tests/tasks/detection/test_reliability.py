"""Reliability diagrams by hand."""

import math

import numpy as np
import pytest

from foredrive.tasks.detection.reliability import reliability


def test_reliability_by_hand() -> None:
    """Bins of a half: {0.2, 0.5 (its upper edge)} hit once, {0.9} hit: (2·|0.5 - 0.35| + |1 - 0.9|) / 3."""
    result = reliability(np.array([0.2, 0.5, 0.9]), np.array([True, False, True]), 2)
    assert result.count.tolist() == [2, 1]
    np.testing.assert_allclose(result.confidence, [0.35, 0.9])
    np.testing.assert_allclose(result.outcome, [0.5, 1.0])
    assert result.error == pytest.approx(0.4 / 3)


def test_bins_without_detections_count_for_nothing() -> None:
    result = reliability(np.array([0.0, 1.0]), np.array([0.0, 0.7]), 10)
    assert result.count.tolist() == [1, 0, 0, 0, 0, 0, 0, 0, 0, 1]
    assert result.error == pytest.approx(0.15)
    assert math.isnan(reliability(np.zeros(0), np.zeros(0)).error)
