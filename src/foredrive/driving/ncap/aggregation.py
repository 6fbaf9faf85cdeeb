"""Figures of a suite of safety tests: runs → scenario → kind → mean of the kinds.

As neuro-ncap's `aggregate_results.py`: each scenario has the same weight within its kind, and each kind in
the whole, however many runs or scenarios it has. Failed runs are counted and have no share in any mean.
"""

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from foredrive.driving.ncap.outcome import Outcome, SafetyResult
from foredrive.driving.replay.threats import Threat
from foredrive.tasks.bootstrap import LEAST_ROUTES

RESAMPLES, LEVEL = 2000, 0.95


@dataclass(frozen=True)
class TestedRun:
    """One run and its figures."""

    __test__ = False

    scenario: str
    """Label of the scenario."""
    place: str
    """Log and time at which the scenario begins, which scenarios of several kinds may share."""
    result: SafetyResult
    near_s: float | None
    """Smallest time to collision at the key frames, s. None if all move apart."""
    comfortable_share: float | None
    """Share of the time within nuPlan's bounds. None if the run is too short to tell."""
    trusted_share: float | None = None
    """Share of the key frames that the reconstruction trusts; None if nothing was rendered."""


@dataclass(frozen=True)
class Interval:
    """A mean and its percentile interval. Bounds are None where too little can be drawn."""

    mean: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class SafetyFigures:
    """Figures of a scenario, of a kind, or of all."""

    runs: int
    failed: int
    left_way: int
    stopped_short: int
    score: Interval | None
    """Mean score, 0 to 5. None if all runs failed, as for all other means."""
    collision_rate: Interval | None
    progress: float | None
    score_progress: float | None
    """Mean of the product of both."""
    relative_impact_speed: float | None
    """Mean of impact speed / reference speed over the runs with a collision."""
    time_to_collision_s: float | None
    """Median of the smallest time to collision, s, over the runs that have one."""
    comfortable_share: float | None
    hd_score: float | None = None
    """Mean of HUGSIM's HD-Score; None without a map."""
    untrusted: int = 0
    """Number of runs that ended where the images were no longer trusted. They have no score."""
    trusted_share: float | None = None
    """Mean share of the key frames that the reconstruction trusts."""


def aggregate(
    runs: Sequence[TestedRun], seed: int = 0
) -> tuple[dict[str, SafetyFigures], dict[Threat, SafetyFigures], SafetyFigures]:
    """Return the figures of each scenario, of each kind that was tested, and of all kinds.

    Intervals hold 95 %. Those of a scenario are found by drawing its runs with replacement. Those of kinds
    and of all draw places with all their scenarios and runs: what is tested at one place is alike. There are
    none of fewer than `LEAST_ROUTES` places. A scenario of which all runs failed has no share in means, as in
    neuro-ncap.
    """
    rng = np.random.default_rng(seed)
    # Runs by scenario, scenarios by kind; both in the order in which they occur
    by_scenario = {name: [run for run in runs if run.scenario == name] for name in _names(runs)}
    kind_of = {name: of[0].result.kind for name, of in by_scenario.items()}
    by_kind = {
        kind: {name: of for name, of in by_scenario.items() if kind_of[name] == kind}
        for kind in Threat
        if kind in set(kind_of.values())
    }
    return (
        {name: _figures({kind_of[name]: {name: of}}, rng, one=True) for name, of in by_scenario.items()},
        {kind: _figures({kind: of}, rng) for kind, of in by_kind.items()},
        _figures(by_kind, rng),
    )


def _names(runs: Sequence[TestedRun]) -> list[str]:
    return list(dict.fromkeys(run.scenario for run in runs))


Groups = dict[Threat, dict[str, list[TestedRun]]]
"""Runs by kind and by scenario."""


def _figures(groups: Groups, rng: np.random.Generator, *, one: bool = False) -> SafetyFigures:
    runs = [run for of_kind in groups.values() for of in of_kind.values() for run in of]
    outcomes = [run.result.outcome for run in runs]
    near = [run.near_s for run in runs if run.near_s is not None and run.result.score is not None]
    return SafetyFigures(
        runs=len(runs),
        failed=outcomes.count(Outcome.FAILED),
        left_way=outcomes.count(Outcome.LEFT_WAY),
        stopped_short=outcomes.count(Outcome.STOPPED_SHORT),
        score=_interval(groups, lambda run: run.result.score, rng, one=one),
        collision_rate=_interval(groups, _collided, rng, one=one),
        progress=_mean(groups, lambda run: None if run.result.score is None else run.result.progress),
        score_progress=_mean(groups, lambda run: run.result.score_progress),
        relative_impact_speed=_relative_impact(runs),
        time_to_collision_s=statistics.median(near) if near else None,
        comfortable_share=_mean(
            groups, lambda run: None if run.result.score is None else run.comfortable_share
        ),
        hd_score=_mean(groups, lambda run: run.result.hd_score),
        untrusted=outcomes.count(Outcome.UNTRUSTED),
        trusted_share=_mean(groups, lambda run: run.trusted_share),
    )


def _collided(run: TestedRun) -> float | None:
    return None if run.result.score is None else float(run.result.outcome is Outcome.COLLIDED)


def _relative_impact(runs: Sequence[TestedRun]) -> float | None:
    hits = [run.result for run in runs if run.result.impact_mps is not None]
    return statistics.fmean((hit.impact_mps or 0.0) / hit.reference_mps for hit in hits) if hits else None


def _values(groups: Groups, value: Callable[[TestedRun], float | None]) -> list[list[np.ndarray]]:
    """Return the values of each scenario of each kind. Scenarios and kinds without any are not listed."""
    of_kinds = [
        [
            np.array(of)
            # Failed runs have no value and drop out here
            for runs in of_kind.values()
            if (of := [v for run in runs if (v := value(run)) is not None])
        ]
        for of_kind in groups.values()
    ]
    return [of_kind for of_kind in of_kinds if of_kind]


def _mean(groups: Groups, value: Callable[[TestedRun], float | None]) -> float | None:
    values = _values(groups, value)
    if not values:
        return None
    # Mean over runs, then over the scenarios of a kind, then over the kinds
    return statistics.fmean(statistics.fmean(of.mean() for of in of_kind) for of_kind in values)


def _interval(
    groups: Groups, value: Callable[[TestedRun], float | None], rng: np.random.Generator, *, one: bool
) -> Interval | None:
    """Return a mean with its interval: of one scenario over its runs, else over places."""
    mean = _mean(groups, value)
    if mean is None:
        return None
    if one:
        (runs,) = _values(groups, value)[0]
        resampled = runs[rng.integers(0, len(runs), (RESAMPLES, len(runs)))].mean(1)
    else:
        means, kinds, places = _scenario_means(groups, value)
        if len(places) < LEAST_ROUTES:
            return Interval(mean, None, None)
        # How often each place is drawn is the weight of its scenarios within their kinds
        weight = rng.multinomial(len(places), np.full(len(places), 1 / len(places)), RESAMPLES) @ places
        of_kinds = [
            (weight[:, kind] @ means[kind]) / np.maximum(weight[:, kind].sum(1), 1e-9) for kind in kinds
        ]
        drawn = np.stack([weight[:, kind].sum(1) > 0 for kind in kinds])
        # A kind of which no place is drawn has no share in that draw
        resampled = (np.stack(of_kinds) * drawn).sum(0) / drawn.sum(0)
    low, high = np.quantile(resampled, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Interval(mean, float(low), float(high))


def _scenario_means(
    groups: Groups, value: Callable[[TestedRun], float | None]
) -> tuple[Float64[np.ndarray, "S"], Bool[np.ndarray, "K S"], Float64[np.ndarray, "P S"]]:
    """Return the mean of each scenario that has one, and the scenarios of each kind and of each place."""
    rows = [
        (kind, runs[0].place, float(np.mean(values)))
        for kind, of_kind in groups.items()
        for runs in of_kind.values()
        if (values := [of_run for run in runs if (of_run := value(run)) is not None])
    ]
    kinds, places, means = (np.array(column) for column in zip(*rows, strict=True))
    return (
        means.astype(float),
        np.unique(kinds)[:, None] == kinds,
        (np.unique(places)[:, None] == places).astype(float),
    )
