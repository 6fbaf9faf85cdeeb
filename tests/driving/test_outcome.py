"""Outcomes and scores of safety tests, by hand-made drives: one for each way in which a drive can end."""

import dataclasses
import math

import numpy as np
import pytest

from foredrive.driving.drive import Drive
from foredrive.driving.drive_record import DriveRecord, record_of
from foredrive.driving.ncap.outcome import Outcome, judge, threat_score
from foredrive.driving.replay.threats import Threat
from foredrive.driving.scores import Ending, RouteScore, infraction_of
from foredrive.errors import InputError
from foredrive.runs.drive.records import summarise
from foredrive.scene import BicycleState, Event
from foredrive.view.drive_report import threat_text

HIT = Event("collision_vehicle", 3.2, (20.0, 0.0), "car 8 at 2.5 m/s", "car", 2.5)
STRUCK = Event("struck", 2.0, (0.0, 0.0), "car 9 at 6.0 m/s", "car", 6.0)
REFERENCE_MPS = 10.0


def driven(ending: Ending, *events: Event, completion: float = 0.4) -> Drive:
    infractions = tuple(found for event in events if (found := infraction_of(event)) is not None)
    score = RouteScore("way", 0, completion, 0.0, ending, infractions, 20.0, 6.0)
    states = tuple(BicycleState(0.1 * k, 0.0, 0.0, 2.0) for k in range(121))
    error = "ValueError: no plan" if ending is Ending.CRASHED else ""
    return Drive(score, states, events, (math.inf,), (0.01,), None, error)


@pytest.mark.parametrize(
    ("ending", "outcome", "score"),
    [
        (Ending.COMPLETED, Outcome.PASSED, 5.0),
        (Ending.TIMEOUT, Outcome.STOPPED_SHORT, 5.0),
        (Ending.BLOCKED, Outcome.STOPPED_SHORT, 5.0),
        (Ending.DEVIATION, Outcome.LEFT_WAY, 0.0),
        (Ending.CRASHED, Outcome.FAILED, None),
    ],
)
def test_each_ending_without_a_collision_has_its_outcome(
    ending: Ending, outcome: Outcome, score: float | None
) -> None:
    result = judge(Threat.SIDE, driven(ending), REFERENCE_MPS)
    assert (result.outcome, result.score) == (outcome, score)
    assert (result.impact_mps, result.impact_s) == (None, None)
    assert result.progress == 0.4
    assert result.score_progress == (None if score is None else pytest.approx(0.4 * score))


@pytest.mark.parametrize("ending", list(Ending))
def test_the_first_collision_decides_whatever_ends_the_drive(ending: Ending) -> None:
    later = dataclasses.replace(HIT, t_s=4.0, severity=9.0)
    result = judge(Threat.FRONTAL, driven(ending, STRUCK, HIT, later), REFERENCE_MPS)
    assert (result.outcome, result.impact_mps, result.impact_s) == (Outcome.COLLIDED, 2.5, 3.2)
    assert result.score == pytest.approx(3.0)  # 4 · (1 - 2.5 / 10)
    assert result.score_progress == pytest.approx(1.2)


def test_being_struck_from_behind_is_no_collision() -> None:
    result = judge(Threat.SIDE, driven(Ending.TIMEOUT, STRUCK), REFERENCE_MPS)
    assert (result.outcome, result.score) == (Outcome.STOPPED_SHORT, 5.0)


def test_a_protocol_without_a_rule_for_leaving_gives_the_best_score() -> None:
    result = judge(Threat.SIDE, driven(Ending.DEVIATION), REFERENCE_MPS, left_way_score=5.0)
    assert (result.outcome, result.score) == (Outcome.LEFT_WAY, 5.0)


def test_an_impact_faster_than_the_reference_scores_nothing() -> None:
    assert threat_score(12.0, REFERENCE_MPS) == 0.0
    assert threat_score(0.0, REFERENCE_MPS) == 4.0
    assert threat_score(None, REFERENCE_MPS) == 5.0


@pytest.mark.parametrize("reference_mps", [0.0, -1.0, math.nan, math.inf])
def test_a_reference_that_is_no_speed_is_refused(reference_mps: float) -> None:
    with pytest.raises(InputError, match="reference speed"):
        threat_score(None, reference_mps)


def kept(route: str, drive: Drive) -> DriveRecord:
    drive = dataclasses.replace(drive, score=dataclasses.replace(drive.score, route=route))
    line = [[0.0, 0.0, 0.0], [50.0, 0.0, 0.0]]
    threat = judge(Threat.SIDE, drive, REFERENCE_MPS)
    return record_of(drive, np.array(line), 50.0, town=None, log="logs/x", wall_s=1.0, threat=threat)


def test_failures_are_counted_and_leave_the_means_alone() -> None:
    endings = {"a": Ending.TIMEOUT, "b": Ending.CRASHED, "c": Ending.DEVIATION}
    drives = [kept(name, driven(ending)) for name, ending in endings.items()]
    drives.append(kept("d", driven(Ending.COLLISION, HIT, completion=0.5)))
    summary = summarise(drives)
    assert summary["threats.side.failed"] == 1
    assert summary["threats.side.left_way"] == 1
    assert summary["threats.side.stopped_short"] == 1
    assert summary["threats.side.runs"] == 4
    assert summary["threats.side.score"] == pytest.approx((5.0 + 0.0 + 3.0) / 3)
    assert summary["threats.side.collision_rate"] == pytest.approx(1 / 3)
    assert summary["threats.side.progress"] == pytest.approx((0.4 + 0.4 + 0.5) / 3)
    assert summary["threats.side.score_progress"] == pytest.approx((2.0 + 0.0 + 1.5) / 3)
    alone = summarise([drives[1]])
    assert alone["threats.side.score"] is None
    assert alone["threats.side.failed"] == 1


def test_the_outcome_is_told_beside_the_score() -> None:
    told = {
        ending: threat_text(judge(Threat.SIDE, driven(ending), REFERENCE_MPS))
        for ending in (Ending.CRASHED, Ending.DEVIATION, Ending.TIMEOUT)
    }
    assert told[Ending.CRASHED] == "failed: not scored"
    assert told[Ending.DEVIATION].startswith("left way: score 0.0 of 5, progress 0.40")
    assert "stopped short: score 5.0 of 5, progress 0.40, score times progress 2.0" in told[Ending.TIMEOUT]
    hit = threat_text(judge(Threat.SIDE, driven(Ending.COLLISION, HIT), REFERENCE_MPS))
    assert hit.startswith("collided at 2.5 m/s (10.0 m/s without any action): score 3.0 of 5")
