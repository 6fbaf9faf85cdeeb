"""Abilities and difficulties: cases computed by hand, and ones that are recovered."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import expit

from foredrive.driving.item_response import PRIOR_SPREAD, rate


def rated(scores: np.ndarray, known: np.ndarray | None = None) -> object:
    """Rate a matrix [agents, routes], of which only the known entries are driven."""
    agent, route = np.nonzero(np.ones_like(scores, dtype=bool) if known is None else known)
    return rate(scores[agent, route], agent, route, np.random.default_rng(0))


def test_two_agents_on_one_route_by_hand() -> None:
    """Opposite scores: difficulty 0, and abilities ±a with σ(a) + a / s² = 0.9."""
    ratings = rated(np.array([[0.9], [0.1]]))
    a = brentq(lambda a: expit(a) + a / PRIOR_SPREAD**2 - 0.9, 0, 5)
    assert [one.value for one in ratings.ability] == pytest.approx([a, -a], abs=1e-6)
    assert ratings.difficulty[0].value == pytest.approx(0, abs=1e-6)
    curvature = 2 * expit(a) * (1 - expit(a)) + 1 / PRIOR_SPREAD**2
    assert ratings.difficulty[0].high > 1.96 / np.sqrt(curvature)  # the abilities are uncertain too
    assert [one.value for one in ratings.rank] == [1, 2]


def test_abilities_are_recovered_though_each_agent_drove_other_routes() -> None:
    rng = np.random.default_rng(1)
    ability, difficulty = np.array([1.0, 0.0, -1.0]), np.linspace(-2, 2, 120)
    scores = expit(ability[:, None] - difficulty)
    known = np.stack([difficulty > 0.3, np.ones(120, dtype=bool), difficulty < -0.3])
    means = [scores[k, known[k]].mean() for k in range(3)]
    assert means[2] > means[0]  # the best agent drove the hard routes, so means mislead
    exact = rated(scores, known)
    assert [one.value for one in exact.ability] == pytest.approx(ability.tolist(), abs=0.1)
    assert np.corrcoef([one.value for one in exact.difficulty], difficulty)[0, 1] > 0.99
    solved = rated((rng.random(scores.shape) < scores).astype(float), known)
    assert [one.value for one in solved.ability] == pytest.approx(ability.tolist(), abs=0.5)
    assert [one.value for one in solved.rank] == [1, 2, 3]
    assert all(one.low <= true <= one.high for one, true in zip(solved.ability, ability, strict=True))


def test_all_or_nothing_stays_finite_and_equals_share_a_rank() -> None:
    ratings = rated(np.array([[1.0] * 6, [0.0] * 6, [0.5] * 6, [0.5] * 6]))
    values = [one.value for one in ratings.ability]
    assert np.isfinite(values).all()
    assert values[0] > values[2] > values[1]
    assert values[2] == pytest.approx(values[3])
    assert [one.value for one in ratings.rank] == [1, 4, 2.5, 2.5]


@pytest.mark.parametrize("routes", [1, 9])
def test_few_routes_have_no_intervals_over_routes(routes: int) -> None:
    ratings = rated(np.array([[0.9] * routes, [0.2] * routes]))
    assert [one.value for one in ratings.rank] == [1, 2]
    assert np.isnan([end for one in (*ratings.ability, *ratings.rank) for end in (one.low, one.high)]).all()
    assert np.isfinite([ratings.difficulty[0].low, ratings.difficulty[0].high]).all()
