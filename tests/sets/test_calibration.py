"""Calibration and conformal boxes: by hand, and against what they promise."""

import math

import numpy as np
import pytest
import torch
from scipy import stats

from foredrive.sets import BoxDensity, LabelledBoxes, MultiBernoulli, UniformPoisson
from foredrive.sets.calibration import (
    conformal_factor,
    conformal_scores,
    fit_existence,
    fit_scale,
    fit_set_calibration,
)
from foredrive.tasks.detection.proper_scores import brier
from foredrive.tasks.detection.reliability import reliability


def drawn_pairs(
    rng: np.random.Generator, n: int, factor: float, family: str = "gaussian"
) -> tuple[BoxDensity, LabelledBoxes]:
    """Densities, and boxes whose errors have `factor` times the stated standard deviations."""
    root = torch.as_tensor(rng.normal(size=(n, 3, 3)))
    chol = torch.linalg.cholesky(root @ root.mT + 0.3 * torch.eye(3))
    predicted = BoxDensity(torch.as_tensor(rng.normal(size=(n, 3))), chol, family=family)
    state, _ = BoxDensity(predicted.mean, factor * chol, family=family).sample(rng)
    return predicted, LabelledBoxes(torch.zeros(n, dtype=torch.long), state)


def test_isotonic_existence_by_hand() -> None:
    """0.2 happened, 0.4 did not: pooled to a half. Ends stay half an observation from 0 and 1."""
    fitted = fit_existence(np.array([0.1, 0.2, 0.4, 0.9]), np.array([False, True, False, True]))
    np.testing.assert_allclose(fitted(np.array([0.1, 0.2, 0.3, 0.4, 0.9])), [0.125, 0.5, 0.5, 0.5, 0.875])


def test_a_probability_weighs_as_often_as_it_was_said() -> None:
    """Three of 0.2 happened, one of 0.4 did not: pooled to three quarters."""
    fitted = fit_existence(np.array([0.2, 0.2, 0.2, 0.4]), np.array([True, True, True, False]))
    np.testing.assert_allclose(fitted(np.array([0.2, 0.4])), 0.75)


def test_overconfident_existence_is_calibrated() -> None:
    rng = np.random.default_rng(0)
    true = rng.uniform(0.02, 0.98, 20_000)
    predicted = stats.logistic.cdf(2 * stats.logistic.ppf(true))
    happened = rng.random(len(true)) < true
    fitted = fit_existence(predicted[::2], happened[::2])
    before, after = predicted[1::2], fitted(predicted[1::2])
    assert reliability(before, happened[1::2]).error > 0.08
    assert reliability(after, happened[1::2]).error < 0.02
    assert brier(after, happened[1::2]).mean() < brier(before, happened[1::2]).mean()


@pytest.mark.parametrize("family", ["gaussian", "laplace"])
def test_the_scale_of_covariances_is_found(family: str) -> None:
    predicted, truth = drawn_pairs(np.random.default_rng(1), 4000, 1.7, family)
    assert fit_scale(predicted, truth) == pytest.approx(1.7, rel=0.03)
    only = np.zeros(4000)
    only[0] = 2.0
    assert fit_scale(predicted, truth, only) == pytest.approx(fit_scale(predicted[:1], truth[:1]))


def test_conformal_boxes_cover_whatever_the_covariances_say() -> None:
    """A new object is covered with the stated probability, within 4 standard errors of both samples."""
    rng = np.random.default_rng(2)
    predicted, truth = drawn_pairs(rng, 6000, 2.5)
    q = conformal_factor(predicted[:3000], truth[:3000], 0.9)
    covered = conformal_scores(predicted[3000:], truth[3000:]) <= q
    assert covered.mean() == pytest.approx(0.9, abs=4 * math.sqrt(2 * 0.09 / 3000))
    assert conformal_factor(predicted[:5], truth[:5], 0.9) == math.inf


def test_a_detector_is_calibrated_by_frames_outside_its_training() -> None:
    """It says .9 and σ = 1 m where half of its objects exist and boxes err by 2 m."""
    rng = np.random.default_rng(6)
    predicted, true = [], []
    for _ in range(300):
        r = torch.full((4,), 0.9, dtype=torch.float64)
        place = 40.0 * torch.arange(4.0, dtype=torch.float64)[:, None].expand(4, 2)
        boxes = BoxDensity(
            place + 2.0 * torch.as_tensor(rng.normal(size=(4, 2))), torch.eye(2).expand(4, 2, 2)
        )
        predicted.append(MultiBernoulli(r.log(), torch.log1p(-r), torch.zeros(4, 1), boxes))
        exists = torch.as_tensor(rng.random(4) < 0.5)
        true.append(LabelledBoxes(torch.zeros(4, dtype=torch.long), place)[exists])
    region = torch.full((2,), 500.0)
    calibrate = fit_set_calibration(predicted, true, UniformPoisson(torch.tensor([1.0]), -region, region))
    calibrated = calibrate(predicted[0])
    assert calibrate.std_factor == pytest.approx(2.0, abs=0.15)
    np.testing.assert_allclose(calibrated.log_existence.exp(), 0.5, atol=0.06)
    np.testing.assert_allclose(calibrated.log_absence.exp(), 1 - calibrated.log_existence.exp())
    torch.testing.assert_close(calibrated.boxes.chol, calibrate.std_factor * predicted[0].boxes.chol)
