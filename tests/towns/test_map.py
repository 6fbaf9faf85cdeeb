"""Town maps."""

from collections.abc import Callable

import numpy as np
import pytest
from py123d.datatypes import Lane, RoadEdge
from scipy.spatial import cKDTree

from foredrive.errors import InputError
from foredrive.towns.map import opendrive
from foredrive.towns.map.junction_heights import level_junction
from foredrive.towns.map.loading import load_town_map, xodr_file
from foredrive.towns.map.map_objects import map_objects
from foredrive.towns.map.town_map import MarkingKind, StopZoneKind, StripKind, TownMap


def test_an_unknown_town_is_named_with_those_there_are() -> None:
    with pytest.raises(InputError, match=r"Town99.*Town01.*Town10HD"):
        load_town_map("Town99")


def test_lanes_join_end_to_start(town02: TownMap) -> None:
    lanes = {lane.lane_id: lane for lane in town02.lanes}
    assert len(lanes) == 88
    for lane in town02.lanes:
        assert lane.successor_ids
        for name in lane.successor_ids:
            following = lanes[name]
            assert np.linalg.norm(following.centreline_xyz[0] - lane.centreline_xyz[-1]) < 0.05
            assert lane.lane_id in following.predecessor_ids


def test_borders_lie_on_their_sides(town02: TownMap) -> None:
    for lane in town02.lanes:
        ahead = np.diff(lane.centreline_xyz[:, :2], axis=0)
        across = (lane.left_boundary_xyz - lane.right_boundary_xyz)[:-1, :2]
        assert (ahead[:, 0] * across[:, 1] - ahead[:, 1] * across[:, 0] > 0).all()  # left of the direction
        assert lane.width_m == pytest.approx(4.0, abs=0.01)


def test_town02_has_a_yellow_dashed_centre_line_kerbs_and_lights(town02: TownMap) -> None:
    between = [lane for lane in town02.lanes if lane.junction_id is None]
    assert {lane.left_marking for lane in between} == {MarkingKind.BROKEN}
    strips = [s for s in town02.strips_of(StripKind.DRIVING) if s.junction_id is None]
    assert all(marking.yellow for strip in strips for marking in strip.left_markings)
    assert len(town02.strips_of(StripKind.SIDEWALK)) == 64
    assert {zone.kind for zone in town02.stop_zones} == {StopZoneKind.TRAFFIC_LIGHT}


def test_a_stop_zone_says_which_way_its_traffic_drives(town02: TownMap) -> None:
    lanes = {lane.lane_id: lane for lane in town02.lanes}
    for zone in town02.stop_zones:
        ahead = np.array([np.cos(zone.post_yaw), np.sin(zone.post_yaw)])
        for name in zone.lane_ids:
            lane = lanes[name]
            assert lane.junction_id is not None
            step = lane.centreline_xyz[1, :2] - lane.centreline_xyz[0, :2]
            assert step @ ahead > 0.9 * np.linalg.norm(step)


def test_a_lane_that_opens_has_the_width_of_the_file_and_leaves_the_lane_beside(
    town_of: Callable[[str], TownMap],
) -> None:
    """Lane -2 of road 26 of Town07 opens from nothing within 12 m."""
    town = town_of("Town07")
    lanes, name = {lane.lane_id: lane for lane in town.lanes}, "26_0_right_-2"
    strip = next(strip for strip in town.strips if strip.id == name)
    width_m = np.linalg.norm(strip.left_xyz - strip.right_xyz, axis=1)
    assert width_m[0] < 0.01
    assert (np.diff(width_m[:13]) > 0).all()
    np.testing.assert_allclose(width_m[13:], 3.5, atol=0.01)
    (before,) = lanes[name].predecessor_ids
    assert np.linalg.norm(lanes[name].centreline_xyz[0] - lanes[before].centreline_xyz[-1]) < 0.05
    np.testing.assert_allclose(lanes[name].centreline_xyz[-1], 0.5 * (strip.left_xyz + strip.right_xyz)[-1])


def test_a_light_that_names_its_lanes_itself_faces_their_traffic(town_of: Callable[[str], TownMap]) -> None:
    """Those of road 516 of Town10HD, whose lanes run against the road."""
    town = town_of("Town10HD")
    zones = {lane: zone for zone in town.stop_zones for lane in zone.lane_ids}
    for name in ("516_0_left_1", "516_0_left_2"):
        lane = next(lane for lane in town.lanes if lane.lane_id == name)
        x, y = (lane.centreline_xyz[-1] - lane.centreline_xyz[0])[:2]
        assert zones[name].kind is StopZoneKind.TRAFFIC_LIGHT
        assert abs(np.angle(np.exp(1j * (zones[name].post_yaw - np.arctan2(y, x))))) < 0.1


def test_heights_follow_the_road_where_later_lane_sections_begin(town_of: Callable[[str], TownMap]) -> None:
    """Left and right border of a lane are level, in a town on hills and with bridges."""
    town = town_of("Town04")
    between = [strip for strip in town.strips if strip.junction_id is None]
    tilt = max(np.abs(s.left_xyz[:, 2] - s.right_xyz[:, 2]).max() for s in between)
    assert tilt < 1e-6
    assert max(lane.centreline_xyz[:, 2].max() for lane in town.lanes) == pytest.approx(11.0, abs=0.1)
    lanes = {lane.lane_id: lane for lane in town.lanes}
    for lane in town.lanes:
        for name in lane.successor_ids:
            assert lanes[name].centreline_xyz[0, 2] == pytest.approx(lane.centreline_xyz[-1, 2], abs=0.05)


@pytest.mark.parametrize("name", ["Town04", "Town07"])
def test_the_map_of_logs_has_the_heights_of_the_roads(name: str, town_of: Callable[[str], TownMap]) -> None:
    """Town04 has hills and bridges, Town07 junctions whose roads differ by .4 m before they are levelled."""
    town, items = town_of(name), list(map_objects(name))
    written = {item.object_id: item for item in items if isinstance(item, Lane)}
    for lane in town.lanes:
        item = written[lane.lane_id]
        for line, xyz in (
            (item.centerline, lane.centreline_xyz),
            (item.left_boundary, lane.left_boundary_xyz),
            (item.right_boundary, lane.right_boundary_xyz),
        ):
            np.testing.assert_allclose(line.array, xyz, atol=1e-3)
    borders = cKDTree(np.concatenate([strip.outline_xyz for strip in town.strips]))
    edges = np.concatenate([item.polyline.array for item in items if isinstance(item, RoadEdge)])
    assert borders.query(edges)[0].max() < 1.0  # samples are 1 m apart


def test_crossing_roads_of_a_junction_agree_on_their_height() -> None:
    def road(start: tuple[float, float], end: tuple[float, float], bump_m: float) -> tuple[np.ndarray, ...]:
        xy = np.linspace(start, end, 41)
        z = bump_m * np.sin(np.linspace(0.0, np.pi, 41)) ** 2
        ahead = (xy[-1] - xy[0]) / np.linalg.norm(xy[-1] - xy[0])
        across = 2.0 * np.array([-ahead[1], ahead[0]])
        return np.column_stack([xy + across, z]), np.column_stack([xy - across, z])

    even, bumpy = road((-20.0, 0.0), (20.0, 0.0), 0.0), road((0.0, -20.0), (0.0, 20.0), 0.4)
    (a, _), (b, _) = level_junction([even, bumpy])
    assert np.hypot(a[20, 0] - b[20, 0], a[20, 1] - b[20, 1]) < 4.0
    near = (
        np.argmin(np.hypot(a[:, 0] + 2.0, a[:, 1] - 2.0)),
        np.argmin(np.hypot(b[:, 0] + 2.0, b[:, 1] - 2.0)),
    )
    assert abs(a[near[0], 2] - b[near[1], 2]) < 0.02  # .4 m before
    np.testing.assert_array_equal(b[[0, -1]], bumpy[0][[0, -1]])  # where they meet the roads outside
    (same, _), _ = level_junction([even, even])
    assert same is even[0]


def test_a_lane_without_road_marks_has_no_markings(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on roads of Town13: OpenDRIVE does not ask for marks. The painted neighbours keep theirs."""
    painted = load_town_map("Town02")
    collect = opendrive.collect_element_helpers

    def without_marks_of_road_0(*arguments: object) -> object:
        elements = collect(*arguments)
        for helper in elements[2].values():
            if helper.lane_id.startswith("0_"):
                helper.open_drive_lane.road_marks.clear()
        return elements

    monkeypatch.setattr(opendrive, "collect_element_helpers", without_marks_of_road_0)
    with xodr_file("Town02") as path:
        bare = {strip.id: strip for strip in opendrive.read_opendrive(path, "Town02").strips}
    of_road_0 = [strip for strip in painted.strips if strip.id.startswith("0_")]
    assert any(strip.right_markings for strip in of_road_0)
    assert not any(bare[strip.id].right_markings for strip in of_road_0)
    others = [strip for strip in painted.strips if not strip.id.startswith("0_")]
    assert all(bare[strip.id].right_markings == strip.right_markings for strip in others)
