"""Calibration, proper scores, conformal boxes and resampling: by hand, and against what they promise."""

import math

import numpy as np
import pytest
import torch
from scipy import integrate, stats

from foredrive.errors import InputError
from foredrive.sets import BoxDensity, LabelledBoxes, MultiBernoulli, UniformPoisson
from foredrive.sets.calibration import (
    conformal_factor,
    conformal_scores,
    fit_existence,
    fit_scale,
    fit_set_calibration,
    reliability,
)
from foredrive.sets.proper_scores import brier, crps_gaussian, crps_laplace, energy_score, object_brier
from foredrive.sets.resampling import bootstrap_mean


def drawn_pairs(
    rng: np.random.Generator, n: int, factor: float, family: str = "gaussian"
) -> tuple[BoxDensity, LabelledBoxes]:
    """Densities, and boxes whose errors have `factor` times the stated standard deviations."""
    root = torch.as_tensor(rng.normal(size=(n, 3, 3)))
    chol = torch.linalg.cholesky(root @ root.mT + 0.3 * torch.eye(3))
    said = BoxDensity(torch.as_tensor(rng.normal(size=(n, 3))), chol, family=family)
    state, _ = BoxDensity(said.mean, factor * chol, family=family).sample(rng)
    return said, LabelledBoxes(torch.zeros(n, dtype=torch.long), state)


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


def test_isotonic_existence_by_hand() -> None:
    """0.2 happened, 0.4 did not: pooled to a half. Ends stay half an observation from 0 and 1."""
    fitted = fit_existence(np.array([0.1, 0.2, 0.4, 0.9]), np.array([False, True, False, True]))
    np.testing.assert_allclose(fitted(np.array([0.1, 0.2, 0.3, 0.4, 0.9])), [0.125, 0.5, 0.5, 0.5, 0.875])


def test_existence_that_was_too_sure_is_mended() -> None:
    rng = np.random.default_rng(0)
    true = rng.uniform(0.02, 0.98, 20_000)
    said = stats.logistic.cdf(2 * stats.logistic.ppf(true))
    happened = rng.random(len(true)) < true
    fitted = fit_existence(said[::2], happened[::2])
    before, after = said[1::2], fitted(said[1::2])
    assert reliability(before, happened[1::2]).error > 0.08
    assert reliability(after, happened[1::2]).error < 0.02
    assert brier(after, happened[1::2]).mean() < brier(before, happened[1::2]).mean()


@pytest.mark.parametrize("family", ["gaussian", "laplace"])
def test_the_scale_of_covariances_is_found(family: str) -> None:
    said, truth = drawn_pairs(np.random.default_rng(1), 4000, 1.7, family)
    assert fit_scale(said, truth) == pytest.approx(1.7, rel=0.03)
    only = np.zeros(4000)
    only[0] = 2.0
    assert fit_scale(said, truth, only) == pytest.approx(fit_scale(said[:1], truth[:1]))


def test_conformal_boxes_cover_whatever_the_covariances_say() -> None:
    """A new object is covered with the stated probability, within 4 standard errors of both samples."""
    rng = np.random.default_rng(2)
    said, truth = drawn_pairs(rng, 6000, 2.5)
    q = conformal_factor(said[:3000], truth[:3000], 0.9)
    covered = conformal_scores(said[3000:], truth[3000:]) <= q
    assert covered.mean() == pytest.approx(0.9, abs=4 * math.sqrt(2 * 0.09 / 3000))
    assert conformal_factor(said[:5], truth[:5], 0.9) == math.inf


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


def test_bootstrap_draws_whole_sequences() -> None:
    """Ten sequences of fifty equal frames: the interval is that of ten values, not of five hundred."""
    rng = np.random.default_rng(4)
    level = rng.normal(1.0, 1.0, 10)
    names = [f"s{n}" for n in range(10) for _ in range(50)]
    result = bootstrap_mean(np.repeat(level, 50), names, rng)
    assert result.mean == pytest.approx(level.mean())
    half = 1.96 * level.std() / math.sqrt(10)
    assert (result.high - result.low) / 2 == pytest.approx(half, rel=0.15)
    assert result.low < result.mean < result.high


def test_p_values_are_small_where_the_mean_is_far_from_0() -> None:
    rng = np.random.default_rng(5)
    names = [str(n) for n in range(40)]
    assert bootstrap_mean(rng.normal(1.0, 1.0, 40), names, rng).p_value < 0.01
    values = rng.normal(0.0, 1.0, 40)
    assert bootstrap_mean(values - values.mean(), names, rng).p_value > 0.5
    few = bootstrap_mean(np.ones(30), ["a", "b", "c"] * 10, rng)
    assert few.p_value == pytest.approx(2 * 0.5**3, abs=0.05)  # however many frames: all signs alike
    assert bootstrap_mean(np.zeros(30), ["a", "b", "c"] * 10, rng).p_value == 1.0
    one = bootstrap_mean(np.ones(3), ["a"] * 3, rng)
    assert one.mean == 1.0
    assert math.isnan(one.low)
    with pytest.raises(InputError, match="finite"):
        bootstrap_mean(np.array([np.inf]), ["a"], rng)


def test_object_level_error_by_hand() -> None:
    """Two detections of the first object say (0.6, 0.1) on average; nobody speaks of the second."""
    probability = np.array([[0.9, 0.0], [0.3, 0.2], [0.5, 0.5]])
    near = np.array([[True, False], [True, False], [False, False]])
    error = object_brier(probability, near, np.array([0, 1]))
    np.testing.assert_allclose(error, [0.4**2 + 0.1**2, 1.0])


def test_a_detector_is_mended_by_frames_apart() -> None:
    """It says .9 and σ = 1 m where half of its objects exist and boxes err by 2 m."""
    rng = np.random.default_rng(6)
    said, true = [], []
    for _ in range(300):
        r = torch.full((4,), 0.9, dtype=torch.float64)
        place = 40.0 * torch.arange(4.0, dtype=torch.float64)[:, None].expand(4, 2)
        boxes = BoxDensity(
            place + 2.0 * torch.as_tensor(rng.normal(size=(4, 2))), torch.eye(2).expand(4, 2, 2)
        )
        said.append(MultiBernoulli(r.log(), torch.log1p(-r), torch.zeros(4, 1), boxes))
        exists = torch.as_tensor(rng.random(4) < 0.5)
        true.append(LabelledBoxes(torch.zeros(4, dtype=torch.long), place)[exists])
    region = torch.full((2,), 500.0)
    mend = fit_set_calibration(said, true, UniformPoisson(torch.tensor([1.0]), -region, region))
    mended = mend(said[0])
    assert mend.std_factor == pytest.approx(2.0, abs=0.15)
    np.testing.assert_allclose(mended.log_existence.exp(), 0.5, atol=0.06)
    np.testing.assert_allclose(mended.log_absence.exp(), 1 - mended.log_existence.exp())
    torch.testing.assert_close(mended.boxes.chol, mend.std_factor * said[0].boxes.chol)
