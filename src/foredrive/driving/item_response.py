"""Abilities of agents and difficulties of routes from scores of drives (Rasch 1960).

A score of 0 to 1 is expected to be σ(ability - difficulty). Both are found together, so an agent that drove
the hard routes alone is not worse for it. Abilities have the mean 0; a weak prior keeps those finite that
solved everything, or nothing.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy.special import expit

from foredrive.tasks.bootstrap import LEAST_ROUTES

PRIOR_SPREAD = 10.0
"""Standard deviation of abilities and difficulties before any drive, in logits."""
RESAMPLES, LEVEL = 500, 0.95
_STEPS, _TOLERANCE = 50, 1e-9


@dataclass(frozen=True)
class Estimate:
    """A value with its interval of 95 %."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Ratings:
    """Abilities of A agents and difficulties of R routes, in logits."""

    ability: tuple[Estimate, ...]
    """Intervals over resampled routes."""
    rank: tuple[Estimate, ...]
    """1 for the highest ability; intervals over the same resampled routes."""
    difficulty: tuple[Estimate, ...]
    """Intervals by the curvature of the likelihood, as of right or wrong answers: scores between them vary
    less."""


def rate(
    scores: Float64[np.ndarray, "N"],
    agent: Int64[np.ndarray, "N"],
    route: Int64[np.ndarray, "N"],
    rng: np.random.Generator,
) -> Ratings:
    """Fit the model to the drives of A agents on R routes.

    With fewer than `LEAST_ROUTES` routes the intervals of abilities and ranks are NaN.

    Args:
        scores: of each drive, 0 to 1.
        agent: number of its agent, of 0 to A - 1.
        route: number of its route, of 0 to R - 1.
        rng: draws the resampled routes.
    """
    agents, routes = int(agent.max()) + 1, int(route.max()) + 1
    values, hessian = _fit(scores, agent, route, np.ones(routes), agents)
    ability, difficulty = values[:agents], values[agents:]
    drawn, ranks = np.full((2, RESAMPLES, agents), np.nan)
    for k in range(RESAMPLES if routes >= LEAST_ROUTES else 0):
        times = np.bincount(rng.integers(0, routes, routes), minlength=routes).astype(np.float64)
        drawn[k] = _fit(scores, agent, route, times, agents)[0][:agents]
        ranks[k] = _ranks(drawn[k])
    spread = np.sqrt(np.diag(np.linalg.inv(hessian)))[agents:]
    ends = [(1 - LEVEL) / 2, (1 + LEVEL) / 2]
    return Ratings(
        _estimates(ability, *np.quantile(drawn, ends, axis=0)),
        _estimates(_ranks(ability), *np.quantile(ranks, ends, axis=0, method="nearest")),
        _estimates(difficulty, difficulty - 1.96 * spread, difficulty + 1.96 * spread),
    )


def _estimates(*columns: Float64[np.ndarray, "K"]) -> tuple[Estimate, ...]:
    return tuple(Estimate(*row) for row in np.column_stack(columns).tolist())


def _fit(
    scores: Float64[np.ndarray, "N"],
    agent: Int64[np.ndarray, "N"],
    route: Int64[np.ndarray, "N"],
    times: Float64[np.ndarray, "R"],
    agents: int,
) -> tuple[Float64[np.ndarray, "P"], Float64[np.ndarray, "P P"]]:
    """Return abilities and difficulties, and the Hessian there, by Newton's method.

    The negative logarithm of the likelihood with its prior is strictly convex.

    Args:
        times: how often each route counts.
    """
    routes, weight = len(times), times[route]
    design = np.zeros((len(scores), agents + routes))
    design[np.arange(len(scores)), agent] = 1.0
    design[np.arange(len(scores)), agents + route] = -1.0
    values, prior = np.zeros(agents + routes), np.full(agents + routes, PRIOR_SPREAD**-2)
    hessian = np.diag(prior)
    for _ in range(_STEPS):
        expected = expit(design @ values)
        gradient = design.T @ (weight * (expected - scores)) + prior * values
        hessian = (design.T * (weight * expected * (1 - expected))) @ design + np.diag(prior)
        step = np.linalg.solve(hessian, gradient)
        values = values - step / max(1.0, float(np.abs(step).max()))  # no step beyond a logit
        if np.abs(step).max() < _TOLERANCE:
            break
    # Only differences count
    middle = values[:agents].mean()
    return values - middle, hessian


def _ranks(ability: Float64[np.ndarray, "A"]) -> Float64[np.ndarray, "A"]:
    """Return 1 for the highest ability. Equal ones share the mean of their ranks."""
    from scipy.stats import rankdata  # takes 0.5 s

    return np.asarray(rankdata(-ability), dtype=np.float64)
