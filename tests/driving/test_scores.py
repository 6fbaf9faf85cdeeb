"""Driving scores worked out by hand, for every penalty of both leaderboards."""

import dataclasses
import math

import pytest

from foredrive.driving.scores import (
    FACTOR_1_0,
    Ending,
    Infraction,
    InfractionKind,
    RouteScore,
    infraction_of,
    score_suite,
    timeout_s,
)
from foredrive.errors import InputError
from foredrive.scene import Event

K = InfractionKind
FLAWLESS = RouteScore("0", 0, 1.0, 0.0, Ending.COMPLETED, (), 500.0, 60.0)


def ran(*kinds: InfractionKind, severity: float = 0.0) -> tuple[Infraction, ...]:
    return tuple(Infraction(kind, 1.0, (2.0, 3.0), severity) for kind in kinds)


def test_a_flawless_drive_is_worth_100() -> None:
    assert (FLAWLESS.driving_score_1_0, FLAWLESS.driving_score_2_1) == (100.0, 100.0)


@pytest.mark.parametrize(
    ("kind", "score_1_0", "score_2_1"),
    [
        (K.COLLISION_PEDESTRIAN, 50.0, 50.0),  # 100 / (1 + 1)
        (K.COLLISION_VEHICLE, 60.0, 100 / 1.7),
        (K.COLLISION_STATIC, 65.0, 62.5),  # 100 / 1.6
        (K.RED_LIGHT, 70.0, 100 / 1.4),
        (K.STOP_SIGN, 80.0, 80.0),  # 100 / 1.25
        (K.SCENARIO_TIMEOUT, 100.0, 100 / 1.4),
        (K.YIELD_TO_EMERGENCY, 100.0, 100 / 1.4),
        (K.MIN_SPEED, 100.0, 100 / 1.4),
    ],
)
def test_each_infraction_costs_what_the_leaderboards_say(
    kind: InfractionKind, score_1_0: float, score_2_1: float
) -> None:
    drive = dataclasses.replace(FLAWLESS, infractions=ran(kind))
    assert drive.driving_score_1_0 == pytest.approx(score_1_0)
    assert drive.driving_score_2_1 == pytest.approx(score_2_1)


def test_infractions_multiply_in_1_0_and_add_up_in_2_1() -> None:
    infractions = ran(K.COLLISION_VEHICLE, K.COLLISION_VEHICLE, K.RED_LIGHT)
    drive = dataclasses.replace(FLAWLESS, completion=0.5, outside_lanes=0.1, infractions=infractions)
    assert drive.penalty_1_0 == pytest.approx(0.9 * 0.6 * 0.6 * 0.7)
    assert drive.driving_score_1_0 == pytest.approx(11.34)
    assert drive.penalty_2_1 == pytest.approx(0.9 / 2.8)  # 1 + .7 + .7 + .4
    assert drive.driving_score_2_1 == pytest.approx(50 * 0.9 / 2.8)


def test_driving_too_slowly_costs_by_how_much() -> None:
    drive = dataclasses.replace(FLAWLESS, infractions=ran(K.MIN_SPEED, severity=0.75))
    assert drive.penalty_2_1 == pytest.approx(1 / 1.1)
    assert drive.penalty_1_0 == 1.0


@pytest.mark.parametrize("ending", [Ending.DEVIATION, Ending.BLOCKED, Ending.TIMEOUT, Ending.CRASHED])
def test_ending_early_costs_only_what_was_not_driven(ending: Ending) -> None:
    drive = dataclasses.replace(FLAWLESS, completion=0.4, ending=ending)
    assert drive.driving_score_1_0 == drive.driving_score_2_1 == pytest.approx(40.0)
    assert drive.failed is (ending is Ending.CRASHED)


def test_leaving_the_lanes_all_the_way_is_worth_nothing() -> None:
    assert dataclasses.replace(FLAWLESS, outside_lanes=1.0).driving_score_1_0 == 0.0


def test_shares_that_are_none_are_named() -> None:
    for wrong in ({"completion": 1.01}, {"outside_lanes": -0.1}, {"completion": math.nan}):
        with pytest.raises(InputError, match="route 0: completion and outside_lanes"):
            dataclasses.replace(FLAWLESS, **wrong)


def test_events_become_infractions_with_time_place_severity_and_what_was_hit() -> None:
    event = Event("collision_vehicle", 4.5, (1.0, 2.0), "from behind", "truck", 7.5)
    expected = Infraction(K.COLLISION_VEHICLE, 4.5, (1.0, 2.0), 7.5, "truck", "from behind")
    assert infraction_of(event) == expected
    assert infraction_of(dataclasses.replace(event, kind="outside_lane")) is None
    assert infraction_of(dataclasses.replace(event, kind="completed")) is None


def test_a_suite_is_the_mean_over_routes_and_repetitions_with_failures_counted() -> None:
    hit = dataclasses.replace(FLAWLESS, infractions=ran(K.COLLISION_PEDESTRIAN), driven_m=500.0)
    crashed = dataclasses.replace(FLAWLESS, completion=0.0, ending=Ending.CRASHED, driven_m=0.0)
    drives = [
        FLAWLESS,
        dataclasses.replace(hit, route="1"),
        dataclasses.replace(FLAWLESS, repetition=1),
        dataclasses.replace(crashed, route="1", repetition=1),
    ]
    suite = score_suite(drives)
    assert (suite.routes, suite.repetitions, suite.failed) == (2, 2, 1)
    assert suite.driving_score_1_0.mean == pytest.approx((100 + 50 + 100 + 0) / 4)
    assert suite.driving_score_1_0.spread == pytest.approx((75 - 50) / math.sqrt(2))
    assert suite.completion.mean == pytest.approx(75.0)
    assert suite.endings[Ending.COMPLETED] == 3
    assert suite.endings[Ending.CRASHED] == 1
    assert suite.infractions[K.COLLISION_PEDESTRIAN] == 1
    assert suite.infractions_per_km[K.COLLISION_PEDESTRIAN] == pytest.approx(1 / 1.5)
    assert sum(suite.infractions.values()) == 1


def test_one_repetition_has_no_spread() -> None:
    assert score_suite([FLAWLESS]).driving_score_2_1.spread == 0.0


def test_missing_and_double_drives_are_named() -> None:
    other = dataclasses.replace(FLAWLESS, route="1", repetition=1)
    with pytest.raises(InputError, match=r"missing.*\('0', 1\).*\('1', 0\)"):
        score_suite([FLAWLESS, other])
    with pytest.raises(InputError, match=r"duplicate drives, .*: \[\('0', 0\)\]"):
        score_suite([FLAWLESS, FLAWLESS])
    with pytest.raises(InputError, match="no drive"):
        score_suite([])


def test_leaderboard_1_0_knows_five_kinds_and_gives_a_route_its_time() -> None:
    assert len(FACTOR_1_0) == 5
    assert timeout_s(71.0) == 61.0  # int(.8 · 71 + 5) = int(61.8)
    assert timeout_s(1000.0) == 805.0
