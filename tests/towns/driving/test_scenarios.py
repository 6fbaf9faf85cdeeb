"""Scenarios on real places: each happens, hits who takes no notice, and spares who is attentive."""

import dataclasses
import pickle

import numpy as np
import pytest
from driver import SEED, Driver, drive, town_scenario

from foredrive.driving.drive import drive_route
from foredrive.driving.route_sets import RouteWaypoints, load_route_set
from foredrive.towns.driving.routes import DriveRoute, snap_route
from foredrive.towns.driving.town import TownSimulator, grow
from foredrive.towns.driving.town_expert import TownExpert
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.scenarios.kinematics import REACTION_S
from foredrive.towns.scenarios.places import possible_scenarios, scenarios_on
from foredrive.towns.scenarios.scenario import Scenario, ScenarioKind
from foredrive.towns.traffic.lane_graph import TURN_RAD, build_lane_graph

STRAIGHT_ON = (ScenarioKind.CROSSING_PEDESTRIAN, ScenarioKind.CROSSING_CYCLIST, ScenarioKind.LEAD_BRAKES)


def over_junction(turn_rad: float, room_m: float) -> DriveRoute:
    """A route in Town02 over the first junction lane that turns like this, with room before and behind."""
    graph = build_lane_graph(load_town_map("Town02"))
    for lane in np.flatnonzero(graph.junction >= 0).tolist():
        before, after = int(graph.predecessors[lane, 0]), int(graph.successors[lane, 0])
        ends_m = graph.length_m[[before, after]]
        if abs(graph.turn_rad[lane] - turn_rad) < TURN_RAD and ends_m.min() > room_m:
            at = np.array(
                [max(ends_m[0] - 60.0, 3.0), 0.5 * graph.length_m[lane], min(45.0, ends_m[1] - 3.0)]
            )
            xyz = graph.position(np.array([before, lane, after]), at)
            return snap_route(RouteWaypoints(f"over{lane}", "Town02", xyz))
    raise AssertionError("Town02 has no such junction")


@pytest.fixture(scope="module")
def simulator() -> TownSimulator:
    return TownSimulator()


@pytest.fixture(scope="module")
def places() -> dict[ScenarioKind, tuple[DriveRoute, Scenario]]:
    """A place in Town02 for some kinds: straight on, and where a turn to the left is."""
    world, found = grow("Town02", SEED), {}
    straight, left = over_junction(0.0, 60.0), over_junction(0.5 * np.pi, 35.0)
    for route, kinds in ((straight, STRAIGHT_ON), (left, tuple(set(ScenarioKind) - set(STRAIGHT_ON)))):
        for scenario in possible_scenarios(route, world, np.random.default_rng(0)):
            if scenario.kind in kinds:
                found.setdefault(scenario.kind, (route, scenario))
    return found


def town05_place(kind: ScenarioKind, route_id: str) -> tuple[DriveRoute, Scenario]:
    """A place of a kind on a short route of Town05."""
    route = snap_route(next(given for given in load_route_set("town05-short") if given.id == route_id))
    possible = possible_scenarios(route, grow("Town05", SEED), np.random.default_rng(0))
    return route, next(scenario for scenario in possible if scenario.kind is kind)


def happens(simulator: TownSimulator, route: DriveRoute, scenario: Scenario, what: str) -> None:
    """It hits who takes no notice, and spares who is attentive."""
    for attentive in (False, True):
        simulator.reset(town_scenario(route, (scenario,)))
        events, states = drive(simulator, Driver(route, scenario.limit_mps, attentive))
        progress = states[-1].scenarios
        assert [number for number, _ in progress.begun] == [0]
        actors = {str(actor.track_id) for actor in states[-1].decided.scripted_actors} or {"1", "2", "3"}
        hits = [event for event in events if event.kind == f"collision_{what}"]
        assert len({hit.detail.split()[1] for hit in hits}) == len(hits)  # each is counted once
        if attentive:
            assert not hits
            assert states[-1].ego.speed_mps < 0.1
        else:
            assert hits
            assert hits[0].detail.split()[1] in actors  # on an empty road there is nobody else
            assert hits[0].severity > 3.0
            assert hits[0].t_s > progress.begun[0][1] + REACTION_S


@pytest.mark.parametrize(
    ("kind", "what"),
    [
        (ScenarioKind.CROSSING_PEDESTRIAN, "pedestrian"),
        (ScenarioKind.CROSSING_CYCLIST, "vehicle"),
        (ScenarioKind.OBSTACLE_BEHIND_CORNER, "vehicle"),
        (ScenarioKind.ONCOMING_TRAFFIC, "vehicle"),
        (ScenarioKind.LEAD_BRAKES, "vehicle"),
    ],
)
def test_a_scenario_hits_only_who_takes_no_notice(
    simulator: TownSimulator,
    places: dict[ScenarioKind, tuple[DriveRoute, Scenario]],
    kind: ScenarioKind,
    what: str,
) -> None:
    happens(simulator, *places[kind], what)


@pytest.mark.parametrize(
    ("kind", "route_id", "what"),
    [
        (ScenarioKind.CUT_IN, "7", "vehicle"),
        (ScenarioKind.DOOR_ZONE, "14", "pedestrian"),
        (ScenarioKind.RED_LIGHT_RUNNER, "5", "vehicle"),
    ],
)
def test_where_town02_has_no_place(
    simulator: TownSimulator, kind: ScenarioKind, route_id: str, what: str
) -> None:
    happens(simulator, *town05_place(kind, route_id), what)


def test_a_scenario_is_over_and_the_vehicle_in_the_way_drives_on(
    simulator: TownSimulator, places: dict[ScenarioKind, tuple[DriveRoute, Scenario]]
) -> None:
    route, scenario = places[ScenarioKind.OBSTACLE_BEHIND_CORNER]
    simulator.reset(town_scenario(route, (scenario,)))
    events, states = drive(simulator, Driver(route, scenario.limit_mps, attentive=True))
    (slot,) = states[0].scenarios.slots
    assert {float(state.decided.vehicles.speed_mps[slot]) for state in states[:100]} == {0.0}
    waited = [state.t_s for state in states if state.ego.speed_mps == 0.0 and state.t_s > 5.0]
    over_s = next(state.t_s for state in states if state.scenarios.number == 1)
    assert over_s == pytest.approx(waited[0] + 3.0, abs=0.5)
    assert states[-1].decided.vehicles.speed_mps[slot] > 3.0
    assert [(event.kind, event.what) for event in events] == [("scenario", "obstacle_behind_corner")]


@pytest.mark.parametrize("kind", [ScenarioKind.CROSSING_CYCLIST, ScenarioKind.ONCOMING_TRAFFIC])
def test_the_expert_foresees_it(
    simulator: TownSimulator, places: dict[ScenarioKind, tuple[DriveRoute, Scenario]], kind: ScenarioKind
) -> None:
    route, scenario = places[kind]
    driven = drive_route(simulator, town_scenario(route, (scenario,)), TownExpert(simulator), route="r")
    assert [event.what for event in driven.events if event.kind == "scenario"] == [kind]
    assert driven.score.driving_score_1_0 == 100.0


@pytest.mark.slow
def test_the_expert_waits_for_who_runs_a_light(simulator: TownSimulator) -> None:
    route, scenario = town05_place(ScenarioKind.RED_LIGHT_RUNNER, "5")
    driven = drive_route(simulator, town_scenario(route, (scenario,)), TownExpert(simulator), route="r")
    assert not [event for event in driven.events if event.kind.startswith("collision")]
    assert driven.score.completion == 1.0


def test_a_drive_with_a_scenario_goes_on_bit_by_bit(
    simulator: TownSimulator, places: dict[ScenarioKind, tuple[DriveRoute, Scenario]]
) -> None:
    route, scenario = places[ScenarioKind.CROSSING_PEDESTRIAN]
    driver = Driver(route, scenario.limit_mps, attentive=True)
    simulator.reset(town_scenario(route, (scenario,)))
    _, states = drive(simulator, driver)
    middle = next(state for state in states if state.decided.scripted_actors[0].s_m > 1.0)
    assert middle.decided.scripted_actors[0].is_under_way
    saved = pickle.loads(pickle.dumps(dataclasses.replace(simulator.save(), state=middle)))
    simulator.reset(town_scenario(route, ()))
    simulator.restore(saved)
    _, again = drive(simulator, driver)
    assert len(again) == len(states) - states.index(middle)
    assert again[-1].ego == states[-1].ego
    assert again[-1].scenarios == states[-1].scenarios
    for first, second in zip(
        states[-1].decided.scripted_actors, again[-1].decided.scripted_actors, strict=True
    ):
        assert (first.s_m, first.speed_mps) == (second.s_m, second.speed_mps)
        np.testing.assert_array_equal(first.xyz, second.xyz)


def test_an_actor_is_seen_as_everybody_is(
    simulator: TownSimulator, places: dict[ScenarioKind, tuple[DriveRoute, Scenario]]
) -> None:
    route, scenario = places[ScenarioKind.CROSSING_PEDESTRIAN]
    clip = simulator.reset(town_scenario(route, (scenario,)))
    boxes = clip.boxes
    (found,) = (boxes.track_id[-1] == scenario.actor.track_id).nonzero()[:, 0].tolist()
    T = clip.T_world_ego[-1].numpy()
    expected = np.linalg.inv(T) @ np.append(scenario.actor.xyz, 1.0)
    np.testing.assert_allclose(boxes.centre[-1, found, :2], expected[:2], atol=1e-3)
    assert boxes.centre[-1, found, 2] == pytest.approx(expected[2] + 0.86, abs=0.01)


def test_equal_seeds_draw_equal_scenarios_with_room_between() -> None:
    world, route = grow("Town02", SEED), long_route()
    first, again, other = (scenarios_on(route, world, seed) for seed in (1, 1, 2))
    assert [(s.kind, s.at_m) for s in first] == [(s.kind, s.at_m) for s in again]
    assert [(s.kind, s.at_m) for s in first] != [(s.kind, s.at_m) for s in other]
    at_m = np.array([scenario.at_m for scenario in first])
    assert len(at_m) >= 3
    assert len({scenario.kind for scenario in first}) >= 3
    assert np.diff(at_m).min() >= 80.0
    assert 28.0 <= at_m.min() < at_m.max() < route.length_m
    numbers = [scenario.actor.track_id for scenario in first if scenario.actor is not None]
    assert len(set(numbers)) == len(numbers)


def long_route() -> DriveRoute:
    """Through Town02, over several junctions."""
    graph = build_lane_graph(load_town_map("Town02"))
    lanes = [int(np.argmax(np.where(graph.contested, 0.0, graph.length_m)))]
    while graph.length_m[lanes].sum() < 600.0:
        onward = graph.successors[lanes[-1], : graph.successor_count[lanes[-1]]]
        lanes.append(int(onward[np.argmax(graph.length_m[onward])]))
    middles = graph.position(np.array(lanes), 0.5 * graph.length_m[lanes])
    return snap_route(RouteWaypoints("long", "Town02", middles))
