"""Abilities of agents and difficulties of routes from scores of drives (Rasch 1960).

A score of 0 to 1 is expected to be σ(ability - difficulty). Difficulties are normally distributed, and the
likelihood of the abilities is integrated over them (Bock and Aitkin 1981). Estimating a difficulty for each
route beside the abilities would inflate them: twice for two agents (Neyman and Scott 1948). Routes that were
driven by other agents than most have a mean difficulty of their own, so an agent that drove the hard routes
alone is not worse for it.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64
from scipy.special import expit, logsumexp

from foredrive.tasks.bootstrap import LEAST_ROUTES

PRIOR_SPREAD = 10.0
"""Standard deviation of abilities before any drive, in logits: it keeps those finite that solved everything,
or nothing."""
DIFFICULTY_SPREAD = 1.5
"""Standard deviation, before any drive, of the logarithm of the spread of difficulties around 1 logit."""
LEVEL = 0.95
DRAWS = 4000
"""Draws of abilities for the intervals of ranks."""
LEAST_GROUP = 5
"""Routes of a group that has a mean difficulty of its own."""
MAX_WEIGHT, _ROUNDS, _WEIGHED = 30.0, 30, 1e-3
_NODE, _WEIGHT = np.polynomial.hermite_e.hermegauss(31)
_LOG_WEIGHT = np.log(_WEIGHT / _WEIGHT.sum())


@dataclass(frozen=True)
class Estimate:
    """A value with its interval of 95 %."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Ratings:
    """Abilities of A agents and difficulties of R routes, in logits. Abilities have the mean 0."""

    ability: tuple[Estimate, ...]
    """Intervals over routes, and over the trainings of an agent that has several."""
    rank: tuple[Estimate, ...]
    """1 for the highest ability; intervals of the same kind."""
    difficulty: tuple[Estimate, ...]
    """Intervals of the posterior, given the abilities."""


class _Drives(NamedTuple):
    """Scores of N drives, with the numbers of agent, route and training of each."""

    score: Float64[np.ndarray, "N"]
    agent: Int64[np.ndarray, "N"]
    route: Int64[np.ndarray, "N"]
    training: Int64[np.ndarray, "N"]
    group: Int64[np.ndarray, "R"]
    """Number of the group of each route: routes that the same agents drove. Group 0 has the mean 0."""

    @property
    def agents(self) -> int:
        return int(self.agent.max()) + 1

    @property
    def routes(self) -> int:
        return len(self.group)


class _Integrated(NamedTuple):
    """The likelihood at some abilities, with K nodes in place of the difficulty of each route."""

    log_likelihood: float
    gradient: Float64[np.ndarray, "R P"]
    """By route: of the abilities, the means of groups, and the logarithm of the spread of difficulties."""
    expected: Float64[np.ndarray, "N K"]
    """Expected score of each drive at each node."""
    posterior: Float64[np.ndarray, "R K"]
    """Probability of each node, given the drives of a route."""


def rate(
    scores: Float64[np.ndarray, "N"],
    agent: Int64[np.ndarray, "N"],
    route: Int64[np.ndarray, "N"],
    rng: np.random.Generator,
    training: Int64[np.ndarray, "N"] | None = None,
) -> Ratings:
    """Fit the model to the drives of A agents on R routes.

    With fewer than `LEAST_ROUTES` routes the intervals of abilities and ranks are NaN.

    Args:
        scores: of each drive, 0 to 1.
        agent: number of its agent, of 0 to A - 1.
        route: number of its route, of 0 to R - 1.
        rng: draws the abilities of which the intervals of ranks are made.
        training: number of the training of its agent; None: each agent has one.
    """
    training = np.zeros_like(agent) if training is None else training
    drives = _Drives(scores, agent, route, training, _groups(agent, route))
    values, weight = _fit(drives)
    covariance, reach = _uncertainty(drives, values, weight)
    # Only differences of abilities count
    middle = values[: drives.agents].mean()
    ability = values[: drives.agents] - middle
    # A covariance around the mean has no full rank, so it is not checked for being one
    draws = rng.multivariate_normal(ability, covariance, DRAWS, "ignore", method="eigh")
    if drives.routes < LEAST_ROUTES:
        reach, draws = np.full_like(reach, np.nan), np.full_like(draws, np.nan)
    ranks = _ranks(draws) if drives.routes >= LEAST_ROUTES else draws
    ends = np.quantile(ranks, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0, method="nearest")
    posterior = _integrate(drives, values, weight).posterior
    mean = np.append(0.0, values[drives.agents : -1])[drives.group] - middle
    difficulty = mean + posterior @ (np.exp(values[-1]) * _NODE)
    spread = np.exp(values[-1]) * np.sqrt(posterior @ _NODE**2 - (posterior @ _NODE) ** 2)
    return Ratings(
        _estimates(ability, ability - reach, ability + reach),
        _estimates(_ranks(ability), *ends),
        _estimates(difficulty, difficulty - 1.96 * spread, difficulty + 1.96 * spread),
    )


def _estimates(*columns: Float64[np.ndarray, "K"]) -> tuple[Estimate, ...]:
    return tuple(Estimate(*row) for row in np.column_stack(columns).tolist())


def _groups(agent: Int64[np.ndarray, "N"], route: Int64[np.ndarray, "N"]) -> Int64[np.ndarray, "R"]:
    """Return groups of routes that the same agents drove, the largest first. Small ones are of the first."""
    drove = np.zeros((int(route.max()) + 1, int(agent.max()) + 1), dtype=np.int64)
    drove[route, agent] = 1
    _, group, count = np.unique(drove, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(-count, kind="stable")
    kept = order[: max(1, int((count >= LEAST_GROUP).sum()))]
    number = np.zeros(len(count), dtype=np.int64)
    number[kept] = np.arange(len(kept))
    return number[group.ravel()]


def _integrate(drives: _Drives, values: Float64[np.ndarray, "P"], weight: float) -> _Integrated:
    """Return the likelihood, integrated over the difficulty of each route by Gauss-Hermite quadrature.

    Args:
        values: abilities, means of the groups after the first, logarithm of the spread of difficulties.
        weight: what a score counts beside a right or wrong answer.
    """
    spread = np.exp(values[-1])
    mean = np.append(0.0, values[drives.agents : -1])[drives.group]
    logit = (values[drives.agent] - mean[drives.route])[:, None] - spread * _NODE
    expected = expit(logit)
    of_drive = weight * (drives.score[:, None] * logit - np.logaddexp(0.0, logit))
    of_route = np.tile(_LOG_WEIGHT, (drives.routes, 1))
    np.add.at(of_route, drives.route, of_drive)
    total = logsumexp(of_route, axis=1)
    posterior = np.exp(of_route - total[:, None])
    # By Fisher's identity the gradient is the posterior mean of that with known difficulties
    residual = weight * (drives.score[:, None] - expected) * posterior[drives.route]
    gradient = np.zeros((drives.routes, len(values)))
    np.add.at(gradient, (drives.route, drives.agent), residual.sum(1))
    later = drives.group[drives.route] > 0
    column = drives.agents + drives.group[drives.route] - 1
    np.add.at(gradient, (drives.route[later], column[later]), -residual.sum(1)[later])
    np.add.at(gradient[:, -1], drives.route, -spread * residual @ _NODE)
    return _Integrated(float(total.sum()), gradient, expected, posterior)


def _cost(
    values: Float64[np.ndarray, "P"], drives: _Drives, weight: float
) -> tuple[float, Float64[np.ndarray, "P"]]:
    """Return the negative logarithm of likelihood and prior, and its gradient."""
    integral = _integrate(drives, values, weight)
    precision = np.full(len(values), PRIOR_SPREAD**-2)
    precision[-1] = DIFFICULTY_SPREAD**-2
    cost = 0.5 * float(precision @ values**2) - integral.log_likelihood
    return cost, precision * values - integral.gradient.sum(0)


def _fit(drives: _Drives) -> tuple[Float64[np.ndarray, "P"], float]:
    """Return the values of `_integrate` that are most likely, and the weight of a score.

    Scores between 0 and 1 vary less around their expectation than right or wrong answers do, so each says
    more. Their weight is the inverse of their dispersion, estimated together with the abilities. Without it
    the spread of difficulties, and with it that of abilities, is estimated too small. Scores of 0 and 1 alone
    are answers, and count 1.
    """
    from scipy.optimize import minimize  # takes 0.3 s

    values, weight = np.zeros(drives.agents + int(drives.group.max()) + 1), 1.0
    answers = bool(np.isin(drives.score, (0.0, 1.0)).all())
    for _ in range(1 if answers else _ROUNDS):
        values = minimize(_cost, values, (drives, weight), "BFGS", jac=True, options={"gtol": 1e-7}).x
        if answers:
            break
        integral = _integrate(drives, values, weight)
        likely = integral.posterior[drives.route]
        squared = ((drives.score[:, None] - integral.expected) ** 2 * likely).sum()
        of_answers = (integral.expected * (1 - integral.expected) * likely).sum()
        # Each value that is fitted takes away a degree of freedom
        freedom = max(1.0 - len(values) / len(drives.score), 0.0)
        before, weight = weight, float(np.clip(freedom * of_answers / max(squared, 1e-12), 1.0, MAX_WEIGHT))
        if abs(weight - before) < _WEIGHED * before:
            break
    return values, weight


def _uncertainty(
    drives: _Drives, values: Float64[np.ndarray, "P"], weight: float
) -> tuple[Float64[np.ndarray, "A A"], Float64[np.ndarray, "A"]]:
    """Return the covariance of the abilities around their mean, and the half widths of their intervals.

    The variance is the larger of two: by the curvature of the likelihood, and by what the routes contribute
    to the gradient (the sandwich, which does not need the model to be right). Trainings of one agent add
    what they differ by.
    """
    from scipy.stats import t as student  # takes 0.5 s

    step = 1e-4 * np.eye(len(values))
    columns = [(_cost(values + e, drives, weight)[1] - _cost(values - e, drives, weight)[1]) for e in step]
    inverse = np.linalg.inv(np.stack(columns) / 2e-4)
    gradient = _integrate(drives, values, weight).gradient
    around = gradient - gradient.mean(0)
    routes = max(drives.routes, 2)
    centred = np.eye(drives.agents, len(values)) - 1.0 / drives.agents
    centred[:, drives.agents :] = 0.0
    change = centred @ inverse  # of the centred abilities with the gradient
    by_model = np.einsum("ap,ap->a", change, centred)
    by_routes = np.einsum("ap,pq,aq->a", change, around.T @ around, change) * routes / (routes - 1)
    by_trainings = np.square(change[:, : drives.agents]) @ _between_trainings(drives, values, weight)
    variance = np.maximum(by_model, by_routes) + by_trainings
    # Degrees of freedom of the sum (Satterthwaite 1946)
    trainings = len(set(zip(drives.agent.tolist(), drives.training.tolist(), strict=True))) - drives.agents
    parts = (variance - by_trainings) ** 2 / (routes - 1) + by_trainings**2 / max(trainings, 1)
    freedom = variance**2 / np.maximum(parts, 1e-300)
    larger = np.sqrt(variance / by_model)
    covariance = larger[:, None] * (change @ centred.T) * larger
    return covariance, student.ppf((1 + LEVEL) / 2, freedom) * np.sqrt(variance)


def _between_trainings(
    drives: _Drives, values: Float64[np.ndarray, "P"], weight: float
) -> Float64[np.ndarray, "A"]:
    """Return the variance that the trainings of each agent contribute to its gradient; 0 for one training."""
    integral = _integrate(drives, values, weight)
    residual = weight * (drives.score[:, None] - integral.expected) * integral.posterior[drives.route]
    total = residual.sum(1)
    variance = np.zeros(drives.agents)
    for agent in range(drives.agents):
        mine = drives.agent == agent
        sums = np.array(
            [total[mine & (drives.training == k)].sum() for k in np.unique(drives.training[mine])]
        )
        if len(sums) > 1:
            variance[agent] = len(sums) * sums.var(ddof=1)
    return variance


def _ranks(ability: Float64[np.ndarray, "*n A"]) -> Float64[np.ndarray, "*n A"]:
    """Return 1 for the highest ability. Those that differ by rounding share the mean of their ranks."""
    from scipy.stats import rankdata  # takes 0.5 s

    return np.asarray(rankdata(-np.round(ability, 3), axis=-1), dtype=np.float64)
