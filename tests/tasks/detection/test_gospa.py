"""GOSPA and P-GOSPA on cases worked out by hand."""

import itertools

import numpy as np
import pytest
import torch

from foredrive.errors import InputError
from foredrive.sets import BoxDensity, LabelledBoxes
from foredrive.tasks.detection.gospa import gospa, wasserstein_distance


def test_parts_by_hand() -> None:
    """Two pairs 1 m and 2 m apart, one false detection, one missed object; cutoff 4 m, so 8 m² each."""
    far = 100.0
    result = gospa(np.array([[1.0, far, far], [far, 2.0, far], [far, far, 5.0]]), 4.0)
    assert (result.localisation, result.existence, result.missed, result.false) == (5.0, 0.0, 8.0, 8.0)
    assert result.distance == pytest.approx(21.0**0.5)
    assert result.detection.tolist() == [0, 1, -1]


def test_probabilistic_parts_by_hand() -> None:
    """r = 0.75 at 1 m, r = 0.5 alone, one missed: 0.75·1 + 0.25·2 + 0.5·2 + 2 with cutoff 2 m."""
    result = gospa(np.array([[1.0, 9.0], [9.0, 9.0]]), 2.0, existence=np.array([0.75, 0.5]))
    parts = (result.localisation, result.existence, result.missed, result.false)
    assert parts == pytest.approx((0.75, 0.5, 2.0, 1.0))
    assert result.distance == pytest.approx(4.25**0.5)


def test_a_detection_that_does_not_exist_costs_nothing_but_its_object() -> None:
    result = gospa(np.array([[0.5]]), 2.0, existence=np.array([0.0]))
    assert result.distance**2 == pytest.approx(2.0)


def test_the_cheapest_of_all_assignments() -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        m, n = rng.integers(0, 5, 2)
        distance, r = rng.uniform(0, 3, (m, n)), rng.random(m)
        costs = []
        for choice in itertools.product(range(-1, m), repeat=int(n)):
            taken = [i for i in choice if i >= 0]
            if len(set(taken)) == len(taken) and all(
                i < 0 or distance[i, j] < 2 for j, i in enumerate(choice)
            ):
                pairs = sum(r[i] * distance[i, j] + (1 - r[i]) for j, i in enumerate(choice) if i >= 0)
                alone = sum(r[i] for i in range(m) if i not in taken)
                costs.append(pairs + alone + choice.count(-1))
        assert gospa(distance, 2.0, p=1.0, existence=r).distance == pytest.approx(min(costs), abs=1e-12)


def test_the_distance_of_a_density_is_that_of_its_samples() -> None:
    chol = torch.tensor([[[0.5, 0, 0, 0], [0.2, 0.3, 0, 0], [0, 0, 0.1, 0], [0, 0, 0, 7.0]]])
    boxes = BoxDensity(torch.tensor([[1.0, 2.0, 3.0, 0.0]]), chol)
    objects = LabelledBoxes(torch.tensor([0]), torch.tensor([[1.0, 2.0, 5.0, 0.0]]))
    expected = (4.0 + 0.25 + 0.04 + 0.09 + 0.01) ** 0.5
    assert wasserstein_distance(boxes, objects).item() == pytest.approx(expected, abs=1e-6)


def test_bad_input_is_named() -> None:
    with pytest.raises(InputError, match=r"distance \(0, 1\)"):
        gospa(np.array([[0.0, np.nan]]), 1.0)
    with pytest.raises(InputError, match=r"existence \(1,\)"):
        gospa(np.zeros((2, 1)), 1.0, existence=np.array([0.5, 1.5]))
    with pytest.raises(InputError, match="cutoff"):
        gospa(np.zeros((2, 1)), 0.0)
