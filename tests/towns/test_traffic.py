"""What has to hold at every moment of minutes of traffic."""

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import shapely

from foredrive.driving.car_following import MAX_BRAKING_MPS2
from foredrive.scene import Category
from foredrive.scene.traffic_light import LightState
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.traffic.lane_graph import LaneControl
from foredrive.towns.traffic.lights import GREEN_S, PHASE_S, YELLOW_S, plan_signals
from foredrive.towns.traffic.traffic import Traffic, TrafficState
from foredrive.towns.traffic.vehicles import BEHIND, Vehicles

DT_S = 0.1
MINUTES = 2.0
LOOKED_AT_S = 0.3
"""A vehicle at 14 m/s moves 4 m between two looks: none passes through another unseen."""


@dataclasses.dataclass(frozen=True)
class Watched:
    """A few minutes of traffic: the rules, and the state at every step."""

    traffic: Traffic
    town: TownMap
    states: list[TrafficState]

    def looks(self) -> Iterator[TrafficState]:
        yield from self.states[:: round(LOOKED_AT_S / DT_S)]


@pytest.fixture(scope="module", params=["Town02", "Town07"])
def watched(request: pytest.FixtureRequest, town_of: Callable[[str], TownMap]) -> Watched:
    town = town_of(request.param)
    traffic = Traffic(town, seed=5, vehicle_count=28, people_count=25)
    states = [traffic.start()]
    for _ in range(round(MINUTES * 60 / DT_S)):
        states.append(traffic.step(states[-1], DT_S))
    return Watched(traffic, town, states)


def footprints(traffic: Traffic, state: TrafficState) -> tuple[np.ndarray, np.ndarray]:
    """Index and outline, seen from above, of each vehicle."""
    live = np.flatnonzero(state.vehicles.active)
    poses = traffic.poses(state)
    centre, yaw = poses.centre_m[live, :2], poses.yaw[live]
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=1) * state.vehicles.size_lwh[live, :1] / 2
    left = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1) * state.vehicles.size_lwh[live, 1:2] / 2
    corners = [centre + ahead + left, centre + ahead - left, centre - ahead - left, centre - ahead + left]
    return live, shapely.polygons(np.stack(corners, axis=1))


def test_vehicles_never_overlap(watched: Watched) -> None:
    for state in watched.looks():
        live, outlines = footprints(watched.traffic, state)
        z = watched.traffic.poses(state).centre_m[live, 2]
        a, b = shapely.STRtree(outlines).query(outlines, predicate="intersects")
        hit = (a < b) & (np.abs(z[a] - z[b]) < 2.0)
        assert not hit.any(), f"at {state.time_s:.1f} s: vehicles {live[a[hit]]} and {live[b[hit]]}"


def test_nobody_walks_through_a_vehicle(watched: Watched) -> None:
    for state in watched.looks():
        _, outlines = footprints(watched.traffic, state)
        people = shapely.points(state.people.xyz[state.people.active, :2])
        assert not len(shapely.STRtree(outlines).query(people, predicate="intersects")[0]), state.time_s


def test_speeds_and_accelerations_are_bounded(watched: Watched) -> None:
    limit = watched.traffic.lanes.limit_mps
    for state in watched.states:
        v = state.vehicles
        assert (v.speed_mps >= 0).all()
        assert (v.speed_mps[v.active] <= 1.1 * limit[v.lane[v.active]]).all()
        assert (v.acceleration_mps2[v.active] <= v.accel_mps2[v.active] + 1e-9).all()
        assert (v.acceleration_mps2[v.active] >= -MAX_BRAKING_MPS2).all()


def test_hard_braking_is_rare(watched: Watched) -> None:
    braking = np.concatenate([s.vehicles.acceleration_mps2[s.vehicles.active] for s in watched.states])
    assert (braking < -4.0).mean() < 1e-4


def test_everybody_stays_on_the_road(watched: Watched) -> None:
    lanes = [
        shapely.Polygon(np.concatenate([x.left_boundary_xyz, x.right_boundary_xyz[::-1]])[:, :2])
        for x in watched.town.lanes
    ]
    road = shapely.union_all([lane.buffer(0.3) for lane in lanes])
    shapely.prepare(road)
    for state in watched.looks():
        live, outlines = footprints(watched.traffic, state)
        inside = shapely.covers(road, outlines)
        assert inside.all(), f"at {state.time_s:.1f} s: {live[~inside]}"


def test_positions_change_as_speeds_say(watched: Watched) -> None:
    for before, after in zip(watched.states[:-1:10], watched.states[1::10], strict=False):
        same = before.vehicles.active & after.vehicles.active
        moved = np.linalg.norm(
            watched.traffic.poses(after).axle_xyz - watched.traffic.poses(before).axle_xyz, axis=1
        )
        mean_speed = 0.5 * (before.vehicles.speed_mps + after.vehicles.speed_mps)
        assert np.abs(moved - DT_S * mean_speed)[same].max() < 0.1


def test_traffic_flows(watched: Watched) -> None:
    speed = np.array([state.vehicles.speed_mps for state in watched.states])
    active = watched.states[0].vehicles.active
    assert speed[:, active].mean() > 2.5
    # Nobody stands for 90 s on end: each window of that length sees everybody move.
    window = round(90 / DT_S)
    fastest = np.lib.stride_tricks.sliding_window_view(speed[::10], window // 10, axis=0).max(axis=-1)
    assert fastest[:, active].min() > 1.0


def test_nobody_passes_a_red_light(watched: Watched) -> None:
    graph, signals = watched.traffic.lanes, watched.traffic.signals
    passed = 0
    for before, after in zip(watched.states[:-1], watched.states[1:], strict=True):
        v, w = before.vehicles, after.vehicles
        ahead = v.path[:, BEHIND + 1]
        to_line = graph.length_m[v.lane] - v.front_m
        still_there = w.lane == v.lane
        crossed = np.where(still_there, graph.length_m[v.lane] - w.front_m < 0, True) & (to_line >= 0)
        guarded = v.active & crossed & signals.guarded[ahead]
        assert (signals.light_states(before.time_s)[ahead[guarded]] != LightState.RED).all(), before.time_s
        passed += int(guarded.sum())
    assert passed > 10 or not signals.guarded.any()


def test_some_people_cross_the_road(watched: Watched) -> None:
    walks = watched.traffic.walks
    crossing = np.array([s.people.active & walks.is_crossing[s.people.walk] for s in watched.states])
    assert crossing.any(axis=0).sum() >= 3
    assert walks.is_crossing.sum() > 0


def test_people_walk_at_a_human_pace(watched: Watched) -> None:
    for before, after in zip(watched.states[:-1:10], watched.states[1::10], strict=False):
        step = np.linalg.norm(after.people.xyz - before.people.xyz, axis=1)
        assert step.max() <= 1.3 * 1.9 * DT_S + 0.05


def test_the_same_seed_gives_the_same_traffic(town02: TownMap) -> None:
    ends = []
    for seed in (8, 8, 9):
        traffic = Traffic(town02, seed, vehicle_count=20, people_count=10)
        state = traffic.start()
        for _ in range(200):
            state = traffic.step(state, DT_S)
        ends.append(state)
    for field in dataclasses.fields(Vehicles):
        np.testing.assert_array_equal(
            getattr(ends[0].vehicles, field.name), getattr(ends[1].vehicles, field.name)
        )
    np.testing.assert_array_equal(ends[0].people.xyz, ends[1].people.xyz)
    assert not np.array_equal(ends[0].vehicles.s_m, ends[2].vehicles.s_m)


def test_a_step_leaves_the_state_it_starts_from_alone(town02: TownMap) -> None:
    traffic = Traffic(town02, 1, vehicle_count=20, people_count=10)
    state = traffic.start()
    copy = {name: value.copy() for name, value in vars(state.vehicles).items()}
    feet = state.people.xyz.copy()
    one, other = traffic.step(state, DT_S), traffic.step(state, DT_S)
    for name, value in copy.items():
        np.testing.assert_array_equal(getattr(state.vehicles, name), value)
    np.testing.assert_array_equal(state.people.xyz, feet)
    np.testing.assert_array_equal(one.vehicles.s_m, other.vehicles.s_m)


def test_actors_are_what_the_state_says(town02: TownMap) -> None:
    traffic = Traffic(town02, 1, vehicle_count=12, people_count=6)
    state = traffic.start()
    actors = traffic.actors(state)
    assert len(actors) == state.vehicles.active.sum() + state.people.active.sum()
    assert len({actor.track_id for actor in actors}) == len(actors)
    assert sum(actor.category is Category.PEDESTRIAN for actor in actors) == state.people.active.sum()
    for actor in actors:
        assert actor.centre_m[2] - actor.size_lwh[2] / 2 == pytest.approx(0.0, abs=0.16)  # flat town, kerbs


def test_lights_show_green_to_one_axis_at_a_time(town02: TownMap) -> None:
    traffic = Traffic(town02, 0, vehicle_count=1, people_count=0)
    graph, signals = traffic.lanes, traffic.signals
    start = graph.xyz[graph.first + 1] - graph.xyz[graph.first]
    heading = np.arctan2(start[:, 1], start[:, 0])
    seen = np.zeros((len(signals.guarded), 4), dtype=bool)
    for time_s in np.arange(0.0, 2 * PHASE_S, 0.5):
        light = signals.light_states(float(time_s))
        seen[np.arange(len(light)), light] = True
        for junction in np.unique(graph.junction[signals.guarded]):
            lanes = np.flatnonzero(
                signals.guarded & (graph.junction == junction) & (light == LightState.GREEN)
            )
            assert np.abs(np.sin(heading[lanes] - heading[lanes[:1]])).max(initial=0.0) < 0.72
    assert seen[signals.guarded][:, [LightState.RED, LightState.YELLOW, LightState.GREEN]].all()
    assert not seen[~signals.guarded][:, 1:].any()
    assert GREEN_S + YELLOW_S < PHASE_S


def test_a_junction_of_three_axes_has_three_phases(town02: TownMap) -> None:
    """The lanes of one junction of the town, turned to 0°, 60° and 120°."""
    graph = Traffic(town02, 0, vehicle_count=1, people_count=0).lanes
    guarded = graph.control == LaneControl.LIGHT
    lanes = np.flatnonzero(guarded & (graph.junction == graph.junction[guarded][0]))
    angle = np.pi / 3 * (np.arange(len(lanes)) % 3)
    xyz = graph.xyz.copy()
    way = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(lanes))], axis=1)
    xyz[graph.first[lanes] + 1] = xyz[graph.first[lanes]] + way
    signals = plan_signals(dataclasses.replace(graph, xyz=xyz), np.random.default_rng(0))
    green = [
        frozenset(angle[signals.light_states(time_s)[lanes] == LightState.GREEN])
        for time_s in np.arange(0.0, 3 * PHASE_S, 0.5)
    ]
    assert {len(axes) for axes in green} == {0, 1}
    assert frozenset().union(*green) == set(angle)
