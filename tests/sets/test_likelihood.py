"""PMB-NLL against the definition, its gradient and its parts; and the true process scores best."""

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch

from foredrive.sets import (
    BoxDensity,
    LabelledBoxes,
    MixturePoisson,
    MultiBernoulli,
    PoissonMultiBernoulli,
    UniformPoisson,
    set_nll,
)


def log_density_by_definition(pmb: PoissonMultiBernoulli, objects: LabelledBoxes) -> torch.Tensor:
    """Thesis eq. 3.9 to 3.12: sums over all ways to part the set of products of densities."""
    detected, everything = pmb.detected, frozenset(range(len(objects.label)))
    log_p = detected.boxes.log_prob(objects) + detected.log_class.double()[:, objects.label]
    log_one = detected.log_existence.double()[:, None] + log_p
    factors, none = [], log_one.numel()  # each summand is a sum of some entries of a long vector

    def multi_bernoulli(members: frozenset[int], first: int) -> list[tuple[int, ...]]:
        """Summands of eq. 3.10."""
        if first == len(log_one):
            return [] if members else [()]
        terms = [(none + first, *rest) for rest in multi_bernoulli(members, first + 1)]
        for j in members:
            pair = first * log_one.shape[1] + j
            terms += [(pair, *rest) for rest in multi_bernoulli(members - {j}, first + 1)]
        return terms

    entries = [log_one.flatten(), detected.log_absence.double()]
    poisson = none + len(log_one)
    if pmb.background is not None:
        entries += [pmb.background.log_intensity(objects), -pmb.background.expected_count[None]]
    for size in range(len(everything) + 1 if pmb.background is not None else 1):
        for unseen in itertools.combinations(everything, size):
            chosen = [poisson + j for j in unseen]
            if pmb.background is not None:
                chosen.append(poisson + len(everything))
            factors += [(*chosen, *rest) for rest in multi_bernoulli(everything - set(unseen), 0)]
    if not factors:
        return torch.tensor(-math.inf, dtype=torch.float64)
    counts = torch.tensor([len(term) for term in factors])
    summand = torch.arange(len(factors)).repeat_interleave(counts)
    chosen_logs = torch.cat(entries)[torch.tensor([entry for term in factors for entry in term])]
    logs = torch.zeros(len(factors), dtype=torch.float64).index_add(0, summand, chosen_logs)
    return logs.logsumexp(0)


def random_scene(
    rng: np.random.Generator, *, background: bool
) -> tuple[PoissonMultiBernoulli, LabelledBoxes]:
    """Up to 4 detections and 3 objects: 2-D or 3-D boxes, Gaussian or Laplace, near each other or not."""
    m, n, upright = rng.integers(1, 5), rng.integers(0, 4), bool(rng.integers(2))
    dims, spread = 6 if upright else 4, rng.choice([0.2, 3.0])

    def values(*shape: int) -> torch.Tensor:
        return torch.as_tensor(rng.normal(size=shape))

    def heading(count: int) -> torch.Tensor | None:
        return values(count) if upright else None

    def boxes(count: int) -> BoxDensity:
        chol = 0.3 * values(count, dims, dims).tril(-1) + torch.diag_embed(values(count, dims).exp())
        kappa = values(count).exp() if upright else None
        family = "gaussian" if rng.random() < 0.5 else "laplace"
        return BoxDensity(spread * values(count, dims), chol, heading(count), kappa, family)

    detected = MultiBernoulli.from_softmax(2 * values(m, 4), boxes(m))
    other: Any = None
    if background and rng.random() < 0.5:
        other = UniformPoisson(values(3).exp(), torch.full((dims,), -9.0), torch.full((dims,), 9.0), upright)
    elif background:
        other = MixturePoisson(values(2), values(2, 3).log_softmax(-1), boxes(2))
    truth = LabelledBoxes(torch.as_tensor(rng.integers(0, 3, n)), spread * values(n, dims), heading(n))
    return PoissonMultiBernoulli(detected, other), truth


def test_equal_to_the_definition_in_1000_scenes() -> None:
    rng = np.random.default_rng(0)
    infinite = 0
    for i in range(1000):
        pmb, truth = random_scene(rng, background=i % 4 > 0)
        score = set_nll(pmb, truth)
        expected = -log_density_by_definition(pmb, truth).item()
        if expected == math.inf:  # more objects than detections, and no background
            infinite += 1
            assert score.nll.item() == score.lower == math.inf
            assert len(score.associations.impossible_objects) == len(truth.label) - len(
                pmb.detected.log_existence
            )
            continue
        assert score.nll.item() == pytest.approx(expected, abs=1e-9)
        assert expected - 1e-8 <= score.lower + 1e-8 <= score.nll.item() + 1e-7
        assert score.ambiguity.item() <= 1e-9
    assert 5 < infinite < 100


def test_gradients_are_those_of_the_definition() -> None:
    rng = np.random.default_rng(1)
    for i in range(40):
        pmb, truth = random_scene(rng, background=i % 2 > 0)
        if pmb.background is None:
            truth = truth[: len(pmb.detected.log_existence)]
        logits = torch.as_tensor(rng.normal(size=(len(pmb.detected.log_existence), 4))).requires_grad_()
        mean = pmb.detected.boxes.mean.clone().requires_grad_()
        chol = pmb.detected.boxes.chol.clone().requires_grad_()
        boxes = dataclasses.replace(pmb.detected.boxes, mean=mean, chol=chol)
        pmb = dataclasses.replace(pmb, detected=MultiBernoulli.from_softmax(logits, boxes))
        leaves = (logits, mean, chol)
        ours = set_nll(pmb, truth).nll
        got = torch.autograd.grad(ours, leaves, materialize_grads=True, retain_graph=True)
        by_definition = -log_density_by_definition(pmb, truth)
        expected = torch.autograd.grad(by_definition, leaves, materialize_grads=True)
        torch.testing.assert_close(got, expected, atol=1e-8, rtol=1e-8)


def test_a_sum_that_is_not_exact_is_an_interval_around_the_value() -> None:
    rng = np.random.default_rng(3)
    boxes = BoxDensity(torch.as_tensor(rng.normal(size=(6, 2))), torch.eye(2).double().expand(6, 2, 2))
    pmb = PoissonMultiBernoulli(
        MultiBernoulli.from_softmax(torch.as_tensor(rng.normal(size=(6, 3))), boxes),
        UniformPoisson(torch.tensor([0.5, 0.5]), torch.full((2,), -9.0), torch.full((2,), 9.0)),
    )
    truth = LabelledBoxes(torch.as_tensor(rng.integers(0, 2, 5)), torch.as_tensor(rng.normal(size=(5, 2))))
    value = set_nll(pmb, truth).nll.item()
    bounded = set_nll(pmb, truth, k=2, max_states=1)
    assert bounded.lower < value - 1e-3
    assert value + 1e-3 < bounded.nll.item()


def test_parts_by_hand() -> None:
    """One detection at 0 and one object at 1, which may belong together or not."""
    r, rate, volume = 0.8, 0.5, 10.0
    boxes = BoxDensity(torch.zeros(1, 1), torch.ones(1, 1, 1).double())
    detected = MultiBernoulli(
        torch.tensor([r]).log(), torch.tensor([1 - r]).log(), torch.tensor([[0.7, 0.3]]).log(), boxes
    )
    uniform = UniformPoisson(torch.tensor([0.0, rate]), torch.tensor([-5.0]), torch.tensor([5.0]))
    score = set_nll(
        PoissonMultiBernoulli(detected, uniform), LabelledBoxes(torch.tensor([1]), torch.ones(1, 1))
    )
    box = math.exp(-0.5) / math.sqrt(2 * math.pi)
    together, apart = r * 0.3 * box, (1 - r) * rate / volume
    share = together / (together + apart)
    entropy = -share * math.log(share) - (1 - share) * math.log(1 - share)
    near = {"abs": 1e-6}
    assert score.nll.item() == pytest.approx(rate - math.log(together + apart), **near)
    assert score.localisation.item() == pytest.approx(-share * math.log(box), **near)
    assert score.classification.item() == pytest.approx(-share * math.log(r * 0.3), **near)
    assert score.false.item() == pytest.approx(-(1 - share) * math.log(1 - r), **near)
    assert score.missed.item() == pytest.approx(-(1 - share) * math.log(rate / volume), **near)
    assert score.expected_background.item() == pytest.approx(rate, **near)
    assert score.ambiguity.item() == pytest.approx(-entropy, **near)


def test_infinite_values_are_located_and_leave_gradients_finite() -> None:
    """A certain detection of nothing; an object of a class that the background does not have."""
    mean = torch.tensor([[0.0], [1.0], [50.0]], requires_grad=True)
    boxes = BoxDensity(mean, torch.ones(3, 1, 1))
    zero = -math.inf
    log_class = torch.tensor([[0.0, zero]]).repeat(3, 1)
    log_existence = torch.tensor([math.log(0.5), 0.0, 0.0])
    detected = MultiBernoulli(log_existence, torch.tensor([math.log(0.5), zero, zero]), log_class, boxes)
    background = UniformPoisson(torch.tensor([1.0, 0.0]), torch.tensor([-9.0]), torch.tensor([9.0]))
    truth = LabelledBoxes(torch.tensor([0, 1, 0]), torch.tensor([[1.1], [0.0], [-2.0]]))
    score = set_nll(PoissonMultiBernoulli(detected, background), truth)
    assert score.nll.item() == score.missed.item() == math.inf
    assert score.associations.impossible_objects.tolist() == [1]
    assert score.false.item() < math.inf  # the detection at 50 takes the object at 1.1, the other that at -2
    (gradient,) = torch.autograd.grad(score.nll, mean)
    assert gradient.isfinite().all()
    assert gradient[:, 0].tolist() == pytest.approx([0.0, 3.0, 48.9], abs=1e-5)

    alone = set_nll(PoissonMultiBernoulli(detected, background), truth[:1])
    assert alone.nll.item() == alone.false.item() == math.inf
    assert alone.associations.impossible_detections.tolist() == [2]


def test_empty_sets_on_either_side() -> None:
    boxes = BoxDensity(torch.zeros(2, 1), torch.ones(2, 1, 1))
    detected = MultiBernoulli(
        torch.tensor([0.5, 0.2]).log(), torch.tensor([0.5, 0.8]).log(), torch.zeros(2, 1), boxes
    )
    background = UniformPoisson(torch.tensor([0.3]), torch.tensor([0.0]), torch.tensor([2.0]))
    nothing = LabelledBoxes(torch.zeros(0, dtype=torch.long), torch.zeros(0, 1))
    one = LabelledBoxes(torch.tensor([0]), torch.ones(1, 1))

    def nll(found: MultiBernoulli, truth: LabelledBoxes) -> float:
        return set_nll(PoissonMultiBernoulli(found, background), truth).nll.item()

    assert nll(detected, nothing) == pytest.approx(0.3 - math.log(0.4))
    assert nll(detected[:0], one) == pytest.approx(0.3 - math.log(0.15))
    assert nll(detected[:0], nothing) == pytest.approx(0.3)


def perturbed(true: PoissonMultiBernoulli) -> dict[str, PoissonMultiBernoulli]:
    """Other processes, each wrong in one way."""
    found, boxes, uniform = true.detected, true.detected.boxes, true.background
    assert isinstance(uniform, UniformPoisson)

    def detected(**changes: Any) -> PoissonMultiBernoulli:
        return dataclasses.replace(true, detected=dataclasses.replace(found, **changes))

    def boxed(**changes: Any) -> PoissonMultiBernoulli:
        return detected(boxes=dataclasses.replace(boxes, **changes))

    def existing(r: torch.Tensor) -> PoissonMultiBernoulli:
        return detected(log_existence=r.log(), log_absence=torch.log1p(-r))

    r = found.log_existence.exp()
    return {
        "overconfident": existing((2 * torch.logit(r)).sigmoid()),
        "underconfident": existing((0.5 * torch.logit(r)).sigmoid()),
        "shifted": boxed(mean=boxes.mean + 0.25),
        "too sharp": boxed(chol=0.8 * boxes.chol),
        "too wide": boxed(chol=1.25 * boxes.chol),
        "turned": boxed(yaw=boxes.yaw + 0.2),
        "heading too sure": boxed(concentration=2 * boxes.concentration),
        "other shape": boxed(family="laplace"),
        "classes too even": detected(log_class=(0.5 * found.log_class).log_softmax(-1)),
        "fewer expected": dataclasses.replace(
            true, background=dataclasses.replace(uniform, rate=0.5 * uniform.rate)
        ),
        "duplicated": PoissonMultiBernoulli(
            MultiBernoulli(
                torch.cat([found.log_existence, found.log_existence[:1] - 2]),
                torch.cat([found.log_absence, torch.log1p(-(found.log_existence[:1] - 2).exp())]),
                torch.cat([found.log_class, found.log_class[:1]]),
                boxes[[0, 1, 2, 3, 4, 0]],
            ),
            uniform,
        ),
    }


def test_the_true_process_scores_best_on_average() -> None:
    """The score is proper: each wrong process must lose by 2.5 standard errors over 250 sets.

    The least of them loses 0.3 standard deviations a set, so 4.7 standard errors: it is found in 98.6 % of
    such tests. One that is no worse than the truth would pass in 0.6 %.
    """
    rng = np.random.default_rng(2)
    boxes = BoxDensity(
        mean=torch.as_tensor(rng.uniform(-4, 4, (5, 2))),  # overlapping: associations are in doubt
        chol=torch.diag_embed(torch.as_tensor(rng.uniform(0.5, 2.0, (5, 2)))),
        yaw=torch.as_tensor(rng.uniform(-3, 3, 5)),
        concentration=torch.as_tensor(rng.uniform(5, 20, 5)),
    )
    r = torch.as_tensor([0.95, 0.9, 0.7, 0.3, 0.1], dtype=torch.float64)
    log_class = (2 * torch.as_tensor(rng.normal(size=(5, 3)))).log_softmax(-1)
    uniform = UniformPoisson(
        torch.tensor([0.7, 0.2, 0.1]), torch.full((2,), -8.0), torch.full((2,), 8.0), True
    )
    true = PoissonMultiBernoulli(MultiBernoulli(r.log(), torch.log1p(-r), log_class, boxes), uniform)
    others = perturbed(true)
    lost: dict[str, list[float]] = {name: [] for name in others}
    for _ in range(250):
        truth = true.sample(rng)
        best = set_nll(true, truth).nll.item()
        for name, other in others.items():
            lost[name].append(set_nll(other, truth).nll.item() - best)
    z = {name: np.mean(gap) / (np.std(gap) / math.sqrt(len(gap))) for name, gap in lost.items()}
    assert min(z.values()) > 2.5, z
