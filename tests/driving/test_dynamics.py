"""The kinematic bicycle against circles, stopping distances and limits worked out by hand."""

import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from foredrive.data.log_writer import EGO_VEHICLE
from foredrive.driving.dynamics import EGO, STEP_S, Vehicle, step, yaw_rate_radps
from foredrive.errors import InputError
from foredrive.scene import BicycleState, Control

AT_ONCE = dataclasses.replace(EGO, max_steering_radps=1e9, max_jerk_mps3=1e9)


def test_the_vehicle_is_the_one_that_towns_are_recorded_with() -> None:
    assert EGO.wheelbase_m == EGO_VEHICLE.wheel_base
    assert (EGO.length_m, EGO.width_m) == (EGO_VEHICLE.length, EGO_VEHICLE.width)
    assert EGO.axle_to_centre_m == EGO_VEHICLE.rear_axle_to_center_longitudinal


@pytest.mark.parametrize("dt_s", [0.05, 0.5])
def test_held_steering_draws_a_circle_exactly(dt_s: float) -> None:
    # wheelbase 3 m, δ = atan(3 / 10): radius 10 m to the left, centre at (0, 10)
    vehicle, steering = dataclasses.replace(AT_ONCE, wheelbase_m=3.0), math.atan(0.3)
    state = BicycleState(0.0, 0.0, 0.0, 5.0, steering_rad=steering)
    for index in range(1, 41):
        state = step(state, Control(0.0, steering), dt_s, vehicle)
        assert math.hypot(state.x_m, state.y_m - 10.0) == pytest.approx(10.0, abs=1e-9)
        turned = math.remainder(state.yaw_rad - 0.5 * dt_s * index, 2 * math.pi)
        assert turned == pytest.approx(0.0, abs=1e-9)
    assert yaw_rate_radps(state, vehicle) == pytest.approx(0.5)


def test_while_the_wheel_turns_the_mean_of_its_angles_counts() -> None:
    # From 0 to 0.2 rad within the step: 0.5 m on a circle of curvature tan(0.1) / wheelbase.
    state = step(BicycleState(0.0, 0.0, 0.0, 10.0), Control(0.0, 0.2), 0.05, AT_ONCE)
    assert state.steering_rad == 0.2
    assert state.yaw_rad == pytest.approx(0.5 * math.tan(0.1) / EGO.wheelbase_m)


def test_the_step_s_size_does_not_matter_on_an_accelerated_arc() -> None:
    start = BicycleState(3.0, -2.0, 1.0, 4.0, steering_rad=-0.2)
    coarse, fine, control = start, start, Control(1.0, -0.2)
    coarse = step(coarse, control, 1.0, AT_ONCE)
    for _ in range(20):
        fine = step(fine, control, 0.05, AT_ONCE)
    assert dataclasses.astuple(fine) == pytest.approx(dataclasses.astuple(coarse), abs=1e-12)
    assert coarse.speed_mps == 5.0


def test_it_brakes_to_a_halt_within_a_step_and_never_reverses() -> None:
    # 2 m/s at 8 m/s²: .25 s, .25 m
    state = step(BicycleState(0.0, 0.0, 0.0, 2.0), Control(-8.0, 0.0), 1.0, AT_ONCE)
    assert (state.x_m, state.speed_mps, state.acceleration_mps2) == (0.25, 0.0, 0.0)
    for _ in range(10):
        state = step(state, Control(-8.0, 0.3), STEP_S)
    assert (state.x_m, state.y_m, state.yaw_rad, state.speed_mps) == (0.25, 0.0, 0.0, 0.0)
    assert state.steering_rad == pytest.approx(0.3)  # the wheel turns while the vehicle stands


def test_braking_builds_up_and_the_way_to_a_halt_is_that_of_physics() -> None:
    # By 1.5 m/s² each .05 s down to -8: after six steps v = 10 - .05 (1.5 + 3 + 4.5 + 6 + 7.5 + 8) = 8.475
    state = BicycleState(0.0, 0.0, 0.0, 10.0)
    for _ in range(6):
        state = step(state, Control(-20.0, 0.0))
    assert state.acceleration_mps2 == -8.0
    assert state.speed_mps == pytest.approx(8.475)
    way_m = state.x_m + 8.475**2 / 16
    while state.speed_mps > 0:
        state = step(state, Control(-20.0, 0.0))
    assert state.x_m == pytest.approx(way_m, abs=1e-9)


def test_steering_and_acceleration_have_rates_and_ends() -> None:
    state = BicycleState(0.0, 0.0, 0.0, 0.0)
    seen = [state := step(state, Control(9.0, 2.0)) for _ in range(40)]
    assert seen[0].steering_rad == pytest.approx(0.7 * 0.05)
    assert seen[0].acceleration_mps2 == pytest.approx(30.0 * 0.05)
    assert seen[-1].steering_rad == EGO.max_steering_rad
    assert seen[-1].acceleration_mps2 == EGO.max_acceleration_mps2
    assert step(state, Control(0.0, -2.0)).steering_rad == pytest.approx(0.6 - 0.035)


@given(st.floats(0, 30), st.floats(-0.6, 0.6), st.floats(-8, 4), st.floats(-50, 50), st.floats(-3, 3))
def test_no_control_leaves_the_limits(
    speed: float, steering: float, acceleration: float, wanted_mps2: float, wanted_rad: float
) -> None:
    before = BicycleState(1.0, 2.0, 3.0, speed, steering, acceleration)
    after = step(before, Control(wanted_mps2, wanted_rad))
    assert 0 <= after.speed_mps <= speed + 4.0 * STEP_S + 1e-9
    assert abs(after.steering_rad) <= EGO.max_steering_rad
    assert abs(after.yaw_rad) <= math.pi
    driven_m = math.hypot(after.x_m - before.x_m, after.y_m - before.y_m)
    assert driven_m <= 0.5 * (speed + after.speed_mps) * STEP_S + 1e-9


def test_equal_states_and_controls_give_equal_bits() -> None:
    states = [BicycleState(0.1, 0.2, 0.3, 7.0)] * 2
    for index in range(50):
        states = [step(state, Control(math.sin(index), 0.1 * math.cos(index))) for state in states]
    assert states[0] == states[1]


def test_a_control_that_is_no_number_is_named() -> None:
    with pytest.raises(InputError, match="finite controls"):
        step(BicycleState(0.0, 0.0, 0.0, 1.0), Control(math.nan, 0.0))
    with pytest.raises(InputError, match="positive time"):
        step(BicycleState(0.0, 0.0, 0.0, 1.0), Control(0.0, 0.0), 0.0, Vehicle())
