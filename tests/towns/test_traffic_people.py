"""People wait at crossings until traffic stops or is gone; cyclists keep to lanes, as fast as cyclists."""

import dataclasses

import numpy as np
import pytest

from foredrive.scene import Category
from foredrive.scene.traffic_light import LightState
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.traffic.drivers import move_vehicles
from foredrive.towns.traffic.pedestrians import (
    Pedestrians,
    crossing_gap,
    draw_people,
    step_pedestrians,
)
from foredrive.towns.traffic.traffic import Traffic, TrafficState
from foredrive.towns.traffic.vehicles import BEHIND, Vehicles, path_starts

DT_S = 0.1


@pytest.fixture(scope="module")
def traffic(town02: TownMap) -> Traffic:
    return Traffic(town02, seed=4, vehicle_count=30, people_count=20)


@pytest.fixture(scope="module")
def states(traffic: Traffic) -> list[TrafficState]:
    """Half a minute of traffic all over the town."""
    states = [traffic.start()]
    for _ in range(300):
        states.append(traffic.step(states[-1], DT_S))
    return states


def at_the_kerb(traffic: Traffic, crossing: int) -> Pedestrians:
    """One person, a step before a crossing that it is going to take."""
    walks = traffic.walks
    place = walks.ends[crossing, 0]
    walk = next(int(w) for w in walks.incident[place] if w >= 0 and not walks.is_crossing[w])
    direction = 1 if walks.ends[walk, 1] == place else -1
    s_m = np.array([walks.length_m[walk] - 0.05 if direction > 0 else 0.05])
    person = draw_people(walks, np.random.default_rng(0), np.array([7]), np.array([walk]), s_m)
    return dataclasses.replace(person, direction=np.array([direction]), next_walk=np.array([crossing]))


def lone_car(traffic: Traffic, before_m: float, speed_mps: float) -> tuple[Vehicles, int]:
    """A car that comes towards a crossing, its bumper `before_m` before the way of those who cross."""
    walks, lanes, state = traffic.walks, traffic.lanes, traffic.start()
    before = lanes.predecessors[walks.lane, 0]
    at = int(np.flatnonzero(lanes.length_m[before] > 40.0)[0])
    car = int(np.flatnonzero(state.vehicles.category == Category.CAR)[0])
    one = Vehicles(**{name: value[[car]].copy() for name, value in vars(state.vehicles).items()})
    path = np.full_like(one.path, -1)
    path[0, BEHIND : BEHIND + 2] = before[at], walks.lane[at]
    front_m = lanes.length_m[before[at]] + walks.lane_span_m[at, 0] - before_m
    car_there = dataclasses.replace(
        one,
        path=path,
        s_m=front_m - 0.5 * one.size_lwh[:, 0],
        speed_mps=np.array([speed_mps]),
        shift_m=np.zeros(1),
    )
    return car_there, int(walks.crossing[at])


def walk_on(traffic: Traffic, person: Pedestrians, cars: Vehicles, light: np.ndarray) -> Pedestrians:
    starts_m = path_starts(traffic.lanes, cars.path)
    rng = np.random.default_rng(1)
    return step_pedestrians(traffic.walks, person, cars, starts_m, light, DT_S, rng)


def test_a_person_waits_for_a_car_that_is_near_and_crosses_behind_it(traffic: Traffic) -> None:
    dark = np.full(len(traffic.lanes.ids), int(LightState.NONE))
    cars, crossing = lone_car(traffic, before_m=10.0, speed_mps=10.0)
    person = at_the_kerb(traffic, crossing)
    crossed_s = None
    for step in range(60):
        person = walk_on(traffic, person, cars, dark)
        on_crossing = bool(traffic.walks.is_crossing[person.walk[0]])
        if on_crossing and crossed_s is None:
            crossed_s = DT_S * step
        if crossed_s is None:
            assert person.s_m[0] == pytest.approx(
                person.s_m[0].clip(0, traffic.walks.length_m[person.walk[0]])
            )
            assert person.waited_s[0] > 0
        cars = move_vehicles(cars, np.zeros(1), DT_S)
    passed_s = (10.0 + cars.size_lwh[0, 0] + 3.4) / 10.0
    assert crossed_s is not None
    assert 10.0 / 10.0 < crossed_s < passed_s + 1.0


def test_a_person_goes_at_once_where_cars_can_stop_and_they_do(traffic: Traffic) -> None:
    dark = np.full(len(traffic.lanes.ids), int(LightState.NONE))
    cars, crossing = lone_car(traffic, before_m=25.0, speed_mps=6.0)
    person = at_the_kerb(traffic, crossing)
    person = walk_on(traffic, person, cars, dark)
    assert traffic.walks.is_crossing[person.walk[0]]
    gap_m = crossing_gap(traffic.walks, person, cars, path_starts(traffic.lanes, cars.path))
    assert gap_m[0] == pytest.approx(25.0, abs=0.01)


def test_nobody_crosses_while_traffic_has_green(traffic: Traffic) -> None:
    walks, guarded = traffic.walks, traffic.signals.guarded
    near = (walks.lane_span_m[:, 0] < 8.0) & guarded[walks.lane]
    crossing, nobody = (
        int(walks.crossing[near][0]),
        dataclasses.replace(traffic.start().vehicles, active=np.zeros(30, dtype=bool)),
    )
    for shows, crosses in (
        (LightState.GREEN, False),
        (LightState.YELLOW, False),
        (LightState.RED, True),
    ):
        light = np.where(guarded, int(shows), int(LightState.NONE))
        person = at_the_kerb(traffic, crossing)
        for _ in range(5):
            person = walk_on(traffic, person, nobody, light)
        assert walks.is_crossing[person.walk[0]] == crosses
        assert (person.waited_s[0] > 0) != crosses


def test_crossings_that_lanes_run_along_are_taken_as_far_as_they_do(traffic: Traffic) -> None:
    """Wherever the middle of a lane is on a crossing, the crossing knows that vehicles pass there."""
    walks, lanes = traffic.walks, traffic.lanes
    for m in range(len(walks.lane)):
        s_m = np.linspace(0.0, walks.length_m[walks.crossing[m]], 80)
        at = walks.position(np.full(80, walks.crossing[m]), s_m)[:, None, :2]
        near = np.linalg.norm(at - lanes.samples(int(walks.lane[m]))[None, :, :2], axis=2).min(axis=1) < 1.0
        assert (s_m[near] >= walks.walk_span_m[m, 0]).all()
        assert (s_m[near] <= walks.walk_span_m[m, 1]).all()


def test_cyclists_ride_on_the_right_of_their_lane_as_fast_as_cyclists(
    traffic: Traffic, states: list[TrafficState]
) -> None:
    first = states[0].vehicles
    riders = np.flatnonzero(first.active & (first.category == Category.BICYCLE))
    assert 0 < len(riders) < 0.3 * first.active.sum()
    fastest = np.max([state.vehicles.speed_mps[riders] for state in states], axis=0)
    assert (fastest < 7.5).all()
    assert fastest.max() > 3.0
    for state in states[::20]:
        v, axle = state.vehicles, traffic.poses(state).axle_xyz
        for i in riders:
            lanes = [lane for lane in v.path[i, BEHIND - 1 : BEHIND + 2].tolist() if lane >= 0]
            line = np.concatenate([traffic.lanes.samples(lane) for lane in lanes])
            beside = np.linalg.norm(line[:, :2] - axle[i, :2], axis=1).min()
            assert 0.6 < beside < 1.4  # .9 m right of the middle, with half a metre between samples
            assert v.shift_m[i] == 0  # they never change lanes
