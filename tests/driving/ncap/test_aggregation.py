"""Means of safety tests worked out by hand: runs → scenario → kind → mean of the kinds."""

import dataclasses

import pytest

from foredrive.driving.ncap.aggregation import TestedRun, aggregate
from foredrive.driving.ncap.outcome import Outcome, SafetyResult
from foredrive.driving.replay.threats import Threat
from foredrive.view.ncap_tables import safety_table


def run(
    scenario: str, kind: Threat, score: float | None, outcome: Outcome, progress: float = 0.5
) -> TestedRun:
    impact = 10.0 * (1 - score / 4.0) if outcome is Outcome.COLLIDED and score is not None else None
    result = SafetyResult(kind, outcome, impact, None if impact is None else 3.0, 10.0, score, progress)
    return TestedRun(scenario, result, 0.5, 0.8)


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


def test_intervals_hold_the_runs_of_a_scenario_and_only_those() -> None:
    """Scenarios without spread have intervals of one point, however much they differ from each other."""
    same = [run(name, Threat.SIDE, score, Outcome.COLLIDED) for name, score in (("a", 1.0), ("b", 3.0)) * 2]
    _, _, overall = aggregate(same)
    assert overall.score is not None
    assert (overall.score.low, overall.score.mean, overall.score.high) == (2.0, 2.0, 2.0)
    spread = [run("a", Threat.SIDE, score, Outcome.COLLIDED) for score in (0.0, 4.0) * 8]
    _, _, overall = aggregate(spread)
    assert overall.score is not None
    assert 0.5 < overall.score.low < 1.5
    assert 2.5 < overall.score.high < 3.5
    assert aggregate(spread) == aggregate(spread)


def test_the_table_names_failures_and_what_is_left_out() -> None:
    table = safety_table(RUNS, {"side-x": "run 0 passes without any action"})
    assert [len(section.rows) for section in table.sections] == [4, 2, 1]
    assert any("side-x" in note for note in table.notes)
    text = [str(cell) for cell in table.sections[2].rows[0].cells]
    assert text[0] == "mean of 2 kinds"
    assert text[3].startswith("2.25 [")


def test_a_failed_run_changes_no_mean() -> None:
    alone = aggregate([run("a", Threat.SIDE, 2.0, Outcome.COLLIDED)])[2]
    failed = aggregate(
        [run("a", Threat.SIDE, 2.0, Outcome.COLLIDED), run("a", Threat.SIDE, None, Outcome.FAILED, 0.1)]
    )[2]
    assert dataclasses.replace(failed, runs=1, failed=0) == alone
