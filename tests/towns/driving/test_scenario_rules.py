"""Parts of scenarios: stopping distances, timed arrivals, crossing actors, and orders to vehicles."""

import dataclasses

import numpy as np
import pytest

from foredrive.driving.time_to_collision import MovingBoxes
from foredrive.scene import Category
from foredrive.scene.traffic_light import LightState
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.scenarios.context import ScenarioContext, ScenarioEgo, ScenarioProgress
from foredrive.towns.scenarios.director import pace_among
from foredrive.towns.scenarios.kinematics import arrival_s, cruise_mps, stopping_m
from foredrive.towns.scenarios.scenario import MEETINGS, Scenario, ScenarioKind, Way
from foredrive.towns.scenarios.vehicle_orders import give_orders
from foredrive.towns.traffic.external_ego import EgoPose
from foredrive.towns.traffic.fleet import ego_vehicle
from foredrive.towns.traffic.orders import Orders
from foredrive.towns.traffic.scenario_vehicles import add_vehicle, clear_area, grant_junction, points_along
from foredrive.towns.traffic.scripted_actors import ScriptedActor
from foredrive.towns.traffic.traffic import Traffic
from foredrive.towns.traffic.vehicles import BEHIND

DT_S = 0.1


def test_way_to_a_halt_by_hand() -> None:
    assert stopping_m(12.0) == pytest.approx(1.2 * 12.0 + 144.0 / 8.0)
    # 5 m/s² until the brakes bite: from 10 to 16 m/s in 1.2 s, and 32 m from there.
    assert stopping_m(10.0, 5.0) == pytest.approx(1.2 * 13.0 + 32.0)
    assert stopping_m(10.0, -3.0) == stopping_m(10.0)


def test_arrival_by_hand() -> None:
    assert arrival_s(30.0, 10.0, -2.0, 13.9) == pytest.approx(3.0, abs=1e-3)
    assert arrival_s(30.0, 0.0, 0.0, 13.9) == np.inf
    assert arrival_s(16.0, 0.0, 2.0, 10.0) == pytest.approx(4.0)  # not at the limit yet
    assert arrival_s(45.0, 0.0, 2.0, 10.0) == pytest.approx(5.0 + 2.0)  # 25 m to 10 m/s, and 20 m more
    assert arrival_s(20.0, 12.0, 2.0, 10.0) == pytest.approx(20.0 / 12.0, abs=1e-3)
    # From 10 to 6 m/s at 2 m/s² takes 2 s and 16 m, the 14 m before 1.4 s.
    assert arrival_s(30.0, 10.0, 0.0, 13.9, through_mps=6.0) == pytest.approx(3.4, abs=1e-3)
    # Up from 2 to 6 m/s and down to 4, at 2 m/s² both: 8 m and 5 m.
    assert arrival_s(13.0, 2.0, 2.0, 10.0, through_mps=4.0) == pytest.approx(3.0)
    # Too fast for a way of 9 m to the turn: from 10 m/s to 8 m/s on it.
    assert arrival_s(9.0, 10.0, 0.0, 13.9, through_mps=4.0) == pytest.approx(1.0)


@pytest.mark.parametrize(("way_m", "time_s", "speed"), [(20.0, 4.0, 0.0), (55.0, 6.0, 3.0), (20.0, 2.0, 9.0)])
def test_who_takes_up_the_cruise_speed_is_there_in_time(way_m: float, time_s: float, speed: float) -> None:
    cruise = cruise_mps(way_m, time_s, speed, 3.0)
    assert cruise >= speed
    rising_s = (cruise - speed) / 3.0
    assert 0.5 * (speed + cruise) * rising_s + cruise * (time_s - rising_s) == pytest.approx(way_m)


def test_cruise_speed_at_the_ends_of_what_can_be() -> None:
    assert cruise_mps(100.0, 3.0, 5.0, 3.0) == 5.0 + 9.0  # too far: as fast as it gets
    assert cruise_mps(10.0, 4.0, 8.0, 3.0) == 2.5  # too near: slower at once


def vehicles_at(*rows: tuple[float, float, float, float]) -> MovingBoxes:
    """Cars of 4.5 m by 1.8 m along x: where their middles are, and how fast."""
    table = np.array(rows).reshape(-1, 4)
    size = np.tile([4.5, 1.8], (len(table), 1))
    return MovingBoxes(table[:, :2], size, np.zeros(len(table)), table[:, 2:])


@pytest.mark.parametrize(
    ("others", "pace"),
    [
        (vehicles_at(), 1.4),
        (vehicles_at((-8.0, 3.5, 8.0, 0.0)), 0.0),  # comes, and would be there in a second
        (vehicles_at((8.0, 3.5, 8.0, 0.0)), 1.4),  # has passed
        (vehicles_at((-60.0, 3.5, 8.0, 0.0)), 1.4),  # comes later
        (vehicles_at((0.0, 3.5, 0.0, 0.0)), -0.8),  # stands in the way: he makes room
        (vehicles_at((0.0, 3.5, 0.0, 0.0), (0.0, -1.3, 0.0, 0.0)), 0.0),  # and cannot go back either
    ],
)
def test_a_stray_waits_for_who_comes_and_steps_back_before_who_stands(
    others: MovingBoxes, pace: float
) -> None:
    """He is 1 m along his way, and with what he keeps free 0.65 m to each side along it."""
    walker = crossing_actor([[0, 0, 0], [0, 8, 0]], s_m=1.0)
    assert pace_among(walker, 1.4, others) == pace


def scene_on(
    traffic: Traffic,
    kind: ScenarioKind,
    guests_m: tuple[float, ...],
    mps: float = 0.0,
    done_m: float = 0.0,
    ego_mps: float = 0.0,
) -> ScenarioContext:
    """Guests on the long lane, the first of which plays; they meet at 120 m of it, and 100 m of the route."""
    lane = long_lane(traffic)
    state = traffic.start(ego_vehicle(traffic.lanes, np.array([lane]), np.array([12.0])))
    for slot, along_m in zip(traffic.scenario_slots, guests_m, strict=False):
        state = add_vehicle(traffic, state, slot, (lane,), along_m, mps)
    scenario = Scenario(kind, 100.0, 13.9, ways=(Way((lane,), 120.0, 110.0),), ego_lane=lane)
    count = len(guests_m) if kind in MEETINGS else 1
    progress = ScenarioProgress(slots=tuple(traffic.scenario_slots[:count]))
    ego = ScenarioEgo(5.0, done_m, ego_mps, 0.0, traffic.poses(state).centre_m[0], 0.0)
    return ScenarioContext(traffic, scenario, progress, state, ego, Orders.none(len(state.vehicles.active)))


@pytest.mark.parametrize("kind", [ScenarioKind.LEAD_BRAKES, ScenarioKind.CUT_IN])
@pytest.mark.parametrize("follower_m", [None, 62.0])
def test_who_waits_for_the_ego_vehicle_does_not_hold_up_others_for_long(
    traffic: Traffic, kind: ScenarioKind, follower_m: float | None
) -> None:
    guests_m = (70.0,) if follower_m is None else (70.0, follower_m)
    context = scene_on(traffic, kind, guests_m)
    slot, goes = traffic.scenario_slots[0], []
    for _ in range(60):
        context.orders.max_mps2[:] = np.inf
        context = give_orders(context, DT_S)
        goes.append(bool(context.orders.max_mps2[slot] > 0.0))
    if follower_m is None:
        assert not any(goes)
    else:
        assert goes.index(True) == pytest.approx(30, abs=1)
        assert all(goes[31:])


def test_who_has_passed_is_not_waited_for(traffic: Traffic) -> None:
    kind, (first, second) = ScenarioKind.ONCOMING_TRAFFIC, traffic.scenario_slots
    context = give_orders(scene_on(traffic, kind, (135.0, 100.0), 8.0, done_m=70.0, ego_mps=8.0), DT_S)
    assert context.progress.slots == (second,)
    assert np.isinf(context.orders.max_mps2[first])
    context = give_orders(scene_on(traffic, kind, (136.0, 129.0), 8.0, done_m=70.0, ego_mps=8.0), DT_S)
    assert (context.progress.number, context.progress.begun) == (1, ())


@pytest.mark.parametrize(("along_m", "begins"), [(85.0, True), (100.0, False)])
def test_who_cuts_in_has_room_for_it_before_the_junction(
    traffic: Traffic, along_m: float, begins: bool
) -> None:
    """At 7 m/s a change takes 3.5 s and 24.5 m, and at 11 m/s somebody is so near as it takes."""
    on_route_m = along_m - 20.0
    done_m = on_route_m - 18.5
    context = scene_on(traffic, ScenarioKind.CUT_IN, (along_m,), 7.0, done_m, ego_mps=11.0)
    context = give_orders(context, DT_S)
    assert bool(context.progress.begun) == begins
    assert (context.orders.change is not None) == begins


def test_who_is_over_the_line_does_not_brake_for_a_scenario(traffic: Traffic) -> None:
    context = scene_on(traffic, ScenarioKind.LEAD_BRAKES, (123.0,), 7.0, done_m=90.0, ego_mps=8.0)
    context = give_orders(context, DT_S)
    assert (context.progress.number, context.progress.begun) == (1, ())
    assert np.isinf(context.orders.max_mps2).all()


def crossing_actor(way: list[list[float]], **changes: float) -> ScriptedActor:
    size = np.array([0.5, 0.6, 1.7])
    return ScriptedActor(40_000, Category.PEDESTRIAN, 0, size, np.array(way, dtype=float), **changes)


def test_a_stray_follows_its_way_and_stands_at_its_end() -> None:
    walker = crossing_actor([[0, 0, 1], [4, 0, 1], [4, 3, 1]])
    assert walker.length_m == 7.0
    assert not walker.is_under_way
    walker = walker.moved(1.0, 0.1)  # 4 m/s²: .4 m/s after .1 s
    assert walker.speed_mps == pytest.approx(0.4)
    assert walker.s_m == pytest.approx(0.02)
    for _ in range(50):
        walker = walker.moved(1.0, 0.1)
    assert walker.speed_mps == 1.0
    assert walker.s_m == pytest.approx(0.02 + 0.055 + 0.075 + 0.5 * 0.19 + 4.7, abs=0.05)
    np.testing.assert_allclose(walker.xyz, [4.0, walker.s_m - 4.0, 1.0])
    assert walker.yaw_rad == pytest.approx(np.pi / 2)
    for _ in range(40):
        walker = walker.moved(1.0, 0.1)
    assert (walker.s_m, walker.speed_mps) == (7.0, 0.0)
    assert not walker.is_under_way
    assert walker.yaw_rad == pytest.approx(np.pi / 2)


@pytest.fixture(scope="module")
def traffic() -> Traffic:
    return Traffic(load_town_map("Town02"), 1, 1, 0, scenario_slot_count=2)


def long_lane(traffic: Traffic) -> int:
    graph = traffic.lanes
    return int(np.argmax(np.where(graph.contested, 0.0, graph.length_m)))


def ego_on(traffic: Traffic, lane: int, s_m: float) -> EgoPose:
    """Standing on a lane, its middle there."""
    graph = traffic.lanes
    here, ahead = graph.position(np.array([lane, lane]), np.array([s_m, s_m + 1.0]))
    step = ahead - here
    yaw = float(np.arctan2(step[1], step[0]))
    return EgoPose(here - 1.65 * np.array([np.cos(yaw), np.sin(yaw), 0.0]), yaw, 0.0)


def test_guest_slots_stay_free_and_change_nothing() -> None:
    with_guests, without = (
        Traffic(load_town_map("Town02"), 1, 6, 4, scenario_slot_count=count) for count in (3, 0)
    )
    lane = np.array([long_lane(without)])
    ends = []
    for rules in (with_guests, without):
        state = rules.start(ego_vehicle(rules.lanes, lane, np.array([20.0])))
        for _ in range(40):
            state = rules.step(state, DT_S, ego_on(rules, int(lane[0]), 20.0))
        ends.append(state)
    for name, value in vars(ends[1].vehicles).items():
        np.testing.assert_array_equal(getattr(ends[0].vehicles, name)[:6], value)
    np.testing.assert_array_equal(ends[0].people.xyz, ends[1].people.xyz)
    assert not ends[0].vehicles.active[6:].any()


def test_a_guest_is_where_it_was_put_and_does_as_ordered(traffic: Traffic) -> None:
    lane = long_lane(traffic)
    onward = int(traffic.lanes.successors[lane, 0])
    state = traffic.start(ego_vehicle(traffic.lanes, np.array([lane]), np.array([20.0])))
    slot = traffic.scenario_slots[0]
    state = add_vehicle(traffic, state, slot, (lane, onward), 60.0, 8.0)
    (there,) = points_along(traffic.lanes, (lane, onward), np.array([60.0]))
    np.testing.assert_allclose(traffic.poses(state).centre_m[slot, :2], there[:2], atol=0.6)
    assert state.vehicles.path[slot, BEHIND + 1] == onward
    orders = Orders.none(len(state.vehicles.active))
    orders.max_mps2[slot] = -4.0
    ego = ego_on(traffic, lane, 20.0)
    for _ in range(25):
        state = traffic.step(state, DT_S, ego, orders)
    assert state.vehicles.speed_mps[slot] == 0.0
    # 8 m at 4 m/s² from 8 m/s.
    assert state.vehicles.s_m[slot] == pytest.approx(60.0 + 8.0, abs=1.0)
    for _ in range(25):
        state = traffic.step(state, DT_S, ego)
    assert state.vehicles.speed_mps[slot] > 3.0  # as it likes


@pytest.mark.parametrize("blind", [True, False])
def test_who_is_blind_does_not_brake_for_vehicle_0_alone(traffic: Traffic, blind: bool) -> None:
    lane = long_lane(traffic)
    ego = ego_on(traffic, lane, 90.0)
    state = traffic.start(ego_vehicle(traffic.lanes, np.array([lane]), np.array([90.0])))
    first, second = traffic.scenario_slots
    for slot, along_m in ((first, 60.0), (second, 45.0)):
        state = add_vehicle(traffic, state, slot, (lane,), along_m, 8.0)
    orders = Orders.none(len(state.vehicles.active))
    orders.ignores_ego[first] = blind
    for _ in range(40):
        state = traffic.step(state, DT_S, ego, orders)
    v = state.vehicles
    if blind:
        assert v.s_m[first] > 90.0
    else:
        assert v.s_m[first] + 0.5 * v.size_lwh[first, 0] < 90.0 - 2.4
    assert v.s_m[second] + 0.5 * v.size_lwh[second, 0] < min(87.6, v.s_m[first] - 2.0)


def test_room_is_made_only_out_of_sight(traffic: Traffic) -> None:
    lane = long_lane(traffic)
    state = traffic.start(ego_vehicle(traffic.lanes, np.array([lane]), np.array([20.0])))
    slot = traffic.scenario_slots[0]
    state = add_vehicle(traffic, state, slot, (lane,), 70.0, 0.0)
    room = points_along(traffic.lanes, (lane,), np.array([66.0, 70.0]))
    assert clear_area(traffic, state, room, seen_within_m=80.0) is None
    assert clear_area(traffic, state, room - [50.0, 50.0, 0.0], seen_within_m=80.0) is not None
    out_of_sight = clear_area(traffic, state, room, seen_within_m=30.0)
    assert out_of_sight is not None
    assert not out_of_sight.vehicles.active[slot]
    assert out_of_sight.vehicles.active[0]


def test_drivers_stop_for_actors_that_cross_their_lane(traffic: Traffic) -> None:
    lane = long_lane(traffic)
    state = traffic.start(ego_vehicle(traffic.lanes, np.array([lane]), np.array([20.0])))
    slot = traffic.scenario_slots[0]
    state = add_vehicle(traffic, state, slot, (lane,), 40.0, 8.0)
    here, ahead = points_along(traffic.lanes, (lane,), np.array([75.0, 76.0]))
    left = np.array([-(ahead - here)[1], (ahead - here)[0], 0.0])
    walker = crossing_actor([(here - 4.0 * left).tolist(), (here + 4.0 * left).tolist()], s_m=4.0)
    state = dataclasses.replace(state, scripted_actors=(walker,))
    ego = ego_on(traffic, lane, 20.0)
    for _ in range(80):
        state = traffic.step(state, DT_S, ego)
    front_m = state.vehicles.s_m[slot] + 0.5 * state.vehicles.size_lwh[slot, 0]
    assert state.vehicles.speed_mps[slot] == pytest.approx(0.0, abs=0.1)
    assert 66.0 < front_m < 74.0
    found = next(actor for actor in traffic.actors(state) if actor.track_id == 40_000)
    np.testing.assert_allclose(found.centre_m, here + np.array([0.0, 0.0, 0.85]), atol=1e-6)


def test_vehicle_0_stops_for_crossing_actors_while_it_drives_itself(traffic: Traffic) -> None:
    lane = long_lane(traffic)
    state = traffic.start(ego_vehicle(traffic.lanes, np.array([lane]), np.array([20.0])))
    here, ahead = points_along(traffic.lanes, (lane,), np.array([75.0, 76.0]))
    left = np.array([-(ahead - here)[1], (ahead - here)[0], 0.0])
    walker = crossing_actor([(here - 4.0 * left).tolist(), (here + 4.0 * left).tolist()], s_m=4.0)
    free = state
    state = dataclasses.replace(state, scripted_actors=(walker,))
    for _ in range(120):
        state, free = traffic.step(state, DT_S), traffic.step(free, DT_S)
    assert 66.0 < state.vehicles.front_m[0] < 74.0
    assert free.vehicles.path[0, BEHIND] != lane or free.vehicles.front_m[0] > 80.0


@pytest.mark.parametrize("runs", [True, False])
def test_only_who_may_runs_a_light(traffic: Traffic, runs: bool) -> None:
    graph = traffic.lanes
    guarded = np.flatnonzero(traffic.signals.guarded)
    lane = next(int(n) for n in guarded if graph.length_m[graph.predecessors[n, 0]] > 50.0)
    before = int(graph.predecessors[lane, 0])
    red_s = next(
        t
        for t in np.arange(0.0, 60.0, 0.5).tolist()
        if all(traffic.signals.light_states(t + ds)[lane] == LightState.RED for ds in (0.0, 4.0))
    )
    begin_m = float(graph.length_m[before]) - 30.0
    high = points_along(graph, (before,), np.array([begin_m]))[0] + [0.0, 0.0, 40.0]
    state = traffic.start(ego_vehicle(graph, np.array([lane]), np.array([0.0])))
    slot = traffic.scenario_slots[0]
    state = add_vehicle(traffic, state, slot, (before, lane), begin_m, 9.0)
    state = dataclasses.replace(state, time_s=red_s)
    orders = Orders.none(len(state.vehicles.active))
    orders.runs_lights[slot] = runs
    for _ in range(35):
        if runs and state.vehicles.path[slot, BEHIND] == before:
            state = grant_junction(traffic, state, slot, lane)
        state = traffic.step(state, DT_S, EgoPose(high, 0.0, 0.0), orders)
    assert state.vehicles.active[slot]
    assert (state.vehicles.path[slot, BEHIND] != before) == runs
