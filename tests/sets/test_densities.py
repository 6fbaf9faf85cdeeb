"""Densities of boxes and sets against SciPy, PyTorch and values by hand; samples against densities."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy import stats

from foredrive.errors import InputError
from foredrive.sets import (
    BoxDensity,
    LabelledBoxes,
    MixturePoisson,
    MultiBernoulli,
    PoissonMultiBernoulli,
    SumPoisson,
    UniformPoisson,
    poisson_log_prob,
    set_nll,
)


def box_density(rng: np.random.Generator, m: int, dims: int, *, yaw: bool, family: str) -> BoxDensity:
    root = torch.as_tensor(rng.normal(size=(m, dims, dims)))
    return BoxDensity(
        mean=torch.as_tensor(rng.normal(size=(m, dims))),
        chol=torch.linalg.cholesky(root @ root.mT + 0.3 * torch.eye(dims)),
        yaw=torch.as_tensor(rng.uniform(-3, 3, m)) if yaw else None,
        concentration=torch.as_tensor(rng.uniform(0, 30, m)) if yaw else None,
        family=family,
    )


def objects(rng: np.random.Generator, n: int, dims: int, *, yaw: bool) -> LabelledBoxes:
    return LabelledBoxes(
        label=torch.as_tensor(rng.integers(0, 3, n)),
        state=torch.as_tensor(rng.normal(size=(n, dims))),
        yaw=torch.as_tensor(rng.uniform(-9, 9, n)) if yaw else None,
    )


def test_gaussian_boxes_with_a_heading() -> None:
    rng = np.random.default_rng(0)
    density, truth = box_density(rng, 4, 6, yaw=True, family="gaussian"), objects(rng, 5, 6, yaw=True)
    got = density.log_prob(truth)
    for i in range(4):
        linear = torch.distributions.MultivariateNormal(density.mean[i], scale_tril=density.chol[i])
        heading = stats.vonmises(density.concentration[i].item(), loc=density.yaw[i].item())
        expected = linear.log_prob(truth.state) + torch.as_tensor(heading.logpdf(truth.yaw.numpy()))
        torch.testing.assert_close(got[i], expected, atol=1e-11, rtol=0)


def test_laplace_boxes_of_the_stated_standard_deviation() -> None:
    """Diagonal: scale σ/√2 per coordinate. Full: the density integrates to 1 and has the covariance L Lᵀ."""
    std = torch.tensor([[0.5, 2.0, 3.0, 1.0]], dtype=torch.float64)
    density = BoxDensity(torch.zeros(1, 4).double(), torch.diag_embed(std), family="laplace")
    at = torch.tensor([[0.1, -3.0, 0.0, 2.0]], dtype=torch.float64)
    expected = stats.laplace(scale=std[0].numpy() / math.sqrt(2)).logpdf(at[0].numpy()).sum()
    got = density.log_prob(LabelledBoxes(torch.zeros(1, dtype=torch.long), at))
    assert got.item() == pytest.approx(expected, abs=1e-12)

    chol = torch.tensor([[[1.0, 0.0], [0.7, 0.5]]], dtype=torch.float64)
    grid = torch.arange(-15, 15, 0.02, dtype=torch.float64)
    points = torch.cartesian_prod(grid, grid)
    boxes = LabelledBoxes(torch.zeros(len(points), dtype=torch.long), points)
    mass = BoxDensity(torch.zeros(1, 2).double(), chol, family="laplace").log_prob(boxes)[0].exp() * 0.02**2
    assert mass.sum().item() == pytest.approx(1, abs=1e-3)
    torch.testing.assert_close((points * mass[:, None]).mT @ points, chol[0] @ chol[0].mT, atol=3e-3, rtol=0)


def test_the_heading_is_on_the_circle_at_any_concentration() -> None:
    yaw = torch.linspace(-math.pi, math.pi, 20_001, dtype=torch.float64)[:-1]
    boxes = LabelledBoxes(torch.zeros(len(yaw), dtype=torch.long), torch.zeros(len(yaw), 1), yaw)
    kappa = torch.tensor([0.0, 1.0, 1e3, 1e5], dtype=torch.float64)
    ones = torch.ones(4, 1, 1)
    density = BoxDensity(torch.zeros(4, 1), ones, yaw=torch.full((4,), 3.0), concentration=kappa)
    at_zero = 0.5 * math.log(2 * math.pi)
    mass = (density.log_prob(boxes) + at_zero).exp().sum(-1) * (2 * math.pi / len(yaw))
    torch.testing.assert_close(mass, torch.ones(4, dtype=torch.float64), atol=1e-6, rtol=0)
    turned = dataclasses.replace(boxes, yaw=yaw + 2 * math.pi)
    torch.testing.assert_close(density.log_prob(boxes), density.log_prob(turned), atol=1e-6, rtol=0)


def test_frames_of_a_batch_are_as_they_are_alone() -> None:
    rng = np.random.default_rng(3)
    frames = [
        (box_density(rng, 3, 6, yaw=True, family="laplace"), objects(rng, 2, 6, yaw=True)) for _ in range(2)
    ]

    def stack(name: str, of: int) -> torch.Tensor:
        return torch.stack([getattr(frame[of], name) for frame in frames])

    density = BoxDensity(
        *(stack(name, 0) for name in ("mean", "chol", "yaw", "concentration")), family="laplace"
    )
    batch = density.log_prob(LabelledBoxes(*(stack(name, 1) for name in ("label", "state", "yaw"))))
    for got, (alone, truth) in zip(batch, frames, strict=True):
        torch.testing.assert_close(got, alone.log_prob(truth))


@pytest.mark.parametrize("family", ["gaussian", "laplace"])
def test_samples_have_the_moments_of_the_density(family: str) -> None:
    rng = np.random.default_rng(4)
    one = box_density(rng, 1, 3, yaw=True, family=family)
    state, yaw = one[torch.zeros(200_000, dtype=torch.long)].sample(rng)
    covariance = one.chol[0] @ one.chol[0].mT
    tolerance = 0.03 * covariance.diagonal().max().item()
    torch.testing.assert_close(state.mean(0), one.mean[0], atol=tolerance, rtol=0)
    torch.testing.assert_close(torch.cov(state.mT), covariance, atol=tolerance, rtol=0)
    kappa = one.concentration[0]
    expected = (torch.special.i1e(kappa) / torch.special.i0e(kappa)).item()
    assert (yaw - one.yaw[0]).cos().mean().item() == pytest.approx(expected, abs=0.01)


def test_softmax_and_sigmoid_detectors() -> None:
    boxes = BoxDensity(torch.zeros(1, 1), torch.ones(1, 1, 1))
    soft = MultiBernoulli.from_softmax(torch.tensor([[0.2, 0.3, 0.5]]).log(), boxes)
    assert soft.log_existence.exp().item() == pytest.approx(0.5)
    assert soft.log_absence.exp().item() == pytest.approx(0.5)
    assert soft.log_class.exp()[0].tolist() == pytest.approx([0.4, 0.6])
    sigmoid = MultiBernoulli.from_sigmoid(torch.logit(torch.tensor([[0.2, 0.6]])), boxes)
    assert sigmoid.log_existence.exp().item() == pytest.approx(0.6)
    assert sigmoid.log_absence.exp().item() == pytest.approx(0.4)
    assert sigmoid.log_class.exp()[0].tolist() == pytest.approx([0.25, 0.75])
    sure = MultiBernoulli.from_sigmoid(torch.tensor([[60.0, -60.0]]), boxes)
    assert sure.log_absence.item() == pytest.approx(-60)  # 1 - r is 0 in float64


def test_two_readings_of_one_sigmoid_per_class() -> None:
    """80 classes, top score .90, others .01: r · p(c) is s_c as published; ours shares r = .90 by scores."""
    scores = torch.full((1, 80), 0.01, dtype=torch.float64)
    scores[0, 3] = 0.90
    boxes = BoxDensity(torch.zeros(1, 1), torch.ones(1, 1, 1))
    ours, published = (
        MultiBernoulli.from_sigmoid(torch.logit(scores), boxes, classes)
        for classes in ("normalised", "published")
    )
    peak = stats.norm.logpdf(0)
    for label, share in ((3, 0.90), (7, 0.01)):
        truth = LabelledBoxes(torch.tensor([label]), torch.zeros(1, 1))
        nll = [set_nll(PoissonMultiBernoulli(found), truth).nll.item() for found in (ours, published)]
        assert nll[0] == pytest.approx(-math.log(0.90 * share / (0.90 + 79 * 0.01)) - peak, abs=1e-9)
        assert nll[1] == pytest.approx(-math.log(share) - peak, abs=1e-9)
        assert nll[0] - nll[1] == pytest.approx(0.630, abs=5e-4)
    for found in (ours, published):  # a detection without an object costs -log(1 - r)
        none = set_nll(PoissonMultiBernoulli(found), truth[:0]).nll
        assert none.item() == pytest.approx(-math.log(0.10), abs=1e-9)
    mixtures = [
        PoissonMultiBernoulli.from_detections(found, confidence=0.95).background
        for found in (ours, published)
    ]
    one, other = (mixture.log_intensity(truth).item() for mixture in mixtures if mixture is not None)
    assert one == pytest.approx(other, abs=1e-12)  # the Poisson process has normalised classes in both
    with pytest.raises(InputError, match="cannot be drawn"):
        published.sample(np.random.default_rng(0))


def test_poisson_densities_by_hand() -> None:
    """Uniform: rates 2 and 3 on [0, 4] × [0, 5], so λ is 0.1 and 0.15. Mixture: both components."""
    uniform = UniformPoisson(torch.tensor([2.0, 3.0]), torch.zeros(2), torch.tensor([4.0, 5.0]))
    truth = LabelledBoxes(torch.tensor([0, 1, 1]), torch.tensor([[1.0, 1.0], [4.0, 5.0], [0.5, 2.0]]))
    assert poisson_log_prob(uniform, truth).item() == pytest.approx(math.log(0.1 * 0.15**2) - 5)
    outside = LabelledBoxes(torch.tensor([0]), torch.tensor([[1.0, 5.1]]))
    assert poisson_log_prob(uniform, outside).item() == -math.inf
    assert poisson_log_prob(uniform, truth[:0]).item() == -5

    boxes = BoxDensity(torch.tensor([[0.0], [1.0]]), torch.ones(2, 1, 1))
    mixture = MixturePoisson(
        torch.tensor([0.05, 0.1]).log(), torch.tensor([[0.5, 0.5], [0.2, 0.8]]).log(), boxes
    )
    peak, side = stats.norm.pdf(0), stats.norm.pdf(1)
    one = LabelledBoxes(torch.tensor([1]), torch.tensor([[0.0]]))
    expected = math.log(0.05 * 0.5 * peak + 0.1 * 0.8 * side)
    assert mixture.log_intensity(one).item() == pytest.approx(expected, abs=1e-6)
    assert mixture.expected_count.item() == pytest.approx(0.15)


def test_sets_have_the_size_and_classes_of_their_process() -> None:
    rng = np.random.default_rng(5)
    boxes = BoxDensity(torch.zeros(2, 2), torch.eye(2).expand(2, 2, 2))
    found = MultiBernoulli(
        torch.tensor([0.9, 0.3]).log(),
        torch.tensor([0.1, 0.7]).log(),
        torch.tensor([[0.8, 0.2], [0.0, 1.0]]).log(),
        boxes,
    )
    pmb = PoissonMultiBernoulli(
        found, UniformPoisson(torch.tensor([0.5, 0.25]), -torch.ones(2), torch.ones(2))
    )
    sets = [pmb.sample(rng) for _ in range(2000)]
    sizes = np.array([len(s.label) for s in sets])
    assert sizes.mean() == pytest.approx(1.95, abs=0.06)
    assert sizes.var() == pytest.approx(0.09 + 0.21 + 0.75, abs=0.1)
    ones = np.mean([(s.label == 1).sum().item() for s in sets])
    assert ones == pytest.approx(0.9 * 0.2 + 0.3 + 0.25, abs=0.05)


def test_low_confidence_becomes_background() -> None:
    boxes = BoxDensity(torch.arange(3.0)[:, None], torch.ones(3, 1, 1))
    r = torch.tensor([0.9, 0.05, 0.08])
    pmb = PoissonMultiBernoulli.from_detections(
        MultiBernoulli(r.log(), (1 - r).log(), torch.zeros(3, 1), boxes)
    )
    assert pmb.detected.boxes.mean.tolist() == [[0.0]]
    assert pmb.background is not None
    assert pmb.background.expected_count.item() == pytest.approx(0.13)


def test_what_is_no_density_is_named() -> None:
    chol = torch.eye(2).repeat(3, 1, 1)
    chol[2, 1, 1] = 0.0
    with pytest.raises(InputError, match=r"positive definite.*\(2,\)"):
        BoxDensity(torch.zeros(3, 2), chol)
    good = BoxDensity(torch.zeros(2, 1), torch.ones(2, 1, 1))
    with pytest.raises(InputError, match=r"existence.*\(1,\)"):
        MultiBernoulli(torch.tensor([-1.0, 0.5]), torch.tensor([-0.4587, -1.0]), torch.zeros(2, 1), good)
    with pytest.raises(InputError, match=r"state of object \(1,\)"):
        good.log_prob(LabelledBoxes(torch.tensor([0, 0]), torch.tensor([[0.0], [math.nan]])))
    found = MultiBernoulli.from_softmax(torch.zeros(2, 3), good)
    with pytest.raises(InputError, match=r"object \(0,\) has label 7"):
        found.log_label(LabelledBoxes(torch.tensor([7]), torch.zeros(1, 1)))


@pytest.mark.parametrize("family", ["gaussian", "laplace"])
@pytest.mark.parametrize("yaw", [False, True])
def test_densities_without_gradients_and_of_pairs_are_those_with(family: str, yaw: bool) -> None:
    rng = np.random.default_rng(7)
    density, truth = box_density(rng, 9, 5, yaw=yaw, family=family), objects(rng, 7, 5, yaw=yaw)
    expected = dataclasses.replace(density, mean=density.mean.clone().requires_grad_()).log_prob(truth)
    assert expected.requires_grad
    torch.testing.assert_close(density.log_prob(truth), expected.detach(), atol=1e-11, rtol=1e-12)
    i, j = torch.tensor([0, 8, 3, 3]), torch.tensor([6, 0, 2, 2])
    torch.testing.assert_close(density.log_prob_of_pairs(i, truth, j), expected[i, j].detach())


def test_intensities_without_gradients_are_those_with() -> None:
    rng = np.random.default_rng(8)
    log_rate, log_class = torch.as_tensor(rng.normal(size=6)), torch.zeros(6, 3).log_softmax(-1)
    log_class[2, 1] = -math.inf
    process = MixturePoisson(log_rate, log_class, box_density(rng, 6, 3, yaw=False, family="gaussian"))
    truth = objects(rng, 20, 3, yaw=False)
    learning = dataclasses.replace(process, log_rate=log_rate.clone().requires_grad_())
    expected = learning.log_intensity(truth).detach()
    torch.testing.assert_close(process.log_intensity(truth), expected, atol=1e-12, rtol=1e-12)


def test_a_sum_of_poisson_processes_has_the_sum_of_intensities() -> None:
    rng = np.random.default_rng(9)
    box = torch.full((2,), 4.0)
    uniform = UniformPoisson(torch.tensor([2.0, 0.0, 1.0]), -box, box)
    cloud = MixturePoisson(
        torch.tensor([0.5]).log(),
        torch.zeros(1, 3).log_softmax(-1),
        box_density(rng, 1, 2, yaw=False, family="gaussian"),
    )
    both, truth = SumPoisson((uniform, cloud)), objects(rng, 6, 2, yaw=False)
    expected = uniform.log_intensity(truth).exp() + cloud.log_intensity(truth).exp()
    torch.testing.assert_close(both.log_intensity(truth).exp(), expected)
    assert both.expected_count.item() == pytest.approx(3.5)
    counts = [len(both.sample(rng).label) for _ in range(2000)]
    assert np.mean(counts) == pytest.approx(3.5, abs=4 * math.sqrt(3.5 / 2000))


def test_unsure_detections_become_background_beside_another() -> None:
    rng = np.random.default_rng(10)
    r = torch.tensor([0.9, 0.05, 0.1], dtype=torch.float64)
    boxes = box_density(rng, 3, 2, yaw=False, family="gaussian")
    detected = MultiBernoulli(r.log(), torch.log1p(-r), torch.zeros(3, 3).log_softmax(-1), boxes)
    box = torch.full((2,), 4.0)
    pmb = PoissonMultiBernoulli.from_detections(detected, 0.1, UniformPoisson(torch.ones(3), -box, box))
    assert pmb.detected.log_existence.exp().tolist() == pytest.approx([0.9])
    assert pmb.background is not None
    assert pmb.background.expected_count.item() == pytest.approx(3.15)
