"""Plans are followed: straight on, round circles and corners, late, badly said, to a halt, and not at all."""

import math

import numpy as np
import pytest
import torch

from foredrive.driving.controller import ControllerState, follow
from foredrive.driving.dynamics import EGO, STEP_S, step
from foredrive.driving.plans import fit_path, fixed_in_world
from foredrive.errors import InputError
from foredrive.scene import BicycleState, Trajectory

DT_S = 0.5


def trajectory(xy: np.ndarray) -> Trajectory:
    points = torch.tensor(np.asarray(xy), dtype=torch.float32)[None, None]
    flat = points[..., 0]
    return Trajectory(points, 0 * flat, torch.ones_like(flat, dtype=torch.bool), torch.zeros(1, 1), DT_S)


def circle(speed_mps: float, curvature: float, steps: int = 6) -> np.ndarray:
    turn = curvature * speed_mps * DT_S * np.arange(1, steps + 1)
    return np.stack([np.sin(turn), 1 - np.cos(turn)], axis=1) / curvature


def straight(ways_m: list[float]) -> np.ndarray:
    return np.stack([np.array(ways_m), np.zeros(len(ways_m))], axis=1)


def drive(
    waypoints: np.ndarray, start: BicycleState, seconds: float, latency_s: float = 0.0
) -> list[BicycleState]:
    controller = ControllerState().expecting(fixed_in_world(trajectory(waypoints), start, 0.0), latency_s)
    states = [start]
    for index in range(round(seconds / STEP_S)):
        control, controller = follow(controller, states[-1], index * STEP_S)
        states.append(step(states[-1], control))
    return states


@pytest.mark.parametrize(
    ("speed_mps", "radius_m", "within_m"),
    [(2.0, 6.0, 0.05), (4.0, 7.0, 0.15), (6.0, 15.0, 0.03), (10.0, -40.0, 0.01), (15.0, 90.0, 0.01)],
)
def test_one_plan_leads_round_a_circle(speed_mps: float, radius_m: float, within_m: float) -> None:
    steering = math.atan(EGO.wheelbase_m / radius_m)
    start = BicycleState(0.0, 0.0, 0.0, speed_mps, steering)
    states = drive(circle(speed_mps, 1 / radius_m), start, 3.0)
    off_m = [math.hypot(s.x_m, s.y_m - radius_m) - abs(radius_m) for s in states]
    assert max(map(abs, off_m)) < within_m
    assert max(abs(s.speed_mps - speed_mps) for s in states) < 0.1
    way_m = speed_mps * 3.0
    turned = math.remainder(states[-1].yaw_rad - way_m / radius_m, 2 * math.pi)
    assert abs(turned) < 0.1


@pytest.mark.parametrize("speed_mps", [1.0, 8.0, 20.0])
def test_straight_on_stays_straight_and_on_time(speed_mps: float) -> None:
    start = BicycleState(5.0, 7.0, math.pi / 2, speed_mps)
    states = drive(straight([speed_mps * DT_S * k for k in range(1, 7)]), start, 3.0)
    assert states[-1].x_m == pytest.approx(5.0, abs=1e-4)
    assert states[-1].y_m == pytest.approx(7.0 + 3 * speed_mps, abs=0.02)


def test_it_gets_back_to_its_path_and_its_time() -> None:
    plan = fixed_in_world(
        trajectory(straight([5.0 * k for k in range(1, 13)])), BicycleState(0.0, 0.0, 0.0, 10.0), 0.0
    )
    state, controller = BicycleState(-2.0, 0.8, 0.1, 9.0), ControllerState(plan)
    for index in range(100):
        control, controller = follow(controller, state, index * STEP_S)
        state = step(state, control)
    assert state.y_m == pytest.approx(0.0, abs=0.02)
    assert state.yaw_rad == pytest.approx(0.0, abs=0.01)
    assert state.x_m == pytest.approx(50.0, abs=0.1)
    assert state.speed_mps == pytest.approx(10.0, abs=0.1)


def test_it_stops_where_the_plan_stops_and_stays() -> None:
    # From 8 m/s at 2 m/s²: 4 s, 16 m
    times = DT_S * np.arange(1, 13)
    ways = np.where(times < 4, 8 * times - times**2, 16.0)
    states = drive(straight(ways.tolist()), BicycleState(0.0, 0.0, 0.0, 8.0), 6.0)
    assert states[-1].x_m == pytest.approx(16.0, abs=0.15)
    assert all(s.speed_mps == 0 for s in states[-10:])
    assert min(s.acceleration_mps2 for s in states) > -3.5


def test_it_starts_from_standstill_as_planned() -> None:
    times = DT_S * np.arange(1, 7)
    states = drive(straight((0.75 * times**2).tolist()), BicycleState(0.0, 0.0, 0.0, 0.0), 3.0)
    assert states[-1].x_m == pytest.approx(6.75, abs=0.3)
    assert states[-1].speed_mps == pytest.approx(4.5, abs=0.3)


def test_a_plan_that_stands_holds_the_vehicle() -> None:
    jitter = np.array([[0.02, 0.05], [-0.1, 0.02], [0.1, -0.1], [0.05, 0.1], [0.15, 0.0], [-0.02, -0.05]])
    start = BicycleState(1.0, 2.0, 0.5, 0.0, 0.2)
    states = drive(jitter, start, 3.0)
    assert states[-1] == start  # the wheel too


def test_a_plan_backwards_is_waited_out() -> None:
    states = drive(straight([-1.0, -2.0, -3.0]), BicycleState(0.0, 0.0, 0.0, 3.0), 3.0)
    assert states[-1].speed_mps == 0
    assert 0 < states[-1].x_m < 2.0


def test_without_a_plan_and_beyond_its_end_it_brakes_to_a_halt() -> None:
    state, controller = BicycleState(0.0, 0.0, 0.0, 6.0), ControllerState()
    for index in range(60):
        control, controller = follow(controller, state, index * STEP_S)
        state = step(state, control)
    assert (state.speed_mps, state.y_m) == (0.0, 0.0)
    states = drive(straight([3.0, 6.0]), BicycleState(0.0, 0.0, 0.0, 6.0), 4.0)
    assert states[20].speed_mps == pytest.approx(6.0, abs=0.05)
    assert states[-1].speed_mps == 0


def corner(radius_m: float) -> np.ndarray:
    """A road, x y heading every .1 m: straight, a quarter turn between clothoids of 8 m, straight."""
    arc = max(1, round((radius_m * math.pi / 2 - 8) * 10))
    ramp = np.linspace(0, 1 / radius_m, 80)
    bend = np.concatenate([np.zeros(300), ramp, np.full(arc, 1 / radius_m), ramp[::-1], np.zeros(1500)])
    heading = 0.1 * np.cumsum(bend)
    return np.stack([0.1 * np.cumsum(np.cos(heading)), 0.1 * np.cumsum(np.sin(heading)), heading], axis=1)


def replanned(
    radius_m: float, speed_mps: float, latency_s: float, noise_m: float = 0.0, start_m: float = 0.0
) -> np.ndarray:
    """Offsets from a road, driven by plans made twice a second of waypoints on it."""
    road, rng = corner(radius_m), np.random.default_rng(0)
    state, controller, offsets = BicycleState(0.0, start_m, 0.0, speed_mps), ControllerState(), []
    way_m = 30 + 1.6 * radius_m + 40
    ahead = np.round(10 * speed_mps * DT_S * np.arange(1, 7)).astype(int)
    for index in range(round(way_m / speed_mps / STEP_S)):
        offset = road[:, :2] - [state.x_m, state.y_m]
        near = int(np.argmin((offset**2).sum(axis=1)))
        if index % 10 == 0:
            cos, sin = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
            points = offset[near + ahead] @ np.array([[cos, -sin], [sin, cos]])
            points = points + noise_m * rng.standard_normal(points.shape)
            plan = fixed_in_world(trajectory(points), state, index * STEP_S)
            controller = controller.expecting(plan, index * STEP_S + (latency_s if index else 0.0))
        control, controller = follow(controller, state, index * STEP_S)
        state = step(state, control)
        offsets.append(np.sin(road[near, 2]) * offset[near, 0] - np.cos(road[near, 2]) * offset[near, 1])
    return np.array(offsets)


@pytest.mark.parametrize("latency_s", [0.0, 0.2, 0.5])
@pytest.mark.parametrize(("radius_m", "speed_mps"), [(7.0, 3.0), (10.0, 5.0), (50.0, 12.0)])
def test_corners_are_kept_to_by_plans_that_come_late(
    radius_m: float, speed_mps: float, latency_s: float
) -> None:
    assert np.abs(replanned(radius_m, speed_mps, latency_s)).max() < 0.1


def test_plans_with_noise_swing_nothing_up() -> None:
    assert np.abs(replanned(10.0, 5.0, 0.2, noise_m=0.1)).max() < 0.25


def test_plans_that_want_back_at_once_do_not_overshoot() -> None:
    # The first waypoint, 2.5 m ahead, asks for 1 m to the side.
    offsets = replanned(50.0, 5.0, 0.2, start_m=1.0)
    assert offsets.min() > -0.1
    assert np.abs(offsets[100:]).max() < 0.1


def test_a_plan_counts_once_it_is_there_and_a_newer_one_is_not_replaced_by_an_older() -> None:
    here = BicycleState(0.0, 0.0, 0.0, 5.0)
    first, second = (fixed_in_world(trajectory(straight([2.5, 5.0])), here, made_s) for made_s in (0.0, 0.5))
    controller = ControllerState().expecting(second, 0.7).expecting(first, 0.9)
    assert controller.at(0.69).plan is None
    assert controller.at(0.7).plan is second
    assert controller.at(0.7).at(1.0).plan is second
    assert controller.at(2.0).plan is second
    assert controller.at(0.7).coming == ((0.9, first),)


def test_the_most_probable_alternative_is_followed_as_far_as_it_is_valid() -> None:
    xy = torch.zeros(2, 4, 2)
    xy[1, :, 0] = torch.tensor([3.0, 6.0, 9.0, torch.nan])
    valid = torch.ones(2, 4, dtype=torch.bool)
    valid[1, 3] = False
    alternatives = Trajectory(xy, torch.zeros(2, 4), valid, torch.tensor([-2.0, -0.1]), DT_S)
    plan = fixed_in_world(alternatives, BicycleState(0.0, 0.0, 0.0, 6.0), 0.0)
    assert plan.horizon_s == 1.5
    assert plan.progress_m(1.0) == pytest.approx(6.0)
    assert plan.speed_mps(0.7) == pytest.approx(6.0)
    assert plan.speed_mps(1.6) == 0


def test_plans_that_are_none_are_named() -> None:
    here, good = BicycleState(0.0, 0.0, 0.0, 5.0), trajectory(straight([1.0, 2.0]))
    with pytest.raises(InputError, match="finite waypoints"):
        fixed_in_world(trajectory(straight([1.0, math.nan])), here, 0.0)
    with pytest.raises(InputError, match="expected one plan"):
        fixed_in_world(good.map_tensors(lambda tensor: torch.cat([tensor, tensor])), here, 0.0)


def test_the_fitted_path_is_the_circle_the_waypoints_are_on() -> None:
    path = fit_path(circle(8.0, 1 / 25), DT_S, 1 / 25)
    inside = 8.0 * 3.0
    np.testing.assert_allclose(path.curvature[: int(inside / 0.25)], 1 / 25, rtol=5e-3)
    way_m, left_m = path.project(circle(8.0, 1 / 25)[2])
    assert way_m == pytest.approx(12.0, abs=0.03)
    assert left_m == pytest.approx(0.0, abs=0.01)
