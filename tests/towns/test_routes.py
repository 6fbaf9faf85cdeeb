"""Routes that can be driven and that turn either way."""

import dataclasses
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from foredrive.data.commands import LATERAL_M, route_offset_m
from foredrive.scene import Command
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.traffic.fleet import find_start_points
from foredrive.towns.traffic.lane_graph import LaneControl, LaneGraph, build_lane_graph
from foredrive.towns.traffic.routes import LIGHT_S, ROUTE_SPACING_M, Route, draw_route


@pytest.fixture(scope="module")
def graph(town02: TownMap) -> LaneGraph:
    return build_lane_graph(town02)


def routes(graph: LaneGraph, count: int, length_m: float = 600.0) -> list[Route]:
    starts = find_start_points(graph)
    return [
        draw_route(graph, starts, np.random.default_rng(seed), length_m, 0.0, 45.0) for seed in range(count)
    ]


def test_each_lane_follows_the_one_before(graph: LaneGraph) -> None:
    for route in routes(graph, 5):
        for lane, following in zip(route.lanes[:-1], route.lanes[1:], strict=True):
            assert following in graph.successors[lane]
        assert graph.length_m[route.lanes].sum() - route.start_m >= 600.0
        assert graph.junction[route.lanes[0]] < 0


def test_a_route_is_a_line_on_the_lanes(graph: LaneGraph) -> None:
    route = routes(graph, 1)[0]
    line = route.polyline(graph)
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    assert steps.max() <= ROUTE_SPACING_M + 0.01
    assert steps.min() > 0.9 * ROUTE_SPACING_M  # chords of curves and nothing else
    every = np.concatenate([graph.samples(int(lane)) for lane in route.lanes])
    for point in line[::20]:
        assert np.linalg.norm(every - point, axis=1).min() < 0.3


def test_the_same_seed_gives_the_same_route(graph: LaneGraph) -> None:
    first, second = (routes(graph, 3) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.lanes, b.lanes)
        assert a.start_m == b.start_m
    assert not np.array_equal(first[0].lanes, first[1].lanes)


def test_routes_turn_left_and_right_and_go_straight(graph: LaneGraph) -> None:
    drawn = routes(graph, 20)
    taken = Counter(command for route in drawn for command in route.commands(graph, 600.0))
    assert min(taken[command] for command in Command) > 0.5 * max(taken.values())
    for route in drawn:
        soon = route.commands(graph, route.distance_m(graph, 45.0))
        assert set(soon) - {Command.STRAIGHT}
        assert len(set(soon)) > 1


def test_commands_count_from_the_start_of_the_route(graph: LaneGraph) -> None:
    route = routes(graph, 1)[0]
    to_first_fork = graph.length_m[route.lanes[0]] - route.start_m
    assert route.commands(graph, to_first_fork - 1.0) == []
    assert route.commands(graph, to_first_fork + 1.0) == [graph.command(int(route.lanes[1]))]


def test_long_drives_turn_left_and_right_and_go_straight(town_of: Callable[[str], TownMap]) -> None:
    graph = build_lane_graph(town_of("Town06"))  # few roads lead to the right there
    starts = find_start_points(graph)
    for seed in range(5):
        route = draw_route(graph, starts, np.random.default_rng(seed), 9000.0, 0.0, 300.0)
        assert set(route.commands(graph, route.distance_m(graph, 300.0))) == set(Command)


def test_lights_and_curves_take_time(graph: LaneGraph) -> None:
    route = routes(graph, 1)[0]
    assert route.distance_m(graph, 0.0) == 0.0
    driven_m = np.array([route.distance_m(graph, float(s)) for s in range(100)])
    assert (np.diff(driven_m) >= 0).all()
    assert np.diff(driven_m).max() <= graph.limit_mps.max()
    to_light_m = graph.length_m[route.lanes[0]] - route.start_m
    assert graph.control[route.lanes[1]] == LaneControl.LIGHT
    assert np.interp(to_light_m + 0.5, driven_m, np.arange(100)) > LIGHT_S + to_light_m / 14.0


@pytest.mark.parametrize("limit_mps", [4.0, 8.0, 14.0])
def test_a_planned_lane_change_is_no_turn(town_of: Callable[[str], TownMap], limit_mps: float) -> None:
    graph = build_lane_graph(town_of("Town04"))
    graph = dataclasses.replace(graph, limit_mps=np.full_like(graph.limit_mps, limit_mps))
    straight = (graph.min_radius_m > 2000.0) & (graph.length_m > 80.0) & (graph.left >= 0)
    for lane in np.flatnonzero(straight)[:3]:
        line = Route(np.array([lane]), 5.0, graph.left[[lane]]).polyline(graph)[:, :2]
        arc_m = np.concatenate([[0.0], np.linalg.norm(np.diff(line, axis=0), axis=1).cumsum()])
        first, last = graph.position(np.array([lane, lane]), np.array([5.0, graph.length_m[lane]]))[:, :2]
        assert 3.0 < np.linalg.norm(line[0] - first) < 4.0
        assert np.linalg.norm(line[-1] - last) < 1.5
        aside_m = [route_offset_m(arc_m, line, float(at)) for at in np.arange(0.0, 60.0)]
        assert max(np.abs(aside_m)) < LATERAL_M
