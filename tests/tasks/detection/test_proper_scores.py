"""Proper scores, by hand and against their definitions."""

import math

import numpy as np
import pytest
import torch
from scipy import integrate, stats

from foredrive.sets import BoxDensity, LabelledBoxes
from foredrive.tasks.detection.proper_scores import crps_gaussian, crps_laplace, energy_score, object_brier


def test_crps_is_the_integral_that_defines_it() -> None:
    for score, cdf in (
        (crps_gaussian, stats.norm(1.0, 0.7).cdf),
        (crps_laplace, stats.laplace(1.0, 0.7 / math.sqrt(2)).cdf),
    ):
        for value in (-0.5, 1.0, 1.3):
            below, _ = integrate.quad(lambda x, cdf=cdf: cdf(x) ** 2, -15, value)
            above, _ = integrate.quad(lambda x, cdf=cdf: (1 - cdf(x)) ** 2, value, 15)
            got = score(np.array([1.0]), np.array([0.7]), np.array([value]))
            assert got.item() == pytest.approx(below + above, abs=1e-6)


def test_the_energy_score_of_a_number_is_its_crps() -> None:
    std = torch.full((3, 1, 1), 0.7)
    said = BoxDensity(torch.ones(3, 1), std)
    truth = LabelledBoxes(torch.zeros(3, dtype=torch.long), torch.tensor([[-0.5], [1.0], [1.3]]))
    expected = crps_gaussian(np.ones(3), np.full(3, 0.7), np.array([-0.5, 1.0, 1.3]))
    got = energy_score(said, truth, np.random.default_rng(3), samples=20_000)
    np.testing.assert_allclose(got, expected, atol=0.02)


def test_object_level_error_by_hand() -> None:
    """Two detections of the first object say (0.6, 0.1) on average; nobody speaks of the second."""
    probability = np.array([[0.9, 0.0], [0.3, 0.2], [0.5, 0.5]])
    near = np.array([[True, False], [True, False], [False, False]])
    error = object_brier(probability, near, np.array([0, 1]))
    np.testing.assert_allclose(error, [0.4**2 + 0.1**2, 1.0])
