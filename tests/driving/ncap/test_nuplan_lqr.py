"""nuPlan's regulators: fits by hand, limits, and where the vehicle goes under each set of rules."""

import dataclasses
import math

import numpy as np
import pytest

from foredrive.driving.ncap.nuplan_lqr import LqrPlan, fitted_profiles, lqr_step
from foredrive.driving.ncap.rules import PACIFICA
from foredrive.scene import BicycleState

ORIGIN = BicycleState(10.0, -4.0, 0.7, 8.0)


def plan(xy: np.ndarray, origin: BicycleState = ORIGIN) -> LqrPlan:
    return LqrPlan(origin, xy, 0.5)


def straight(speed_mps: float) -> np.ndarray:
    return np.stack([speed_mps * 0.5 * np.arange(1, 7), np.zeros(6)], axis=1)


def driven(
    followed: LqrPlan, steps: int, *, feedback: bool = True, from_: BicycleState = ORIGIN
) -> BicycleState:
    state = from_
    for step in range(steps):
        state = lqr_step(followed, state, 0.1 * step, PACIFICA, 1.0, feedback)
    return state


def test_profiles_of_an_arc_are_its_speed_and_curvature() -> None:
    """5 m/s on a circle of radius 20 m, whose chords are a little shorter than the arc."""
    turn = 0.1 * 5.0 / 20.0 * np.arange(31)
    poses = np.stack([20 * np.sin(turn), 20 * (1 - np.cos(turn)), turn], axis=1)
    speeds, curvatures = fitted_profiles(poses)
    assert np.allclose(speeds, 5.0, atol=2e-3)
    assert np.allclose(curvatures, 1 / 20, atol=2e-4)


def test_profiles_of_braking_fall_with_the_deceleration() -> None:
    t = 0.1 * np.arange(21)
    poses = np.stack([8 * t - t**2, 0 * t, 0 * t], axis=1)  # 2 m/s² from 8 m/s
    speeds, curvatures = fitted_profiles(poses)
    assert np.allclose(speeds, 8 - 2 * (t[:-1] + 0.05), atol=0.02)
    assert np.allclose(curvatures, 0.0, atol=1e-9)


@pytest.mark.parametrize("feedback", [True, False])
def test_a_straight_plan_at_its_speed_is_driven(feedback: bool) -> None:
    """Without feedback each command after the first sees a plan that begins again: its first points hurry."""
    end = driven(plan(straight(8.0)), 5 if feedback else 1, feedback=feedback)
    way_m = 8.0 * (0.5 if feedback else 0.1)
    assert end.speed_mps == pytest.approx(8.0, abs=1e-3)
    assert end.x_m == pytest.approx(10.0 + way_m * math.cos(0.7), abs=1e-3)
    assert end.y_m == pytest.approx(-4.0 + way_m * math.sin(0.7), abs=1e-3)


def test_the_speed_command_is_the_closed_form_of_the_regulator() -> None:
    """a = h q Δv / (h² q + r) with h = 1 s, q = 10, r = 1."""
    end = driven(plan(straight(9.0)), 1)
    assert end.acceleration_mps2 == pytest.approx(10 / 11 * 1.0, rel=0.01)
    assert end.speed_mps == pytest.approx(8.0 + 0.1 * end.acceleration_mps2)


def test_accelerations_are_limited_to_6() -> None:
    assert driven(plan(straight(30.0)), 1).acceleration_mps2 == 6.0
    crawl = driven(plan(np.stack([np.linspace(0.2, 1.2, 6), np.zeros(6)], axis=1)), 1)
    assert crawl.acceleration_mps2 == -6.0


def test_a_plan_that_ends_within_a_metre_stops_the_vehicle() -> None:
    slow = dataclasses.replace(ORIGIN, speed_mps=2.0)
    halted = plan(np.full((6, 2), 0.4), slow)
    one = driven(halted, 1, from_=slow)
    assert one.acceleration_mps2 == pytest.approx(-3.0)  # 1.5 per s
    assert 0 < driven(halted, 30, from_=slow).speed_mps < 0.05


def test_the_vehicle_returns_to_the_plan_only_if_it_knows_where_it_is() -> None:
    """It starts 1 m left of the plan's origin, on a plan straight ahead."""
    left = dataclasses.replace(
        ORIGIN, x_m=ORIGIN.x_m - math.sin(ORIGIN.yaw_rad), y_m=ORIGIN.y_m + math.cos(ORIGIN.yaw_rad)
    )

    def aside_m(state: BicycleState) -> float:
        dx, dy = state.x_m - ORIGIN.x_m, state.y_m - ORIGIN.y_m
        return -dx * math.sin(ORIGIN.yaw_rad) + dy * math.cos(ORIGIN.yaw_rad)

    assert aside_m(driven(plan(straight(8.0)), 12, from_=left)) < 0.4
    assert aside_m(driven(plan(straight(8.0)), 4, from_=left, feedback=False)) == pytest.approx(1.0)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_curve_is_turned_into(side: float) -> None:
    turn = 8.0 / 25.0 * 0.5 * np.arange(1, 7)
    arc = np.stack([25 * np.sin(turn), side * 25 * (1 - np.cos(turn))], axis=1)
    end = driven(plan(arc), 15)
    assert math.remainder(end.yaw_rad - 0.7, 2 * math.pi) == pytest.approx(side * 8.0 / 25.0 * 1.5, rel=0.2)
    assert abs(end.steering_rad) <= PACIFICA.max_steering_rad
