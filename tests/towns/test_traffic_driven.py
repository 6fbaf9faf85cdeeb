"""Everybody reacts to a vehicle that is driven from outside, on its lane, beside it, across it and off it."""

import dataclasses
import pickle
from collections.abc import Callable

import numpy as np
import pytest

from foredrive.towns.map.town_map import TownMap
from foredrive.towns.traffic.external_ego import EgoPose, find_lane, perceive_ego
from foredrive.towns.traffic.fleet import ego_vehicle, place_vehicles
from foredrive.towns.traffic.lane_graph import LaneControl
from foredrive.towns.traffic.leaders import find_leaders
from foredrive.towns.traffic.traffic import Traffic, TrafficState
from foredrive.towns.traffic.vehicles import BEHIND, Vehicles, path_starts

DT_S = 0.1
AXLE_TO_CENTRE_M = 1.64855


def longest_lane(traffic: Traffic) -> int:
    graph = traffic.lanes
    return int(np.argmax(np.where(graph.contested, 0.0, graph.length_m)))


def driven_at(
    traffic: Traffic, lane: int, s_m: float, aside_m: float = 0.0, turned_rad: float = 0.0, mps: float = 0.0
) -> EgoPose:
    """The ego vehicle with its middle beside a point of a lane."""
    graph = traffic.lanes
    here, ahead = graph.position(np.array([lane, lane]), np.array([s_m, s_m + 0.5]))
    lane_yaw = np.arctan2(*(ahead - here)[1::-1])
    centre = here + aside_m * np.array([-np.sin(lane_yaw), np.cos(lane_yaw), 0.0])
    yaw = lane_yaw + turned_rad
    axle = centre - AXLE_TO_CENTRE_M * np.array([np.cos(yaw), np.sin(yaw), 0.0])
    return EgoPose(axle, float(yaw), mps)


def followed(traffic: Traffic, lane: int, s_m: float, behind_m: float) -> TrafficState:
    """The ego vehicle on a lane, and one car that follows."""
    ego = ego_vehicle(traffic.lanes, np.array([lane]), np.array([s_m]))
    state = traffic.start(ego)
    other = dataclasses.replace(ego, track_id=np.array([77]))
    other = place_vehicles(traffic.lanes, other, np.array([lane]), np.array([s_m - behind_m]))
    vehicles = state.vehicles.replace_rows(np.array([1]), other)
    vehicles = dataclasses.replace(vehicles, active=np.arange(len(vehicles.active)) < 2)
    return traffic._extend_paths(dataclasses.replace(state, vehicles=vehicles), np.random.default_rng(0))


@pytest.fixture(scope="module")
def alone(town02: TownMap) -> Traffic:
    """Two vehicles at most."""
    return Traffic(town02, 1, vehicle_count=2, people_count=0)


@pytest.mark.parametrize(
    ("aside_m", "turned_rad"),
    [(0.0, 0.0), (1.2, 0.2), (0.0, np.pi / 2), (1.0, -2.2), (0.0, np.pi), (-2.0, 0.5)],
    ids=["in lane", "to the left", "across", "askew", "the wrong way", "half off the road"],
)
def test_who_comes_up_behind_stops_for_it(alone: Traffic, aside_m: float, turned_rad: float) -> None:
    lane = longest_lane(alone)
    state = followed(alone, lane, 80.0, behind_m=50.0)
    ego = driven_at(alone, lane, 80.0, aside_m, turned_rad)
    for _ in range(200):
        state = alone.step(state, DT_S, ego)
    reach = 0.5 * (4.9 * abs(np.cos(turned_rad)) + 1.84 * abs(np.sin(turned_rad)))
    gap_m = 80.0 - reach - state.vehicles.front_m[1]
    assert state.vehicles.speed_mps[1] < 0.05
    assert state.vehicles.lane[1] == lane
    assert 0.8 < gap_m < 3.2


def test_nobody_stops_for_who_stands_beside_the_road(alone: Traffic) -> None:
    lane = longest_lane(alone)
    state = followed(alone, lane, 80.0, behind_m=50.0)
    ego = driven_at(alone, lane, 80.0, aside_m=-4.0)
    for _ in range(100):
        state = alone.step(state, DT_S, ego)
    assert state.vehicles.lane[1] != lane or state.vehicles.s_m[1] > 90.0


def test_a_follower_keeps_its_distance_from_a_moving_one(alone: Traffic) -> None:
    lane = longest_lane(alone)
    state, s_m = followed(alone, lane, 60.0, behind_m=25.0), 60.0
    for _ in range(150):
        state = alone.step(state, DT_S, driven_at(alone, lane, s_m, mps=5.0))
        s_m += 5.0 * DT_S
    assert state.vehicles.speed_mps[1] == pytest.approx(5.0, abs=0.3)
    gap_m = s_m - state.vehicles.s_m[1] - 4.9
    assert 2.0 + 1.4 * 5.0 - 1.0 < gap_m < 2.0 + 1.4 * 5.0 + 3.0


def test_a_shadow_lies_on_the_lane_that_is_entered_soon(town_of: Callable[[str], TownMap]) -> None:
    """A second before it cuts in, whoever drives there sees it beside him."""
    traffic = Traffic(town_of("Town05"), 1, vehicle_count=2, people_count=0)
    graph = traffic.lanes
    free = (graph.left >= 0) & (graph.junction < 0) & (graph.length_m > 80)
    lane = int(np.argmax(np.where(free, graph.min_radius_m, 0.0)))
    beside = int(graph.left[lane])
    state = followed(traffic, lane, 50.0, behind_m=30.0)
    for turned_rad, expected in ((0.0, False), (0.15, True)):
        ego = driven_at(traffic, lane, 50.0, turned_rad=turned_rad, mps=12.0)
        seen = perceive_ego(graph, traffic.lane_index, state.vehicles, ego, state.route, 0, 0.0)
        shadows = seen.vehicles.path[seen.count :, BEHIND]
        assert (beside in shadows) == expected
        if expected:
            row = seen.count + int(np.flatnonzero(shadows == beside)[0])
            # Where the rear will be in a second, less the way until then: next to where it is now.
            assert seen.vehicles.rear_m[row] == pytest.approx(50.0 - 2.4, abs=2.0)
            assert seen.vehicles.speed_mps[row] == pytest.approx(12.0 * np.cos(0.15), abs=0.1)


def test_against_the_traffic_a_shadow_comes_towards_it(alone: Traffic) -> None:
    lane = longest_lane(alone)
    state = followed(alone, lane, 80.0, behind_m=50.0)
    ego = driven_at(alone, lane, 80.0, turned_rad=np.pi, mps=6.0)
    seen = perceive_ego(alone.lanes, alone.lane_index, state.vehicles, ego, state.route, 0, 0.0)
    ahead = find_leaders(alone.lanes, seen.vehicles, path_starts(alone.lanes, seen.vehicles.path))
    assert ahead.leader[1] >= seen.count
    assert seen.vehicles.speed_mps[ahead.leader[1]] == pytest.approx(-6.0, abs=0.05)
    # Both bumpers to the other's: 50 m less a length, but for the spacing of samples.
    assert ahead.leader_gap_m[1] == pytest.approx(50.0 - 4.9, abs=0.6)


def before_a_light(traffic: Traffic) -> tuple[int, int]:
    """A lane that ends at a light, and the lane behind the line."""
    graph = traffic.lanes
    for lane in np.flatnonzero((graph.control == LaneControl.LIGHT) & (np.diff(graph.conflicts.first) > 0)):
        before = int(graph.predecessors[lane, 0])
        if before >= 0 and not graph.contested[before] and graph.length_m[before] > 40:
            return before, int(lane)
    raise AssertionError("the town has no such light")


@pytest.mark.parametrize(
    ("to_line_m", "mps", "turn_came_s", "way_taken", "requests"),
    [
        (3.0, 12.0, 0.0, True, True),
        (30.0, 9.0, 0.0, False, True),
        (3.0, 0.0, 0.0, False, True),
        (-0.5, 0.0, 0.0, False, True),
        (3.0, 0.0, 13.0, False, True),
        (3.0, 0.0, 11.0, False, False),
        (3.0, 0.0, 7.0, False, True),
        (12.0, 0.0, 0.0, False, False),
        (12.0, 1.5, 0.0, False, False),
    ],
    ids=[
        "cannot stop",
        "comes",
        "stands at the line",
        "stands with its bumper over it",
        "has its turn there",
        "has missed it",
        "gets another",
        "stands far off",
        "crawls",
    ],
)
def test_the_way_through_a_junction_is_taken_by_who_cannot_stop_before_it(
    alone: Traffic, to_line_m: float, mps: float, turn_came_s: float, way_taken: bool, requests: bool
) -> None:
    before, _ = before_a_light(alone)
    s_m = float(alone.lanes.length_m[before]) - to_line_m - 2.45
    state = followed(alone, before, s_m, behind_m=10.0)
    ego = driven_at(alone, before, s_m, mps=mps)
    state.vehicles.rank[0] = turn_came_s
    seen = perceive_ego(alone.lanes, alone.lane_index, state.vehicles, ego, state.route, 0, 20.0)
    assert (seen.vehicles.granted[0] > 0) == way_taken
    assert seen.may_request[0] == requests
    assert seen.may_request[1:].all()


def test_who_turns_in_wide_has_not_changed_his_mind(alone: Traffic) -> None:
    """In a junction he is taken to be on the lane that he meant to take, though another is nearer."""
    graph, near, nowhere = alone.lanes, alone.lane_index, np.zeros(0, dtype=np.int64)
    tried = 0
    for meant in np.flatnonzero(graph.junction >= 0).tolist():
        lanes = graph.siblings.other[graph.siblings.first[meant] : graph.siblings.first[meant + 1]]
        for other in np.unique(lanes).tolist():
            line, mine = graph.samples(other), graph.samples(meant)
            away_m = np.hypot(*(line[:-1, None, :2] - mine[None, :-1, :2]).transpose(2, 0, 1))
            nearest = away_m.argmin(axis=1)
            ours, theirs = (np.arctan2(*np.diff(xyz[:, :2], axis=0).T[::-1]) for xyz in (mine, line))
            turned = np.abs((theirs - ours[nearest] + np.pi) % (2 * np.pi) - np.pi)
            at = np.flatnonzero((away_m.min(axis=1) > 1.0) & (away_m.min(axis=1) + 2.0 * turned < 2.8))
            if not len(at):
                continue
            here, yaw = line[at[0]], float(theirs[at[0]])
            found = find_lane(near, here, yaw, nowhere, nowhere)
            if found is None or found[0] != other:
                continue
            tried += 1
            known = np.array([meant])
            assert find_lane(near, here, yaw, known, known)[0] == meant
            assert find_lane(near, here, yaw, known, nowhere)[0] == other  # outside of junctions he may
    assert tried > 10


def test_who_drives_through_a_junction_has_the_rest_of_it(alone: Traffic) -> None:
    """Two lanes of a junction follow each other, and one that is free comes after them."""
    lane = longest_lane(alone)
    state = followed(alone, lane, 30.0, behind_m=10.0)
    s_m = float(alone.lanes.length_m[lane]) - 10.0
    rest, free = state.vehicles.path[0, BEHIND + 1 : BEHIND + 3]
    contested = alone.lanes.contested.copy()
    contested[[lane, rest]], contested[free] = True, False
    graph = dataclasses.replace(alone.lanes, contested=contested)
    for mps, granted in ((6.0, 1), (0.0, 0)):
        ego = driven_at(alone, lane, s_m, mps=mps)
        seen = perceive_ego(graph, alone.lane_index, state.vehicles, ego, state.route, 0, 0.0)
        assert seen.vehicles.granted[0] == granted


def test_cross_traffic_waits_for_who_runs_a_red_light(town_of: Callable[[str], TownMap]) -> None:
    """It stands in the middle of the junction: nobody with a green light drives into it."""
    traffic = Traffic(town_of("Town05"), 4, vehicle_count=40, people_count=0)
    graph = traffic.lanes
    _, inside = before_a_light(traffic)
    ego = driven_at(traffic, inside, 0.5 * float(graph.length_m[inside]))
    lane = np.array([inside])
    state = traffic.start(ego_vehicle(graph, lane, 0.5 * graph.length_m[lane]))
    nearest = np.inf
    for _ in range(450):
        state = traffic.step(state, DT_S, ego)
        v, poses = state.vehicles, traffic.poses(state)
        others = np.flatnonzero(v.active)[1:]
        offset = poses.centre_m[others] - (ego.axle_xyz + AXLE_TO_CENTRE_M * ego.forward)
        along, aside = np.abs(offset @ ego.forward), np.abs(offset @ [-ego.forward[1], ego.forward[0], 0.0])
        moving = v.speed_mps[others] > 0.5
        clear = np.maximum(along - 2.45, aside - 0.92)[moving & (np.abs(offset[:, 2]) < 3.0)]
        nearest = min(nearest, clear.min(initial=np.inf))
    assert nearest > 0.9  # half the width of what passes
    assert nearest < 30.0  # somebody was there


def test_people_do_not_step_in_front_of_it(town02: TownMap) -> None:
    traffic = Traffic(town02, 2, vehicle_count=1, people_count=20)
    lane = longest_lane(traffic)
    state = traffic.start(ego_vehicle(traffic.lanes, np.array([lane]), np.array([20.0])))
    who = int(np.flatnonzero(state.people.active)[0])
    for _ in range(20):
        state = traffic.step(state, DT_S)
    person = state.people
    forward = np.array([np.cos(person.yaw[who]), np.sin(person.yaw[who]), 0.0])
    # A vehicle on the pavement, three metres ahead of the person, across its way.
    across = np.array([-forward[1], forward[0], 0.0])
    axle = person.xyz[who] + 3.0 * forward - AXLE_TO_CENTRE_M * across
    ego = EgoPose(axle, float(np.arctan2(across[1], across[0])), 0.0)
    for _ in range(60):
        state = traffic.step(state, DT_S, ego)
        beside = (state.people.xyz[who] - axle) @ forward
        assert beside < -0.92  # or it has turned round


def test_traffic_turns_over_around_it_and_its_slot_is_kept(town02: TownMap) -> None:
    traffic = Traffic(town02, 3, vehicle_count=20, people_count=10)
    lane = longest_lane(traffic)
    state = traffic.start(ego_vehicle(traffic.lanes, np.array([lane]), np.array([20.0])))
    far_off = EgoPose(np.array([1000.0, 1000.0, 0.0]), 0.3, 2.0)
    state = traffic.step(state, DT_S, far_off)
    assert state.vehicles.active[0]
    assert not state.vehicles.active[1:].any()  # all were far from there
    assert not state.people.active.any()


def test_steps_are_pure_and_saved_states_go_on_alike(town02: TownMap) -> None:
    traffic = Traffic(town02, 3, vehicle_count=20, people_count=10)
    lane = longest_lane(traffic)
    begin = traffic.start(ego_vehicle(traffic.lanes, np.array([lane]), np.array([20.0])))
    egos = [driven_at(traffic, lane, 20.0 + 0.8 * i, aside_m=0.02 * i, mps=8.0) for i in range(60)]
    ends = []
    for start in (begin, pickle.loads(pickle.dumps(begin))):
        state = start
        for ego in egos:
            state = traffic.step(state, DT_S, ego)
        ends.append(state)
    for field in dataclasses.fields(Vehicles):
        one, other = (getattr(end.vehicles, field.name) for end in ends)
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(ends[0].people.xyz, ends[1].people.xyz)


def test_the_road_is_as_high_as_its_lanes(town_of: Callable[[str], TownMap]) -> None:
    """Town05 has roads on two levels: the nearer level counts, on a slope as on the flat."""
    traffic = Traffic(town_of("Town05"), 1, vehicle_count=1, people_count=0)
    graph, rng = traffic.lanes, np.random.default_rng(0)
    lane = rng.integers(0, len(graph.ids), 300)
    at = graph.position(lane, rng.random(300) * graph.length_m[lane])
    for xyz in at:
        z = traffic.lane_index.height_m(xyz[None, :2], float(xyz[2]) + 0.4)[0]
        assert z == pytest.approx(xyz[2], abs=0.12)
