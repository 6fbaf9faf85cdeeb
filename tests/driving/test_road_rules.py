"""Boxes that touch, lines that are crossed, lanes that are left, and how far a route is driven."""

import dataclasses
import itertools

import numpy as np
import pytest

from foredrive.driving.collisions import Box, RoadUsers, touched
from foredrive.driving.dynamics import EGO
from foredrive.driving.lane_rules import RuleState
from foredrive.driving.route_progress import RouteLine, RouteProgress
from foredrive.scene import BicycleState, Command, Event
from foredrive.scene.traffic_light import LightState
from foredrive.towns.driving.road_users import road_users
from foredrive.towns.driving.town_lanes import TownLaneRules, stop_lines
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.traffic.traffic import Traffic


def users(*boxes: tuple[float, float, float, float]) -> RoadUsers:
    """4 m long and 2 m wide, at x, y, z, yaw."""
    at = np.array(boxes)
    count = len(at)
    return RoadUsers(
        track_id=np.arange(count) + 1,
        category=np.zeros(count, dtype=np.int64),
        foot_m=at[:, :3],
        yaw=at[:, 3],
        half_lw=np.tile([2.0, 1.0], (count, 1)),
        velocity_mps=np.zeros((count, 2)),
    )


def test_boxes_touch_where_no_side_parts_them() -> None:
    box = Box(np.zeros(3), 0.0, np.array([2.0, 1.0]))
    turned = np.pi / 4
    # A corner of the square on its tip reaches 3 / √2 = 2.121 m to each side.
    others = users(
        (3.9, 0.0, 0.0, 0.0),
        (4.1, 0.0, 0.0, 0.0),
        (3.9, 1.9, 0.0, 0.0),
        (0.0, 3.1, 0.0, turned),
        (0.0, 3.15, 0.0, turned),
        (2.9, 0.0, 0.0, np.pi / 2),
        (3.1, 0.0, 0.0, np.pi / 2),
        (0.0, 0.0, 5.0, 0.0),
        (3.8, 2.9, 0.0, turned),
    )
    assert touched(box, others).tolist() == [True, False, True, True, False, True, False, False, False]
    nobody = others._replace(track_id=np.full(9, -1))
    assert not touched(box, nobody).any()


def test_road_users_are_where_traffic_says() -> None:
    traffic = Traffic(load_town_map("Town02"), 1, 8, 5)
    state = traffic.start()
    found, actors = road_users(traffic, state), traffic.actors(state)
    place = {actor.track_id: actor for actor in actors}
    there = list(np.flatnonzero(found.track_id >= 0))
    assert len(there) == len(actors) - 1  # all but vehicle 0
    for i in there:
        actor = place[int(found.track_id[i])]
        np.testing.assert_allclose(found.foot_m[i, :2], actor.centre_m[:2], atol=1e-9)
        assert found.foot_m[i, 2] == pytest.approx(actor.centre_m[2] - 0.5 * actor.size_lwh[2])
        np.testing.assert_allclose(2 * found.half_lw[i], actor.size_lwh[:2])
        np.testing.assert_allclose(found.velocity_mps[i], actor.velocity_mps[:2], atol=0.15)
    half = found.towards(found._replace(foot_m=found.foot_m + 1.0, yaw=found.yaw + 2 * np.pi - 0.2), 0.5)
    np.testing.assert_allclose(half.foot_m, found.foot_m + 0.5)
    np.testing.assert_allclose(half.yaw, found.yaw - 0.1)


@pytest.fixture(scope="module")
def town07() -> TownMap:
    return load_town_map("Town07")


@pytest.fixture(scope="module")
def rules(town07: TownMap) -> TownLaneRules:
    return TownLaneRules(town07, Traffic(town07, 1, 1, 0))


def towards(
    rules: TownLaneRules,
    town: TownMap,
    is_sign: bool,
    stations: list[tuple[float, float]],
    light: LightState,
) -> list[Event]:
    """Drive over a line: where the middle is along the lane from it, and how fast one is there."""
    lines = stop_lines(town)
    k = int(np.flatnonzero(lines.is_sign == is_sign)[0])
    lights = np.full(len(town.stop_zones), int(light))
    yaw = float(np.arctan2(*lines.ahead[k][::-1]))

    def at(along_m: float, speed_mps: float) -> BicycleState:
        x, y = lines.xyz[k, :2] + (along_m - EGO.axle_to_centre_m) * lines.ahead[k]
        return BicycleState(float(x), float(y), yaw, speed_mps)

    events, memory = [], RuleState()
    states = [at(*station) for station in stations]
    for number, (before, after) in enumerate(itertools.pairwise(states)):
        new, memory = rules.check(before, after, float(lines.xyz[k, 2]), lights, memory, 0.05 * number)
        events += [event for event in new if event.kind in ("red_light", "stop_sign")]
    return events


@pytest.mark.parametrize(
    ("light", "stations", "runs"),
    [
        (LightState.RED, [(-4.0, 5.0), (1.0, 5.0), (3.0, 5.0)], True),
        (LightState.RED, [(-4.0, 5.0), (-2.5, 1.0), (-2.45, 0.0)], False),
        (
            LightState.RED,
            [(-4.0, 5.0), (1.5, 1.0), (1.5, 0.0)],
            False,
        ),  # over the line, but not with its tail
        (LightState.GREEN, [(-4.0, 5.0), (1.0, 5.0), (3.0, 5.0)], False),
        (LightState.YELLOW, [(-4.0, 5.0), (1.0, 5.0), (3.0, 5.0)], False),
        (LightState.RED, [(3.0, 5.0), (1.0, 5.0), (-4.0, 5.0)], False),  # the other way
    ],
    ids=["through", "stops before", "stops on it", "green", "yellow", "back"],
)
def test_a_red_light_is_run_when_the_tail_crosses_the_line(
    rules: TownLaneRules,
    town07: TownMap,
    light: LightState,
    stations: list[tuple[float, float]],
    runs: bool,
) -> None:
    events = towards(rules, town07, False, stations, light)
    assert [event.kind for event in events] == (["red_light"] if runs else [])


@pytest.mark.parametrize(
    ("stations", "runs"),
    [
        ([(-5.0, 3.0), (-3.0, 0.05), (-1.0, 2.0), (1.0, 3.0)], False),
        ([(-5.0, 3.0), (-3.0, 0.2), (-1.0, 2.0), (1.0, 3.0)], True),
        ([(-12.0, 3.0), (-11.0, 0.0), (-5.0, 2.0), (1.0, 3.0)], True),
        ([(-5.0, 3.0), (-1.0, 0.0), (1.0, 3.0), (-3.0, 3.0), (2.0, 3.0)], True),
    ],
    ids=["stops", "rolls", "stops far from it", "stops the first time only"],
)
def test_a_stop_sign_asks_for_a_stop_near_its_line(
    rules: TownLaneRules, town07: TownMap, stations: list[tuple[float, float]], runs: bool
) -> None:
    events = towards(rules, town07, True, stations, LightState.NONE)
    assert [event.kind for event in events] == (["stop_sign"] if runs else [])


def test_the_way_outside_of_lanes_and_against_them_is_counted(town07: TownMap, rules: TownLaneRules) -> None:
    graph = Traffic(town07, 1, 1, 0).lanes
    lane = int(np.argmax(np.where(graph.junction < 0, graph.length_m, 0.0)))
    here, ahead = graph.position(np.array([lane, lane]), np.array([30.0, 30.5]))
    forward = (ahead - here)[:2] / np.linalg.norm((ahead - here)[:2])
    right = np.array([forward[1], -forward[0]])
    yaw = float(np.arctan2(*forward[::-1]))
    lights = np.zeros(len(town07.stop_zones), dtype=np.int64)

    def step(aside_m: float, turned_rad: float, memory: RuleState) -> tuple[list[Event], RuleState]:
        middle = here[:2] + aside_m * right
        heading = yaw + turned_rad
        axle = middle - EGO.axle_to_centre_m * np.array([np.cos(heading), np.sin(heading)])
        after = BicycleState(float(axle[0]), float(axle[1]), heading, 2.0)
        before = dataclasses.replace(after, x_m=after.x_m - 0.6, y_m=after.y_m - 0.8)
        return rules.check(before, after, float(here[2]), lights, memory, 1.0)

    half_m = 0.5 * float(graph.width_m[lane])
    assert step(0.0, 0.0, RuleState())[1].outside_m == 0.0
    assert step(half_m + 1.0, 0.0, RuleState())[1].outside_m == 0.0  # within the margin
    assert step(0.0, np.pi, RuleState())[1].outside_m == pytest.approx(1.0)  # against the lane
    events, memory = step(half_m + 1.8, 0.0, RuleState())
    assert (events, memory.outside_m, memory.driven_m) == ([], pytest.approx(1.0), pytest.approx(1.0))
    events, memory = step(0.0, 0.0, memory)
    assert memory.outside_share == pytest.approx(0.5)
    assert [(event.kind, event.severity) for event in events] == [("outside_lane", pytest.approx(1.0))]


def test_progress_counts_along_the_route_and_never_back() -> None:
    corner = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [100.0, 100.0, 0.0]])
    route = RouteLine(corner)
    assert route.length_m == pytest.approx(200.0)
    progress = RouteProgress()
    for x in np.arange(0.0, 99.0, 3.0):
        progress = route.advance(progress, np.array([x, 2.0]), 10.0, 1.0)
    assert progress.done_m == pytest.approx(96.0, abs=0.6)
    assert progress.beside_m == pytest.approx(2.0, abs=0.3)
    assert route.command(progress) == Command.LEFT
    assert route.command(RouteProgress(done_m=20.0)) == Command.STRAIGHT
    back = route.advance(progress, np.array([93.0, 0.0]), 10.0, 2.0)
    assert back.done_m == progress.done_m
    assert route.end_of(progress, 2.0, np.inf) is None
    assert route.end_of(progress, 200.0, np.inf) == "blocked"  # it last moved at 1 s
    assert route.end_of(progress, 60.0, 60.0) == "timeout"
    assert route.end_of(dataclasses.replace(progress, beside_m=31.0), 2.0, np.inf) == "deviation"
    for y in np.arange(0.0, 97.0, 3.0):
        assert route.end_of(progress, 2.0, np.inf) is None
        progress = route.advance(progress, np.array([101.0, y]), 10.0, 2.0)
    arrived = progress
    assert arrived.done_m == route.length_m
    assert route.end_of(arrived, 2.0, np.inf) == "completed"
