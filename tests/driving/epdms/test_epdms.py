"""The EPDMS on a street drawn by hand: two lanes along x, each 4 m wide, and an oncoming lane above them.

Lane 0 is y in [-2, 2], lane 1 is y in [2, 6]; both belong to the route. Lane 2 is y in [6, 10], the oncoming
one. An intersection lies at x in [60, 80]. The vehicle is nuPlan's, 5.176 m by 2.297 m.
"""

import dataclasses
import math

import numpy as np
import pytest

from foredrive.driving.epdms.comfort import extended_comfort, history_comfort
from foredrive.driving.epdms.score import DriverScores, follow_up_weights, score_plan, two_stage_score
from foredrive.driving.epdms.subscores import (
    driving_direction_compliance,
    ego_areas,
    ego_progress,
    lane_keeping,
    no_at_fault_collision,
    time_to_collision,
    traffic_light_compliance,
)
from foredrive.driving.epdms.world import EgoBody, EgoMotion, Roads, Surroundings
from foredrive.errors import InputError
from foredrive.scene.road_map import RoadMap

STEPS = 41
BODY = EgoBody()
TURN = 0.6
"""The whole street is turned by this angle about the origin, so that nothing depends on the axes."""
R = np.array([[math.cos(TURN), -math.sin(TURN)], [math.sin(TURN), math.cos(TURN)]])


def box(x0: float, x1: float, y0: float, y1: float) -> np.ndarray:
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], dtype=float) @ R.T


ROADS = Roads(
    RoadMap(
        lanes=(box(-50, 200, -2, 2), box(-50, 200, 2, 6), box(-50, 200, 6, 10)),
        on_route=(True, True, False),
        drivable=(box(-50, 200, -2, 10),),
        intersections=(box(60, 80, -2, 10),),
        centreline=np.array([[-50.0, 0.0], [200.0, 0.0]]) @ R.T,
    )
)


def drive(
    speed_mps: float = 10.0, y: float = 0.0, x: float = 0.0, steps: int = STEPS, heading: float = 0.0
) -> EgoMotion:
    """At constant speed; y may be an array."""
    along = x + speed_mps * 0.1 * np.arange(steps)
    xy = np.stack([along, np.broadcast_to(y, steps)], axis=1) @ R.T
    zero = np.zeros(steps)
    return EgoMotion(xy, zero + TURN + heading, zero + speed_mps, zero, zero)


NOBODY = EgoMotion(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0))


def others(
    *rows: tuple[float, float, float, float], by_itself: bool = True, steps: int = STEPS
) -> Surroundings:
    """Objects of 4 m by 2 m by x, y, speed along x and heading."""
    values = np.array(rows, dtype=float).reshape(-1, 4)
    along = values[:, 0] + values[:, 2] * 0.1 * np.arange(steps)[:, None]
    centre = np.stack([along, np.broadcast_to(values[:, 1], along.shape)], axis=-1) @ R.T
    count = len(values)
    return Surroundings(
        centre,
        np.broadcast_to(values[:, 3] + TURN, (steps, count)),
        np.tile([2.0, 1.0], (count, 1)),
        np.broadcast_to(np.abs(values[:, 2]), (steps, count)),
        np.ones((steps, count), dtype=bool),
        np.full(count, by_itself),
    )


def nc(ego: EgoMotion, seen: Surroundings) -> float:
    return no_at_fault_collision(ego, BODY, ego_areas(ego, BODY, ROADS), seen)


def ttc(ego: EgoMotion, seen: Surroundings) -> float:
    return time_to_collision(ego, BODY, ego_areas(ego, BODY, ROADS), ROADS, seen)


def test_a_free_straight_drive_has_all_points() -> None:
    scores = score_plan(drive(), NOBODY, others(), ROADS, reference_m=40.0)
    assert scores == DriverScores(nc=1.0, dac=1.0, ddc=1.0, tlc=1.0, ep=1.0, ttc=1.0, lk=1.0, hc=1.0, ec=None)
    assert scores.epdms == 1.0


@pytest.mark.parametrize(
    ("seen", "expected"),
    [
        (others((30.0, 0.0, 0.0, 0.0)), 0.0),  # into a car that stands
        (others((30.0, 0.0, 0.0, 0.0), by_itself=False), 0.5),  # into a cone
        (others((20.0, 0.0, 5.0, 0.0)), 0.0),  # into the rear of a slower one
        (others((-10.0, 0.0, 20.0, 0.0)), 1.0),  # hit from behind
        (others((30.0, 5.0, 0.0, 0.0)), 1.0),  # beside
        (others((50.0, 0.0, 20.0, 0.0)), 1.0),  # never reached
    ],
)
def test_collisions_count_by_fault(seen: Surroundings, expected: float) -> None:
    assert nc(drive(), seen) == expected


def test_one_who_stands_is_not_at_fault() -> None:
    assert nc(drive(speed_mps=0.0), others((20.0, 0.0, -8.0, math.pi))) == 1.0


def test_a_side_impact_is_at_fault_only_in_several_lanes_or_off_the_road() -> None:
    """The other comes up beside the vehicle, overlapping its left side by a decimetre."""
    beside = others((-2.0, 2.1, 10.5, 0.0))
    assert nc(drive(), beside) == 1.0
    between = drive(y=1.5)
    assert bool(ego_areas(between, BODY, ROADS).multiple_lanes.all())
    assert nc(between, others((-2.0, 3.55, 10.5, 0.0))) == 0.0


def test_areas_by_corners_and_middle() -> None:
    """The half width is 1.1485 m: at y = 0.8 it is in one lane, at 0.9 in two, at -0.9 off the road."""
    for y, several, off, oncoming in (
        (0.8, False, False, False),
        (0.9, True, False, False),
        (-0.9, False, True, False),
        (8.0, False, False, True),
    ):
        areas = ego_areas(drive(y=y), BODY, ROADS)
        assert bool(areas.multiple_lanes.all()) == several, y
        assert bool(areas.off_road.all()) == off, y
        assert bool(areas.oncoming.all()) == oncoming, y


@pytest.mark.parametrize(("speed_mps", "expected"), [(1.5, 1.0), (4.0, 0.5), (8.0, 0.0)])
def test_driving_direction_by_the_way_within_a_second(speed_mps: float, expected: float) -> None:
    """In the window are 11 steps: 1.65 m, 4.4 m and 8.8 m."""
    ego = drive(speed_mps, y=8.0)
    assert driving_direction_compliance(ego, BODY, ego_areas(ego, BODY, ROADS), ROADS) == expected


def test_in_intersections_no_direction_is_wrong() -> None:
    ego = drive(4.0, y=8.0, x=60.0, steps=35)
    assert driving_direction_compliance(ego, BODY, ego_areas(ego, BODY, ROADS), ROADS) == 1.0


def test_red_lights_count_where_they_are_known() -> None:
    closed = ((),) * 20 + ((box(20.0, 30.0, -2.0, 2.0),),) * 21
    lit = dataclasses.replace(others(), red_m=closed)
    assert traffic_light_compliance(drive(), BODY, lit) == 0.0
    assert traffic_light_compliance(drive(speed_mps=3.0), BODY, lit) == 1.0
    assert traffic_light_compliance(drive(), BODY, others()) == 1.0


@pytest.mark.parametrize(
    ("driven_m", "multiplied", "reference_m", "expected"),
    [
        (20.0, 1.0, 40.0, 0.5),
        (50.0, 1.0, 40.0, 1.0),
        (50.0, 0.0, 40.0, 1.0),  # a plan that breaks a rule sets no standard
        (1.0, 1.0, 4.9, 1.0),  # nobody comes far here
        (0.0, 1.0, 10.0, 0.0),
    ],
)
def test_progress_by_the_better_of_both(
    driven_m: float, multiplied: float, reference_m: float, expected: float
) -> None:
    assert ego_progress(driven_m, multiplied, reference_m) == expected


def test_time_to_collision_looks_nine_tenths_of_a_second_ahead() -> None:
    """The bumper is 4.049 m in front of the axle; at 10 m/s it reaches 9 m further, up to step 31."""
    bumper_m = BODY.axle_to_centre_m + 0.5 * BODY.length_m
    at_m = 31.0 + 9.0 + bumper_m + 2.0
    assert ttc(drive(), others((at_m - 0.1, 0.0, 0.0, 0.0))) == 0.0
    assert ttc(drive(), others((at_m + 0.1, 0.0, 0.0, 0.0))) == 1.0
    assert ttc(drive(), others((20.0, 0.0, 10.0, 0.0))) == 1.0  # as fast as the vehicle
    assert ttc(drive(speed_mps=0.0), others((10.0, 0.0, -9.0, math.pi))) == 1.0


def test_beside_in_one_lane_is_forgiven_but_not_in_an_intersection() -> None:
    crossing = others((8.0, 1.9, 8.0, 0.0))
    assert ttc(drive(8.0), crossing) == ttc(drive(8.0), others())
    abreast = drive(8.0, x=60.0, steps=20)
    assert ttc(abreast, others((62.0, 2.1, 8.0, 0.0), steps=20)) == 0.0
    assert ttc(drive(8.0, x=0.0, steps=20), others((2.0, 2.1, 8.0, 0.0), steps=20)) == 1.0


def test_lane_keeping_fails_after_two_seconds_on_end() -> None:
    y = np.zeros(STEPS)
    y[5:24] = 0.6  # 19 steps
    assert lane_keeping(drive(2.0, y=y), BODY, ROADS) == 1.0
    y[24] = 0.6
    assert lane_keeping(drive(2.0, y=y), BODY, ROADS) == 0.0
    assert lane_keeping(drive(4.0, y=0.6, x=60.0, steps=40), BODY, ROADS) == 1.0


def test_comfort_looks_at_the_past_too() -> None:
    calm, past = drive(10.0), drive(10.0, x=-15.0, steps=15)
    assert history_comfort(past, calm, BODY) == 1.0
    braking = dataclasses.replace(past, acceleration_mps2=np.full(15, -4.5))
    assert history_comfort(braking, calm, BODY) == 0.0
    hard = dataclasses.replace(calm, acceleration_mps2=np.full(STEPS, 2.5))
    assert history_comfort(NOBODY, hard, BODY) == 0.0
    wound = dataclasses.replace(calm, yaw_rad=TURN + 0.1 * np.arange(STEPS))  # 1 rad/s
    assert history_comfort(NOBODY, wound, BODY) == 0.0
    wraps = dataclasses.replace(
        calm, yaw_rad=np.remainder(3.0 + 0.02 * np.arange(STEPS) + np.pi, 2 * np.pi) - np.pi
    )
    assert history_comfort(NOBODY, wraps, BODY) == 1.0


def test_two_plans_half_a_second_apart_have_to_agree() -> None:
    first = dataclasses.replace(drive(10.0), acceleration_mps2=np.linspace(0.0, 1.0, STEPS))
    later = dataclasses.replace(
        drive(10.0, x=5.0), acceleration_mps2=np.linspace(0.0, 1.0, STEPS) + 0.025 * 5
    )
    assert extended_comfort(first, later, 0.5) == 1.0
    other = dataclasses.replace(later, acceleration_mps2=later.acceleration_mps2 + 0.8)
    assert extended_comfort(first, other, 0.5) == 0.0
    turns = dataclasses.replace(later, yaw_rad=later.yaw_rad + 0.02 * np.arange(STEPS))  # 0.2 rad/s
    assert extended_comfort(first, turns, 0.5) == 0.0
    with pytest.raises(InputError, match="two plans of one length"):
        extended_comfort(first, drive(steps=30), 0.5)


ALL = DriverScores(nc=1.0, dac=1.0, ddc=0.5, tlc=1.0, ep=0.6, ttc=1.0, lk=0.0, hc=1.0, ec=1.0)


def test_the_score_by_hand() -> None:
    """0.5 · (5 · 0.6 + 5 · 1 + 2 · 0 + 2 · 1 + 2 · 1) / 16; without EC the sum of the weights is 14."""
    assert pytest.approx(0.5 * 12 / 16) == ALL.epdms
    assert dataclasses.replace(ALL, ec=None).epdms == pytest.approx(0.5 * 10 / 14)
    assert dataclasses.replace(ALL, nc=0.0).epdms == 0.0


def test_what_the_human_does_too_is_forgiven() -> None:
    human = DriverScores(nc=1.0, dac=0.0, ddc=0.5, tlc=1.0, ep=1.0, ttc=1.0, lk=0.0, hc=1.0)
    forgiven = dataclasses.replace(ALL, dac=0.0).forgiven(human)
    assert (forgiven.dac, forgiven.lk, forgiven.ddc) == (1.0, 1.0, 0.5)
    assert forgiven.epdms == pytest.approx(0.5 * 14 / 16)


def test_progress_and_comfort_are_not_forgiven() -> None:
    """The human stands, jerks, hits somebody and does not come near: 1 · (5 · 0 + 5 · 1 + 2 + 2 · 0) / 14."""
    human = DriverScores(nc=0.0, dac=0.0, ddc=0.0, tlc=0.0, ep=0.0, ttc=0.0, lk=0.0, hc=0.0, ec=0.0)
    forgiven = dataclasses.replace(human, ec=None).forgiven(human)
    assert forgiven == DriverScores(nc=1.0, dac=1.0, ddc=1.0, tlc=1.0, ep=0.0, ttc=1.0, lk=1.0, hc=0.0)
    assert forgiven.epdms == pytest.approx(7 / 14)


def test_follow_up_scenes_count_by_their_distance() -> None:
    """exp(-d² / 0.2): one at 0 and one at 0.5 m have weights of 1 and exp(-1.25)."""
    starts = np.array([[10.0, 0.0], [10.5, 0.0]])
    share = math.exp(-1.25) / (1 + math.exp(-1.25))
    np.testing.assert_allclose(follow_up_weights(np.array([10.0, 0.0]), starts), [1 - share, share])
    np.testing.assert_allclose(follow_up_weights(np.array([99.0, 0.0]), starts), [0.5, 0.5])
    assert two_stage_score(0.8, np.array([10.0, 0.0]), starts, [1.0, 0.0]) == pytest.approx(0.8 * (1 - share))
    with pytest.raises(InputError, match="follow-up scenes"):
        two_stage_score(0.8, np.zeros(2), np.zeros((0, 2)), [])


def test_wrong_input_is_one_line() -> None:
    with pytest.raises(InputError, match="must be finite"):
        dataclasses.replace(drive(), speed_mps=np.full(STEPS, np.nan))
    with pytest.raises(InputError, match="41 steps are scored"):
        score_plan(drive(), NOBODY, others(steps=5), ROADS, 10.0)
