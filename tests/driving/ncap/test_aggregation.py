"""Means of safety tests worked out by hand: runs → scenario → kind → mean of the kinds."""

import dataclasses

import pytest

from foredrive.driving.ncap.aggregation import TestedRun, aggregate
from foredrive.driving.ncap.outcome import Outcome, SafetyResult
from foredrive.driving.replay.threats import Threat
from foredrive.view.ncap_tables import safety_table


def run(
    scenario: str,
    kind: Threat,
    score: float | None,
    outcome: Outcome,
    progress: float = 0.5,
    place: str | None = None,
) -> TestedRun:
    impact = 10.0 * (1 - score / 4.0) if outcome is Outcome.COLLIDED and score is not None else None
    result = SafetyResult(kind, outcome, impact, None if impact is None else 3.0, 10.0, score, progress)
    return TestedRun(scenario, place or scenario, result, 0.5, 0.8)


RUNS = [
    run("a", Threat.STATIONARY, 5.0, Outcome.PASSED, 1.0),
    run("a", Threat.STATIONARY, 1.0, Outcome.COLLIDED),
    run("a", Threat.STATIONARY, None, Outcome.FAILED),
    run("b", Threat.STATIONARY, 2.0, Outcome.COLLIDED),
    run("c", Threat.SIDE, 0.0, Outcome.LEFT_WAY),
    run("c", Threat.SIDE, 4.0, Outcome.COLLIDED),
    run("d", Threat.SIDE, None, Outcome.FAILED),
]


def test_each_scenario_and_each_kind_has_the_same_weight() -> None:
    """a: 3, b: 2, so stationary 2.5; c: 2, d has no score, so side 2; of both 2.25."""
    scenarios, kinds, overall = aggregate(RUNS)
    assert list(scenarios) == ["a", "b", "c", "d"]
    assert scenarios["a"].score is not None
    assert scenarios["a"].score.mean == pytest.approx(3.0)
    assert scenarios["d"].score is None
    assert kinds[Threat.STATIONARY].score is not None
    assert kinds[Threat.STATIONARY].score.mean == pytest.approx(2.5)
    assert overall.score is not None
    assert overall.score.mean == pytest.approx(2.25)
    assert overall.collision_rate is not None
    assert overall.collision_rate.mean == pytest.approx(0.5 * (0.75 + 0.5))
    assert overall.score_progress == pytest.approx(
        0.5 * (0.5 * (0.5 * (5.0 + 0.5) + 1.0) + 0.5 * (0.0 + 2.0))
    )
    assert overall.relative_impact_speed == pytest.approx((0.75 + 0.5 + 0.0) / 3)
    assert (overall.runs, overall.failed, overall.left_way) == (7, 2, 1)
    assert Threat.FRONTAL not in kinds


def test_intervals_draw_places() -> None:
    """Runs that are all alike at their place say as little of other places as one of them."""
    scores = [0.0, 4.0] * 8
    once = [run(f"{k}", Threat.SIDE, score, Outcome.COLLIDED) for k, score in enumerate(scores)]
    _, _, overall = aggregate(once)
    assert overall.score is not None
    low, high = overall.score.low, overall.score.high
    assert low is not None
    assert high is not None
    # The standard error of 16 places is 0.5
    assert (low, high) == (pytest.approx(1.0, abs=0.3), pytest.approx(3.0, abs=0.3))
    _, _, again = aggregate(once * 5)
    assert again.score == overall.score
    assert aggregate(once) == aggregate(once)


def test_scenarios_of_one_place_are_drawn_together() -> None:
    """All that is tested at 10 places ends alike there, so several kinds and times tell no more."""

    def suite(times: int, kinds: tuple[Threat, ...]) -> list[TestedRun]:
        return [
            run(f"{kind}{p}{time}", kind, 4.0 * (p % 2), Outcome.COLLIDED, place=f"{p}")
            for p in range(10)
            for kind in kinds
            for time in range(times)
        ]

    alone = aggregate(suite(1, (Threat.SIDE,)))[2].score
    assert alone == aggregate(suite(3, (Threat.SIDE,)))[2].score
    of_all = aggregate(suite(2, tuple(Threat)))[2].score
    assert alone is not None
    assert of_all is not None
    assert (of_all.low, of_all.high) == (pytest.approx(alone.low), pytest.approx(alone.high))


def test_a_scenario_has_an_interval_over_its_runs_and_few_places_none() -> None:
    runs = [run("a", Threat.SIDE, score, Outcome.COLLIDED) for score in (0.0, 4.0) * 8]
    scenarios, kinds, overall = aggregate(runs)
    score = scenarios["a"].score
    assert score is not None
    assert score.low is not None
    assert 0.5 < score.low < 1.5
    for of in (kinds[Threat.SIDE], overall):
        assert of.score is not None
        assert (of.score.mean, of.score.low, of.score.high) == (2.0, None, None)


def test_the_table_names_failures_and_what_is_left_out() -> None:
    table = safety_table(RUNS, {"side-x": "run 0 passes without any action"})
    assert [len(section.rows) for section in table.sections] == [4, 2, 1]
    assert any("side-x" in note for note in table.notes)
    text = [str(cell) for cell in table.sections[2].rows[0].cells]
    assert text[0] == "mean of 2 kinds"
    assert text[3] == "2.25"  # three places have no interval


def test_a_failed_run_changes_no_mean() -> None:
    alone = aggregate([run("a", Threat.SIDE, 2.0, Outcome.COLLIDED)])[2]
    failed = aggregate(
        [run("a", Threat.SIDE, 2.0, Outcome.COLLIDED), run("a", Threat.SIDE, None, Outcome.FAILED, 0.1)]
    )[2]
    assert dataclasses.replace(failed, runs=1, failed=0) == alone
