"""The driver model against its closed form."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from foredrive.driving.car_following import follow_acceleration, free_acceleration


def follow(
    free: float, speed: float, closing: float, gap: float, time_gap: float = 1.5, accel: float = 1.0
) -> float:
    """With s0 = 2 m and b = 2 m/s²."""
    values = (free, speed, closing, gap, 2.0, time_gap, accel, 2.0)
    return float(follow_acceleration(*(np.array([value]) for value in values))[0])


def free(speed: float, wanted: float, accel: float = 1.0) -> float:
    return float(free_acceleration(*(np.array([v]) for v in (speed, wanted, accel, 2.0)))[0])


def test_open_road_is_the_formula_of_treiber_et_al() -> None:
    assert free(0.0, 10.0) == pytest.approx(1.0)
    assert free(5.0, 10.0) == pytest.approx(1.0 - 0.5**4)
    assert free(10.0, 10.0) == pytest.approx(0.0)
    assert free(11.0, 10.0) == pytest.approx(-2.0)  # 1 m/s too fast, to be off within half a second
    assert free(30.0, 10.0) == pytest.approx(-4.0)  # never beyond twice the comfortable deceleration


def test_in_equilibrium_nobody_brakes_or_accelerates() -> None:
    # Behind a car of the same speed the desired gap is s0 + v T = 2 + 8 * 1.5 = 14 m.
    assert follow(free(8.0, 10.0), speed=8.0, closing=0.0, gap=14.0) == pytest.approx(0.0)
    assert follow(free(8.0, 10.0), speed=8.0, closing=0.0, gap=13.0) < 0
    assert follow(free(8.0, 10.0), speed=8.0, closing=0.0, gap=15.0) > 0


def test_closing_in_needs_a_larger_gap() -> None:
    # s* = 2 + 8 * 1.5 + 8 * 4 / (2 √2) = 25.31 m; below it a (1 - (s* / s)²).
    desired = 2 + 12 + 8 * 4 / (2 * np.sqrt(2.0))
    at_20_m = follow(free(8.0, 10.0), speed=8.0, closing=4.0, gap=20.0)
    assert at_20_m == pytest.approx(1 - (desired / 20) ** 2)


def test_who_is_too_fast_and_too_near_brakes_for_both() -> None:
    # 1 m/s above the wanted speed: -2 m/s². At half the desired gap of 2 + 11 * 1.5 m: a (1 - 2²) more.
    assert follow(free(11.0, 10.0), speed=11.0, closing=0.0, gap=18.5 / 2) == pytest.approx(-2.0 - 3.0)


def test_an_open_road_is_no_obstacle() -> None:
    assert follow(free(5.0, 10.0), speed=5.0, closing=0.0, gap=np.inf) == pytest.approx(free(5.0, 10.0))


@given(
    speed=st.floats(0, 30),
    wanted=st.floats(1, 30),
    closing=st.floats(-10, 10),
    gap=st.floats(0.1, 200),
    nearer=st.floats(0.05, 1),
)
def test_a_smaller_gap_never_makes_one_faster(
    speed: float, wanted: float, closing: float, gap: float, nearer: float
) -> None:
    far = follow(free(speed, wanted), speed, closing, gap)
    near = follow(free(speed, wanted), speed, closing, gap * nearer)
    assert near <= far + 1e-9
    assert far <= free(speed, wanted) + 1e-9


def test_a_driver_comes_to_rest_two_metres_behind_a_standing_car() -> None:
    speed, gap = 12.0, 80.0
    for _ in range(600):
        a = max(-8.0, follow(free(speed, 12.0, 1.5), speed, speed, gap, accel=1.5))
        speed, gap = max(0.0, speed + 0.1 * a), gap - 0.1 * speed
    assert speed < 0.05
    assert gap == pytest.approx(2.0, abs=0.4)
