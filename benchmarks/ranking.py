"""Coverage of the ranking's intervals in a simulation: `foredrive bench ranking`.

Agents of known ability drive routes of known difficulty. The scores are right or wrong answers, or graded
between 0 and 1, as driving scores are.
"""

import functools
from collections.abc import Mapping
from typing import Literal

import numpy as np
from scipy.special import expit

from benchmarks.common.benchmark import Benchmark
from foredrive.driving.item_response import rate

AGENTS, ROUTES = (2, 3, 5, 10), (16, 32, 56)
SIMULATED = 600
"""Agents that are rated for each number of agents and of routes, and each seed."""
ABILITY_SPREAD, DIFFICULTY_SPREAD = 1.0, 1.5
"""Standard deviations, logits."""
CONCENTRATION = 2.0
"""Sum of the parameters of the Beta distribution of graded scores."""


def measure(seed: int, kind: Literal["answers", "graded"]) -> Mapping[str, float]:
    """Return for each size the share of intervals that hold the true ability, and how far they spread."""
    figures: dict[str, float] = {}
    for agents in AGENTS:
        for routes in ROUTES:
            rng = np.random.default_rng((seed, agents, routes))
            held, spreads, widths = list[bool](), list[float](), list[float]()
            for _ in range(SIMULATED // agents):
                ability = rng.normal(0.0, ABILITY_SPREAD, agents)
                expected = expit(ability[:, None] - rng.normal(0.0, DIFFICULTY_SPREAD, routes))
                graded = rng.beta(*(np.maximum(CONCENTRATION * p, 1e-3) for p in (expected, 1 - expected)))
                scores = graded if kind == "graded" else (rng.random(expected.shape) < expected).astype(float)
                agent, route = np.indices(scores.shape).reshape(2, -1)
                ratings = rate(scores.ravel(), agent, route, rng).ability
                true = ability - ability.mean()
                held += [one.low <= value <= one.high for one, value in zip(ratings, true, strict=True)]
                widths += [one.high - one.low for one in ratings]
                spreads.append(float(np.array([one.value for one in ratings]) @ true / (true @ true)))
            size = f"{agents}_agents_{routes}_routes"
            figures |= {
                f"coverage.{size}": float(np.mean(held)),
                f"inflation.{size}": float(np.median(spreads)),
                f"width_logits.{size}": float(np.median(widths)),
            }
    coverages = [value for name, value in figures.items() if name.startswith("coverage.")]
    return {**figures, "coverage_min": min(coverages), "coverage_mean": float(np.mean(coverages))}


BENCHMARK = Benchmark(
    question="Do the intervals of the ranking hold the true abilities?",
    arms={kind: functools.partial(measure, kind=kind) for kind in ("answers", "graded")},
    config={
        "agents": AGENTS,
        "routes": ROUTES,
        "simulated": SIMULATED,
        "spreads": (ABILITY_SPREAD, DIFFICULTY_SPREAD),
        "concentration": CONCENTRATION,
    },
    decided_by=("foredrive.driving.item_response",),
)
