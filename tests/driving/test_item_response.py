"""Abilities and difficulties: likelihoods by other means, coverage, and ones that are recovered."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize
from scipy.special import expit
from scipy.stats import norm

from foredrive.driving.item_response import DIFFICULTY_SPREAD, PRIOR_SPREAD, Ratings, rate


def rated(scores: np.ndarray, known: np.ndarray | None = None) -> Ratings:
    """Rate a matrix [agents, routes], of which only the known entries are driven."""
    agent, route = np.nonzero(np.ones_like(scores, dtype=bool) if known is None else known)
    return rate(scores[agent, route], agent, route, np.random.default_rng(0))


def test_abilities_are_most_likely_over_all_difficulties() -> None:
    """Integrated over difficulties by adaptive quadrature, for every spread, the likelihood falls beside."""
    solved = np.array([[1, 1, 0, 1, 0, 1, 1, 0.0], [0, 1, 0, 0, 0, 1, 0, 0.0]])
    found = np.array([one.value for one in rated(solved).ability])

    def of_route(difficulty: float, ability: np.ndarray, scores: np.ndarray, spread: float) -> float:
        chance = expit(ability - difficulty)
        return float(np.prod(np.where(scores > 0, chance, 1 - chance)) * norm.pdf(difficulty, 0, spread))

    def log_posterior(ability: np.ndarray, spread: float) -> float:
        of_routes = [quad(of_route, -40, 40, (ability, column, spread), points=[0])[0] for column in solved.T]
        prior = norm.logpdf(ability, 0, PRIOR_SPREAD).sum() + norm.logpdf(
            np.log(spread), 0, DIFFICULTY_SPREAD
        )
        return float(np.log(of_routes).sum() + prior)

    def best(difference: float) -> float:
        """Over the mean of both abilities and the spread."""
        half = np.array([0.5, -0.5]) * difference
        return -float(
            minimize(lambda x: -log_posterior(half + x[0], np.exp(x[1])), [0, 0], method="Powell").fun
        )

    difference = float(found[0] - found[1])
    assert best(difference) > max(best(difference - 0.3), best(difference + 0.3))


def test_abilities_are_recovered_though_each_agent_drove_other_routes() -> None:
    rng = np.random.default_rng(1)
    ability, difficulty = np.array([1.0, 0.0, -1.0]), np.linspace(-2, 2, 120)
    scores = expit(ability[:, None] - difficulty)
    known = np.stack([difficulty > 0.3, np.ones(120, dtype=bool), difficulty < -0.3])
    means = [scores[k, known[k]].mean() for k in range(3)]
    assert means[2] > means[0]  # the best agent drove the hard routes, so means mislead
    exact = rated(scores, known)
    assert [one.value for one in exact.ability] == pytest.approx(ability.tolist(), abs=0.2)
    assert np.corrcoef([one.value for one in exact.difficulty], difficulty)[0, 1] > 0.99
    solved = rated((rng.random(scores.shape) < scores).astype(float), known)
    assert [one.value for one in solved.ability] == pytest.approx(ability.tolist(), abs=0.5)
    assert [one.value for one in solved.rank] == [1, 2, 3]
    assert all(one.low <= true <= one.high for one, true in zip(solved.ability, ability, strict=True))


@pytest.mark.parametrize(("agents", "routes", "graded"), [(2, 56, False), (3, 16, True), (5, 32, True)])
def test_intervals_cover_and_abilities_are_not_inflated(agents: int, routes: int, graded: bool) -> None:
    """Of drawn agents and routes; with difficulties as parameters two agents come out twice too far apart."""
    rng = np.random.default_rng(4)
    covered, slopes = list[bool](), list[float]()
    for _ in range(60):
        ability, difficulty = rng.normal(0.0, 1.0, agents), rng.normal(0.0, 1.5, routes)
        expected = expit(ability[:, None] - difficulty)
        drawn = (
            rng.beta(2 * expected + 1e-3, 2 * (1 - expected) + 1e-3) if graded else rng.random(expected.shape)
        )
        found = rated(drawn if graded else (drawn < expected).astype(float)).ability
        true = ability - ability.mean()
        covered += [one.low <= value <= one.high for one, value in zip(found, true, strict=True)]
        slopes.append(float(np.array([one.value for one in found]) @ true / (true @ true)))
    assert np.mean(covered) > 0.91
    assert 0.85 < np.median(slopes) < 1.2


def test_trainings_that_differ_make_the_interval_wider() -> None:
    """Three trainings of one agent: alike, and one of them far better on every route."""
    rng = np.random.default_rng(2)
    difficulty = rng.normal(0, 1, 24)
    agent, route, training = (axis.ravel() for axis in np.indices((2, 24, 3)))
    widths = []
    for offset in (0.0, 2.0):
        ability = np.where(agent == 0, 0.5 + offset * (training - 1), -0.5)
        scores = expit(ability - difficulty[route]) + 0.02 * rng.normal(size=len(agent))
        one = rate(scores.clip(0, 1), agent, route, np.random.default_rng(0), training).ability[0]
        widths.append(one.high - one.low)
    assert widths[1] > 3 * widths[0]


def test_all_or_nothing_stays_finite_and_equals_share_a_rank() -> None:
    ratings = rated(np.array([[1.0] * 6, [0.0] * 6, [0.5] * 6, [0.5] * 6]))
    values = [one.value for one in ratings.ability]
    assert np.isfinite(values).all()
    assert values[0] > values[2] > values[1]
    assert values[2] == pytest.approx(values[3], abs=1e-3)
    assert [one.value for one in ratings.rank] == [1, 4, 2.5, 2.5]


def test_an_agent_that_solves_everything_is_not_certain() -> None:
    """Its routes contribute nothing to the gradient, but how good it is nobody knows."""
    best, other = rated(np.array([[1.0] * 12, [1.0, 0.0] * 6])).ability
    assert best.high - best.low > 3.0
    assert best.value > other.value


@pytest.mark.parametrize("routes", [1, 9])
def test_few_routes_have_no_intervals_over_routes(routes: int) -> None:
    ratings = rated(np.array([[0.9] * routes, [0.2] * routes]))
    assert [one.value for one in ratings.rank] == [1, 2]
    assert np.isnan([end for one in (*ratings.ability, *ratings.rank) for end in (one.low, one.high)]).all()
    assert np.isfinite([ratings.difficulty[0].low, ratings.difficulty[0].high]).all()
