"""Routes: read from CARLA's files, snapped to lanes that follow each other, with what to do on the way."""

import itertools
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks.common.own_routes import ROUTE_SETS
from foredrive.driving.route_sets import (
    RouteWaypoints,
    load_route_set,
    read_carla_routes,
    route_set_names,
    write_shipped,
)
from foredrive.errors import InputError
from foredrive.towns.driving.lane_search import find_way, places_near
from foredrive.towns.driving.routes import DriveRoute, RouteOption, route_line, snap_route
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.map.names import is_held_out
from foredrive.towns.traffic.lane_graph import LaneGraph, build_lane_graph

XML = """<?xml version='1.0'?>
<routes>
  <route id="7" town="Town05">
    <weather id="noon" cloudiness="0"/>
    <waypoint pitch="0" roll="0" x="1.5" y="-2.5" yaw="90" z="0.25" />
    <waypoint pitch="0" roll="0" x="11.0" y="4.0" yaw="450" z="0" />
  </route>
</routes>"""


@pytest.fixture(scope="module")
def graph() -> LaneGraph:
    return build_lane_graph(load_town_map("Town05"))


def test_carla_s_left_handed_waypoints_are_mirrored(tmp_path: Path) -> None:
    path = tmp_path / "routes.xml"
    path.write_text(XML)
    (route,) = load_route_set(str(path))
    assert (route.id, route.town) == ("7", "Town05")
    np.testing.assert_array_equal(route.xyz_m, [[1.5, 2.5, 0.25], [11.0, -4.0, 0.0]])


def test_routes_of_leaderboard_2_and_bench2drive(tmp_path: Path) -> None:
    path = tmp_path / "routes.xml"
    path.write_text(
        """<routes><route id="24211" town="Town05">
        <waypoints><position x="1.5" y="-2.5" z="0.25"/><position x="11.0" y="4.0" z="0"/></waypoints>
        <scenarios><scenario name="ParkingCutIn_1" type="ParkingCutIn">
        <trigger_point x="1.5" y="-2.5" z="0.25" yaw="90"/></scenario></scenarios>
        <weathers><weather cloudiness="5" route_percentage="0"/></weathers></route></routes>"""
    )
    (route,) = read_carla_routes(path)
    np.testing.assert_array_equal(route.xyz_m, [[1.5, 2.5, 0.25], [11.0, -4.0, 0.0]])
    assert route.scenarios == ("ParkingCutIn",)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (XML, XML[:120], "not valid XML"),
        ("<route ", "<path ", "no route in|not valid XML"),
        ('town="Town05"', "", "route 7 of .* has no town"),
        ('id="7" ', "", "route number 1 of .* has no id"),
        ('y="-2.5"', 'y="north"', "route 7 of .* without numbers"),
        ('y="-2.5"', "", "route 7 of .* without numbers"),
        ('y="-2.5"', 'y="inf"', "route 7 of .* not finite"),
        (
            '<waypoint pitch="0" roll="0" x="11.0" y="4.0" yaw="450" z="0" />',
            "",
            "route 7 of .* has 1 waypoints",
        ),
        ("</routes>", XML[XML.index("<route ") :], "several routes with the id '7'"),
    ],
)
def test_mistakes_in_a_route_file_are_one_line_that_names_it(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    path = tmp_path / "routes.xml"
    path.write_text(XML.replace(old, new).replace("</route>", "</route>"))
    with pytest.raises(InputError, match=message) as error:
        read_carla_routes(path)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)


def test_a_file_that_is_not_there_and_a_set_that_is_unknown_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gone\.xml"):
        load_route_set(str(tmp_path / "gone.xml"))
    with pytest.raises(InputError, match=r"town05-tall.*town05-short"):
        load_route_set("town05-tall")


def test_the_sets_that_come_along_have_the_published_sizes() -> None:
    carlas = {"town05-short", "town05-short-10", "town05-long", "longest6"}
    assert set(route_set_names()) == carlas | ROUTE_SETS.keys()
    short, long, longest = (load_route_set(name) for name in ("town05-short", "town05-long", "longest6"))
    assert (len(short), len(long), len(longest)) == (32, 10, 36)
    assert {route.town for route in [*short, *long]} == {"Town05"}
    assert {route.town for route in longest} == {f"Town0{k}" for k in range(1, 7)}
    assert [route.id for route in load_route_set("town05-short-10")] == [route.id for route in short[:10]]
    for route in short:
        assert np.linalg.norm(route.xyz_m[1] - route.xyz_m[0]) == pytest.approx(70.7, abs=0.1)
    chords = [np.linalg.norm(np.diff(route.xyz_m, axis=0), axis=1).sum() for route in long]
    assert (min(chords), max(chords)) == (pytest.approx(531, abs=1), pytest.approx(2101, abs=1))


@pytest.mark.parametrize("name", list(ROUTE_SETS))
def test_foredrive_has_routes_of_its_own(name: str) -> None:
    spec, routes = ROUTE_SETS[name], load_route_set(name)
    assert Counter(route.town for route in routes) == spec.towns
    assert {is_held_out(town) for town in spec.towns} == {name.startswith("unseen")}
    assert "Town05" not in spec.towns
    assert len({route.id for route in routes}) == len(routes)
    here = [snap_route(route) for route in routes if route.town in ("Town02", "Town15")]
    assert all(spec.min_m <= route.length_m <= spec.max_m for route in here)
    assert max(route.aside_m for route in here) < 0.5
    met = set(np.concatenate([route.option for route in here]).tolist())
    assert {RouteOption.LEFT, RouteOption.RIGHT, RouteOption.STRAIGHT, RouteOption.FOLLOW} <= met


def test_what_is_shipped_is_written_as_it_is_read(tmp_path: Path) -> None:
    routes = [RouteWaypoints("3", "Town02", np.array([[1.004, -2.0, 0.0], [5.0, 6.0, 7.126]]))]
    write_shipped(tmp_path / "sets.json", {"mine": routes})
    expected = '{"mine":[\n{"id":"3","town":"Town02","xyz_m":[[1.0,-2.0,0.0],[5.0,6.0,7.13]]}]}\n'
    assert (tmp_path / "sets.json").read_text() == expected


@pytest.fixture(scope="module", params=["town05-short", "town05-long"])
def snapped(request: pytest.FixtureRequest) -> list[tuple[RouteWaypoints, DriveRoute]]:
    return [(route, snap_route(route)) for route in load_route_set(request.param)]


def test_every_route_of_town05_is_as_long_as_it_should_be(
    snapped: list[tuple[RouteWaypoints, DriveRoute]],
) -> None:
    for given, route in snapped:
        chord_m = np.linalg.norm(np.diff(given.xyz_m, axis=0), axis=1).sum()
        if len(given.xyz_m) == 2:  # short: waypoints beside the road, up to 58 m
            assert route.aside_m < 58
            assert 49 < route.length_m < 450
        else:
            assert route.aside_m < 0.3
            assert chord_m < route.length_m < 1.07 * chord_m
    if len(snapped) == 32:
        assert np.median([route.length_m for _, route in snapped]) == pytest.approx(83, abs=3)


def test_lanes_of_routes_follow_each_other_or_lie_side_by_side(
    snapped: list[tuple[RouteWaypoints, DriveRoute]], graph: LaneGraph
) -> None:
    for _, route in snapped:
        for before, leg in itertools.pairwise(route.legs):
            if leg.changes:
                beside = graph.left if leg.changes > 0 else graph.right
                assert beside[before.lane] == leg.lane
                assert graph.junction[leg.lane] < 0
            else:
                assert leg.lane in graph.successors[before.lane]
                assert before.to_m == pytest.approx(graph.length_m[before.lane])
                assert leg.from_m == 0
        for before, after in itertools.pairwise(route.lanes):
            beside = {after, int(graph.left[after]), int(graph.right[after])}
            beside |= {int(side[lane]) for lane in beside if lane >= 0 for side in (graph.left, graph.right)}
            assert beside & set(graph.successors[before].tolist())


def test_the_lines_of_routes_can_be_driven(snapped: list[tuple[RouteWaypoints, DriveRoute]]) -> None:
    for _, route in snapped:
        steps = np.diff(route.xyz, axis=0)
        step_m = np.hypot(steps[:, 0], steps[:, 1])
        heading = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
        assert step_m.max() < 1.6
        assert np.abs(np.diff(heading)).max() < np.deg2rad(25)
        assert np.abs(steps[:, 2]).max() < 0.2
        assert route.arc_m[-1] == pytest.approx(step_m.sum())
        assert len(route.arc_m) == len(route.option) == len(route.xyz)


def test_the_line_leads_past_the_waypoints(snapped: list[tuple[RouteWaypoints, DriveRoute]]) -> None:
    for given, route in snapped:
        for xyz in given.xyz_m if len(given.xyz_m) > 2 else []:
            # Changes of lanes begin before the waypoint that wants them: up to two lanes aside.
            assert np.hypot(*(route.xyz - xyz)[:, :2].T).min() < 7.1


def crossing(graph: LaneGraph) -> tuple[int, list[int]]:
    """A lane from which one may turn left, right or go straight, and the ways through the junction."""
    for lane in range(len(graph.ids)):
        onward = graph.successors[lane, : graph.successor_count[lane]].tolist()
        if len({graph.command(n) for n in onward}) > 1 and graph.length_m[lane] > 30:
            return lane, onward
    raise AssertionError


def test_a_junction_s_way_is_the_option_within_it_and_follow_before_and_after(graph: LaneGraph) -> None:
    lane, ways = crossing(graph)
    for way in ways:
        after = int(graph.successors[way, 0])
        points = [
            graph.position(np.array([n]), np.array([s]))[0]
            for n, s in ((lane, 10.0), (lane, graph.length_m[lane] - 5), (after, 8.0))
        ]
        legs, _ = find_way(graph, np.array(points))
        assert [leg.lane for leg in legs] == [lane, way, after]
        xyz, option = route_line(graph, legs)
        turns = [RouteOption(k) for k, _ in itertools.groupby(option)]
        expected = RouteOption[graph.command(way).name]
        assert turns == [RouteOption.FOLLOW, expected, RouteOption.FOLLOW]
        lengths = graph.length_m[lane] - 10, graph.length_m[way], 8.0
        assert np.hypot(*np.diff(xyz[:, :2], axis=0).T).sum() == pytest.approx(sum(lengths), rel=0.01)


def lanes_side_by_side(graph: LaneGraph) -> int:
    """A long lane that may be left to the left; it has no tight curves."""
    good = graph.may_cross[0] & (graph.length_m > 200) & (graph.min_radius_m > 100)
    return int(np.flatnonzero(good)[0])


def test_a_change_of_lanes_is_led_over_smoothly_and_named(graph: LaneGraph) -> None:
    right = lanes_side_by_side(graph)
    left = int(graph.left[right])
    points = [graph.position(np.array([n]), np.array([s]))[0] for n, s in ((right, 2.0), (left, 180.0))]
    legs, _ = find_way(graph, np.array(points))
    assert [(leg.lane, leg.changes) for leg in legs] == [(right, 0), (left, 1)]
    xyz, option = route_line(graph, legs)
    assert {RouteOption(k) for k in option} == {RouteOption.FOLLOW, RouteOption.CHANGE_LEFT}
    np.testing.assert_allclose(xyz[[0, -1]], points, atol=0.05)
    aside_m, changing = graph.width_m[right], option == RouteOption.CHANGE_LEFT
    to_lane = {n: cKDTree(graph.samples(n)[:, :2]).query(xyz[:, :2])[0] for n in (right, left)}
    assert to_lane[right][: np.argmax(changing)].max() < 0.3
    assert to_lane[left][len(xyz) - np.argmax(changing[::-1]) :].max() < 0.3
    np.testing.assert_allclose(to_lane[right] + to_lane[left], aside_m, atol=0.25)
    assert np.diff(to_lane[right]).max() < 0.2
    assert np.diff(to_lane[right]).min() > -0.02
    steps = np.diff(xyz[:, :2], axis=0)
    assert np.abs(np.diff(np.unwrap(np.arctan2(steps[:, 1], steps[:, 0])))).max() < 0.03


def test_an_end_behind_the_start_is_driven_round_to(graph: LaneGraph) -> None:
    lane = lanes_side_by_side(graph)
    ahead, behind = graph.position(np.array([lane, lane]), np.array([60.0, 30.0]))
    legs, _ = find_way(graph, np.array([ahead, behind]))
    assert legs[0].lane == legs[-1].lane == lane
    assert (legs[0].from_m, legs[-1].to_m) == (pytest.approx(60.0, abs=0.1), pytest.approx(30.0, abs=0.1))
    assert sum(leg.to_m - leg.from_m for leg in legs) > 200


def test_a_waypoint_on_a_lane_means_that_lane(graph: LaneGraph) -> None:
    lane = lanes_side_by_side(graph)
    (place,) = places_near(graph, graph.position(np.array([lane]), np.array([50.3]))[0])
    assert place.lane == lane
    assert place.s_m == pytest.approx(50.3, abs=0.01)
    assert place.aside_m == pytest.approx(0.0, abs=1e-6)


def test_a_route_that_cannot_be_driven_is_named() -> None:
    here = np.zeros((1, 3))
    with pytest.raises(InputError, match="route 4 in Town05: a route needs at least two waypoints, got 1"):
        snap_route(RouteWaypoints("4", "Town05", here))
    with pytest.raises(InputError, match="route 4 in Town99: unknown town"):
        snap_route(RouteWaypoints("4", "Town99", np.zeros((2, 3))))


@pytest.mark.real
def test_what_is_shipped_is_what_the_route_files_say(real_data: Path) -> None:
    folder = real_data / "carla" / "routes"
    if not folder.is_dir():
        pytest.skip("no route files here")
    files = {
        "town05-short": "transfuser_routes_town05_short_32.xml",
        "town05-short-10": "routes_town05_short.xml",
        "town05-long": "routes_town05_long.xml",
        "longest6": "longest6.xml",
    }
    for name, file in files.items():
        given, shipped = read_carla_routes(folder / file), load_route_set(name)
        assert [(route.id, route.town) for route in given] == [(route.id, route.town) for route in shipped]
        for one, other in zip(given, shipped, strict=True):
            np.testing.assert_allclose(one.xyz_m, other.xyz_m, atol=0.00501)
