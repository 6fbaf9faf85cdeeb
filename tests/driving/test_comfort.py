"""Comfort and time-to-collision against drives and encounters worked out by hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from foredrive.driving.comfort import comfort_of
from foredrive.driving.dynamics import EGO, STEP_S
from foredrive.driving.time_to_collision import MovingBoxes, time_to_collision_s
from foredrive.errors import InputError
from foredrive.scene import BicycleState


def driven(speed: np.ndarray, curvature: np.ndarray | float = 0.0) -> list[BicycleState]:
    bends = np.broadcast_to(curvature, speed.shape)
    return [
        BicycleState(0.0, 0.0, 0.0, float(v), math.atan(EGO.wheelbase_m * float(k)))
        for v, k in zip(speed, bends, strict=True)
    ]


T_S = STEP_S * np.arange(100)


def test_steady_speed_is_comfortable_and_nothing_happens() -> None:
    comfort = comfort_of(driven(np.full(100, 10.0)))
    assert comfort.comfortable
    assert comfort.jerk_mps3 == pytest.approx(0.0, abs=1e-9)
    assert (comfort.braking_mps2, comfort.acceleration_mps2) == pytest.approx((0.0, 0.0), abs=1e-9)


@pytest.mark.parametrize(
    ("rate_mps2", "comfortable"), [(2.3, True), (2.5, False), (-4.0, True), (-4.1, False)]
)
def test_acceleration_and_braking_have_bounds_of_their_own(rate_mps2: float, comfortable: bool) -> None:
    comfort = comfort_of(driven(25.0 + rate_mps2 * T_S))
    assert comfort.comfortable is comfortable
    assert comfort.acceleration_mps2 == pytest.approx(max(rate_mps2, 0.0))
    assert comfort.braking_mps2 == pytest.approx(max(-rate_mps2, 0.0))
    assert comfort.longitudinal_jerk_mps3 == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(("jerk_mps3", "comfortable"), [(4.0, True), (4.2, False)])
def test_jerk_is_the_change_of_acceleration(jerk_mps3: float, comfortable: bool) -> None:
    times = T_S[:31]  # 1.5 s, in which the acceleration keeps its own bounds: from -4 to 2.3 m/s² at most
    comfort = comfort_of(driven(20.0 - 4.0 * times + 0.5 * jerk_mps3 * times**2))
    assert comfort.longitudinal_jerk_mps3 == pytest.approx(jerk_mps3)
    assert comfort.comfortable is comfortable


@pytest.mark.parametrize(("speed_mps", "comfortable"), [(9.8, True), (9.95, False)])
def test_lateral_acceleration_is_v_squared_by_radius(speed_mps: float, comfortable: bool) -> None:
    # radius 20 m: 4.89 m/s² at 9.889 m/s; the jerk v³/r² of turning at it is 2.4 m/s³
    comfort = comfort_of(driven(np.full(100, speed_mps), 1 / 20))
    assert comfort.lateral_mps2 == pytest.approx(speed_mps**2 / 20)
    assert comfort.yaw_rate_radps == pytest.approx(speed_mps / 20)
    assert comfort.jerk_mps3 == pytest.approx(speed_mps**3 / 400)
    assert comfort.comfortable is comfortable


def test_speeding_up_in_a_bend_adds_to_the_jerk_aside() -> None:
    # v' = 1 m/s², curvature k = 1 / 40: in the vehicle's axes the jerk is (-v³ k², 2 v v' k + v v' k)
    speed = 5.0 + T_S
    comfort = comfort_of(driven(speed, 1 / 40))
    assert comfort.jerk_mps3 == pytest.approx(math.hypot(speed[-1] ** 3 / 1600, 3 * speed[-1] / 40))


def test_turning_on_the_spot_is_uncomfortable() -> None:
    comfort = comfort_of(driven(np.full(100, 5.0), 1 / 5))
    assert comfort.yaw_rate_radps == pytest.approx(1.0)
    assert comfort.comfortable_share == 0.0


def test_winding_faster_and_faster_has_a_bound() -> None:
    comfort = comfort_of(driven(np.full(100, 2.0), np.clip(1.0 * T_S, 0, 0.4)))  # 2 rad/s²
    assert comfort.yaw_acceleration_radps2 < 2.0
    slow = comfort_of(driven(np.full(40, 2.0), 0.05 * T_S[:40]))
    assert slow.yaw_acceleration_radps2 == pytest.approx(0.1)


def test_the_share_counts_the_time_out_of_bounds() -> None:
    speed = np.cumsum(np.where(T_S < 2.5, 0.0, 3.0)) * STEP_S
    assert comfort_of(driven(speed)).comfortable_share == pytest.approx(0.5, abs=0.1)


def test_a_drive_of_a_moment_has_no_comfort() -> None:
    with pytest.raises(InputError, match="31 states, got 30"):
        comfort_of(driven(np.full(30, 1.0)))


def boxes(*rows: tuple[float, float, float, float, float, float, float]) -> MovingBoxes:
    """Rows of x, y, length, width, yaw, vx, vy."""
    a = np.array(rows, dtype=float)
    return MovingBoxes(a[:, :2], a[:, 2:4], a[:, 4], a[:, 5:])


CAR = (0.0, 0.0, 4.0, 2.0, 0.0, 10.0, 0.0)


@pytest.mark.parametrize(
    ("other", "expected_s"),
    [
        ((24.0, 0.0, 4.0, 2.0, 0.0, 0.0, 0.0), 2.0),  # 20 m between the bumpers
        ((24.0, 0.0, 4.0, 2.0, math.pi, -10.0, 0.0), 1.0),  # head-on
        ((24.0, 0.0, 4.0, 2.0, 0.0, 10.0, 0.0), math.inf),  # ahead, as fast
        ((24.0, 0.0, 4.0, 2.0, 0.0, 12.0, 0.0), math.inf),  # ahead, faster
        ((-24.0, 0.0, 4.0, 2.0, 0.0, 15.0, 0.0), 4.0),  # from behind
        ((24.0, 2.1, 4.0, 2.0, 0.0, 0.0, 0.0), math.inf),  # the next lane
        ((2.0, 1.0, 4.0, 2.0, 0.3, 0.0, 0.0), 0.0),  # touching now
        # from the right: in front of us from 1.6 s on, and we get to where it is after 17 m
        ((20.0, -11.0, 4.0, 2.0, math.pi / 2, 0.0, 5.0), 1.7),
        ((20.0, -31.0, 4.0, 2.0, math.pi / 2, 0.0, 5.0), math.inf),  # crosses behind us
        # at 45° a square of 2 m reaches √2 ahead: 20 - 2 - √2
        ((20.0, 0.0, 2.0, 2.0, math.pi / 4, 0.0, 0.0), (18 - math.sqrt(2)) / 10),
    ],
)
def test_time_to_collision(
    other: tuple[float, float, float, float, float, float, float], expected_s: float
) -> None:
    assert time_to_collision_s(boxes(CAR), boxes(other))[0] == pytest.approx(expected_s)


def test_nobody_around_is_no_collision() -> None:
    nobody = MovingBoxes(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2)))
    assert time_to_collision_s(boxes(CAR), nobody).shape == (0,)


@given(st.floats(-30, 30), st.floats(-30, 30), st.floats(-3, 3), st.floats(-10, 10), st.floats(-10, 10))
def test_it_is_the_same_seen_from_the_other_and_in_another_frame(
    x: float, y: float, yaw: float, vx: float, vy: float
) -> None:
    one, other = boxes(CAR), boxes((x, y, 3.0, 1.5, yaw, vx, vy))
    here = time_to_collision_s(one, other)[0]
    assert time_to_collision_s(other, one)[0] == pytest.approx(here, abs=1e-6)
    R = np.array([[math.cos(1.0), -math.sin(1.0)], [math.sin(1.0), math.cos(1.0)]])
    turned = [
        MovingBoxes(b.centre_m @ R.T + [3, 4], b.size_lw_m, b.yaw_rad + 1.0, b.velocity_mps @ R.T)
        for b in (one, other)
    ]
    there = time_to_collision_s(*turned)[0]
    if math.isfinite(here) and math.isfinite(there):  # grazing contacts may fall to either side
        assert there == pytest.approx(here, abs=1e-5)
