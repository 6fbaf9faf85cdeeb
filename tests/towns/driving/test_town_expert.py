"""What the expert's plan is made of: back to its path, into nobody, over no line too late, over at last."""

import dataclasses
import math

import numpy as np
import pytest

from foredrive.driving.collisions import RoadUsers
from foredrive.driving.dynamics import EGO
from foredrive.scene import Category
from foredrive.scene.conditions import BackgroundTraffic
from foredrive.scene.traffic_light import LightState
from foredrive.towns.driving.town import TownScenario, TownSimulator
from foredrive.towns.driving.town_expert import TownExpert, _is_free, _is_too_late, _rejoined
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.traffic.external_ego import EgoPose
from foredrive.towns.traffic.fleet import ego_vehicle
from foredrive.towns.traffic.lane_graph import LaneControl
from foredrive.towns.traffic.scenario_vehicles import add_vehicle
from foredrive.towns.traffic.traffic import Traffic

FRONT_M = EGO.axle_to_centre_m + 0.5 * EGO.length_m
BEGIN_M = 20.0
HERE = EgoPose(np.zeros(3), 0.0, 5.0)
STRAIGHT = np.stack([np.arange(0.0, 31.0), np.zeros(31)], axis=1)


def test_who_is_beside_its_path_comes_back_to_it_little_by_little() -> None:
    path = _rejoined(STRAIGHT, np.array([0.0, 2.0]))
    np.testing.assert_allclose(path[0], [0.0, 2.0])
    assert path[5, 1] == pytest.approx(2.0 / math.e)
    assert path[30, 1] < 0.01
    np.testing.assert_allclose(path[:, 0], STRAIGHT[:, 0])


def car_at(x_m: float, y_m: float = 0.0) -> RoadUsers:
    """4.5 m long and 1.8 m wide."""
    return RoadUsers(
        track_id=np.array([7]),
        category=np.array([int(Category.CAR)]),
        foot_m=np.array([[x_m, y_m, 0.0]]),
        yaw=np.zeros(1),
        half_lw=np.array([[2.25, 0.9]]),
        velocity_mps=np.zeros((1, 2)),
    )


@pytest.mark.parametrize(
    ("way_m", "users", "free"),
    [
        # Its bumper comes to 4.1 m before the axle, and 0.2 m are left: the car's rear is at 12.75 m.
        ([0.0, 4.0, 8.0], [car_at(15.0)] * 3, True),
        ([0.0, 4.0, 8.6], [car_at(15.0)] * 3, False),
        ([0.0, 4.0, 12.0], [car_at(15.0)] * 2 + [car_at(15.0, 2.2)], True),  # he is gone by then
        ([0.0, 4.0, 12.0], [car_at(15.0)] * 2 + [car_at(15.0, 2.0)], False),  # 0.92 m, 0.2 m, 0.9 m
    ],
)
def test_a_path_is_free_if_nobody_is_touched_at_the_time(
    way_m: list[float], users: list[RoadUsers], free: bool
) -> None:
    path = STRAIGHT[:21:10]
    assert _is_free(path, path[:, 0], np.array(way_m), users, HERE) == free


@pytest.fixture(scope="module")
def traffic() -> Traffic:
    return Traffic(load_town_map("Town02"), 1, 1, 0)


@pytest.mark.parametrize(
    ("shows", "to_line_m", "mps", "late"),
    [
        ((LightState.GREEN, LightState.GREEN), 2.0, 0.0, False),
        ((LightState.GREEN, LightState.YELLOW), 2.0, 0.0, True),
        ((LightState.GREEN, LightState.YELLOW), 2.0, 4.0, False),  # under way
        (
            (LightState.GREEN, LightState.YELLOW),
            9.0,
            0.0,
            False,
        ),  # it may still come up to the line
        ((LightState.RED, LightState.RED), 2.0, 0.0, True),
    ],
)
def test_nobody_sets_off_over_a_line_that_closes_before_he_is_over_it(
    traffic: Traffic,
    shows: tuple[LightState, LightState],
    to_line_m: float,
    mps: float,
    late: bool,
) -> None:
    graph = traffic.lanes
    lit = np.flatnonzero((graph.control == LaneControl.LIGHT) & graph.contested)
    befores = graph.predecessors[lit, 0]
    roomy = (befores >= 0) & ~graph.contested[befores] & (graph.length_m[befores] > 30.0)
    inside, before = int(lit[roomy][0]), int(befores[roomy][0])
    s_m = float(graph.length_m[before]) - to_line_m - 0.5 * EGO.length_m
    state = traffic.start(ego_vehicle(graph, np.array([before]), np.array([s_m])), np.array([before, inside]))
    state.vehicles.speed_mps[0] = mps
    times = np.arange(0.0, 120.0, 0.5).tolist()
    at_s = next(
        t for t in times if tuple(traffic.signals.light_states(t + ds)[inside] for ds in (0.0, 2.5)) == shows
    )
    assert _is_too_late(traffic, dataclasses.replace(state, time_s=at_s)) == late


@pytest.fixture(scope="module")
def simulator() -> TownSimulator:
    """At rest on a long lane of Town02, with nobody else."""
    graph = Traffic(load_town_map("Town02"), 1, 1, 0).lanes
    lane = int(np.argmax(np.where(graph.contested, 0.0, graph.length_m)))
    route = graph.position(np.full(90, lane), BEGIN_M + np.arange(90))
    simulator = TownSimulator()
    simulator.reset(
        TownScenario("Town02", route, 3, lanes=(lane,), background_traffic=BackgroundTraffic(0, 0))
    )
    return simulator


@pytest.mark.parametrize(("ahead_m", "mps"), [(None, 0.0), (9.0, 0.0), (9.0, 4.0)])
def test_it_edges_along_the_route_until_somebody_is_near(
    simulator: TownSimulator, ahead_m: float | None, mps: float
) -> None:
    traffic, now, (lane,) = simulator.traffic, simulator.predict_now(), simulator.scenario.lanes
    slot = traffic.scenario_slots[0]
    if ahead_m is not None:
        there = add_vehicle(traffic, now.traffic, slot, (lane,), BEGIN_M + ahead_m, mps)
        now = dataclasses.replace(now, traffic=there)
    expert = TownExpert(simulator)
    expert._imagined = [now] * 31
    plan = expert._edged_over(traffic, simulator.driven)
    way_m = np.hypot(*(plan - simulator.scenario.route_xyz[0, :2]).T)
    if ahead_m is None:  # at 1 m/s² to 2.5 m/s in 2.5 s, then on for 0.5 s
        assert way_m[-1] == pytest.approx(0.5 * 2.5**2 + 2.5 * 0.5, abs=0.2)
        assert (np.diff(way_m) > 0).all()
    elif mps > 0:
        np.testing.assert_allclose(way_m, 0.0, atol=0.05)  # he goes first
    else:
        rear_m = ahead_m - 0.5 * now.traffic.vehicles.size_lwh[slot, 0]
        assert 0.5 <= rear_m - FRONT_M - way_m[-1] < 0.5 + 0.3
