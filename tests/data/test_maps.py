"""Maps shared by many logs, and the patch around the ego vehicle."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import synthetic_log as world
import torch
from py123d.datatypes import BaseMapObject, Crosswalk, Lane, LaneGroup, LaneType, RoadEdge, RoadEdgeType
from py123d.geometry import Polyline3D

from foredrive.data import ClipConfig, ClipDataset, find_logs
from foredrive.data.log_writer import LogWriter
from foredrive.data.logs import Log
from foredrive.data.maps import RADIUS_M, VERTICES, read_lane_outlines, read_map_patch, write_map
from foredrive.data.road_maps import BEYOND_M, read_road_map
from foredrive.scene import MapKind, MapPatch, VoxelSpec


def line(y: float, z: float = 0.2) -> Polyline3D:
    """From 100 m behind the start to 100 m ahead, a vertex a metre."""
    x = np.arange(-100.0, 101.0)
    xyz = np.stack([x, np.full_like(x, y), np.full_like(x, z)], -1)
    return Polyline3D.from_array(xyz + world.WORLD_OFFSET)


def objects() -> list[BaseMapObject]:
    lane = Lane(
        object_id=1,
        lane_type=LaneType.SURFACE_STREET,
        lane_group_id=1,
        left_boundary=line(1.75),
        right_boundary=line(-1.75),
        centerline=line(0.0),
    )
    square = np.array([[8.0, -2, 0.2], [11, -2, 0.2], [11, 2, 0.2], [8, 2, 0.2], [8, -2, 0.2]])
    far = square + np.array([500.0, 0, 0])
    return [
        lane,
        RoadEdge(object_id=1, road_edge_type=RoadEdgeType.ROAD_EDGE_BOUNDARY, polyline=line(-3.0)),
        Crosswalk(object_id=1, outline=Polyline3D.from_array(square + world.WORLD_OFFSET)),
        Crosswalk(object_id=2, outline=Polyline3D.from_array(far + world.WORLD_OFFSET)),
    ]


def write_with_map(root: Path) -> Log:
    maps_dir = write_map(objects(), "Flatland", root)
    with LogWriter(root, "flat_train", "log", [], maps_dir, "Flatland", None) as writer:
        for index in range(11):
            writer.write(world.frame(index, []))
    return Log(find_logs(root)[0])


def of_kind(patch: MapPatch, kind: MapKind) -> np.ndarray:
    pieces = patch.kind == kind
    return patch.vertices[pieces][patch.valid[pieces]].numpy()


def test_the_patch_is_in_the_ego_frame(tmp_path: Path) -> None:
    log = write_with_map(tmp_path)
    patch = read_map_patch(log, 10)  # 5 m on
    assert patch.vertices.shape[1:] == (VERTICES, 3)
    (outline,) = patch.vertices[patch.kind == MapKind.CROSSWALK]
    expected = [[3, -2, 0.2], [6, -2, 0.2], [6, 2, 0.2], [3, 2, 0.2], [3, -2, 0.2]]
    torch.testing.assert_close(outline[:5], torch.tensor(expected), atol=1e-4, rtol=0)
    centre = of_kind(patch, MapKind.LANE_CENTRE)
    np.testing.assert_allclose(centre[:, 1:], np.tile([0.0, 0.2], (len(centre), 1)), atol=1e-4)
    assert set(of_kind(patch, MapKind.LANE_BOUNDARY)[:, 1].round(3).tolist()) == {1.75, -1.75}
    assert set(of_kind(patch, MapKind.ROAD_EDGE)[:, 1].round(3).tolist()) == {-3.0}


def test_polylines_are_cut_without_gaps_and_end_near_the_radius(tmp_path: Path) -> None:
    patch = read_map_patch(write_with_map(tmp_path), 0)
    centre = np.unique(of_kind(patch, MapKind.LANE_CENTRE)[:, 0].round(3))
    np.testing.assert_allclose(np.diff(centre), 1.0, atol=1e-3)
    assert RADIUS_M <= centre.max() <= RADIUS_M + VERTICES
    assert (patch.kind == MapKind.LANE_CENTRE).sum() > 3
    assert patch.valid.any(-1).all()


def test_outlines_of_lanes_are_those_near_the_way_driven(tmp_path: Path) -> None:
    outlines = read_lane_outlines(write_with_map(tmp_path))
    assert outlines is not None
    (lane,) = outlines
    low, high = world.WORLD_OFFSET[:2] + np.array([[-100.0, -1.75], [100.0, 1.75]])
    np.testing.assert_allclose(lane.min(axis=0), low, atol=1e-3)
    np.testing.assert_allclose(lane.max(axis=0), high, atol=1e-3)
    assert read_lane_outlines(Log(find_logs(world.write(tmp_path / "bare", frames=2))[0])) is None


def test_clips_carry_the_map_and_batches_pad_it(tmp_path: Path) -> None:
    log = write_with_map(tmp_path)
    config = ClipConfig(0, 0, (8, 8), VoxelSpec((0.0, 0.0, 0.0), 1.0, (1, 2, 2)), map=True)
    example = ClipDataset([log.path], config, None)[0]
    assert example.clip.map is not None
    assert torch.equal(example.clip.map.vertices, read_map_patch(log, 0).vertices)


def test_a_map_is_written_once(tmp_path: Path) -> None:
    maps_dir = write_map(objects(), "Flatland", tmp_path)
    (file,) = maps_dir.rglob("*.arrow")
    before = file.stat().st_mtime_ns
    write_map(objects(), "Flatland", tmp_path)
    assert file.stat().st_mtime_ns == before
    again = write_map(objects(), "Flatland", tmp_path / "elsewhere")
    assert next(again.rglob("*.arrow")).read_bytes() == file.read_bytes()


def test_roads_have_a_route_and_a_centreline(tmp_path: Path) -> None:
    """The log drives in the lane along x. A second lane is in its group, a third in another."""

    def lane(number: int, group: int, left: float, right: float) -> Lane:
        sides, middle = (line(left), line(right)), line(0.5 * (left + right))
        return Lane(number, LaneType.SURFACE_STREET, *sides, middle, lane_group_id=group)

    def group(number: int, lanes: list[int], left: float, right: float) -> LaneGroup:
        return LaneGroup(number, lanes, line(left), line(right))

    lanes = [lane(1, 1, 1.75, -1.75), lane(2, 1, 5.25, 1.75), lane(3, 2, 8.75, 5.25)]
    groups = [group(1, [1, 2], 5.25, -1.75), group(2, [3], 8.75, 5.25)]
    maps_dir = write_map([*lanes, *groups], "Flatland", tmp_path)
    with LogWriter(tmp_path, "flat_train", "log", [], maps_dir, "Flatland", None) as writer:
        for index in range(11):
            writer.write(world.frame(index, []))
    roads = read_road_map(Log(find_logs(tmp_path)[0]))
    assert roads is not None
    found = zip(roads.lanes, roads.on_route, strict=True)
    by_side = {round(float(ring[:, 1].max()) + 50.0, 2): on for ring, on in found}
    assert by_side == {1.75: True, 5.25: True, 8.75: False}
    np.testing.assert_allclose(roads.centreline[:, 1], -50.0, atol=1e-6)
    assert roads.centreline[0, 0] < 50.0
    assert roads.centreline[-1, 0] > 160.0
    assert len(roads.drivable) == 5


@pytest.mark.parametrize("wobble_m", [0.0, 0.001])
@pytest.mark.parametrize("lane_y_m", [0.5, 50.0])
def test_the_centreline_of_a_vehicle_that_stands_goes_straight_on(
    tmp_path: Path, lane_y_m: float, wobble_m: float
) -> None:
    """It points 30° to the left, in a lane or beside all lanes; its measured positions may wobble."""
    sides = (line(lane_y_m + 1.75), line(lane_y_m - 1.75))
    lane = Lane(1, LaneType.SURFACE_STREET, *sides, line(lane_y_m), lane_group_id=1)
    maps_dir = write_map([lane], "Flatland", tmp_path)
    heading = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)])
    T_world_ego = np.eye(4)
    T_world_ego[:2, :2] = np.stack([heading, [-heading[1], heading[0]]], axis=1)
    with LogWriter(tmp_path, "flat_train", "log", [], maps_dir, "Flatland", None) as writer:
        for index in range(11):
            T_world_ego[:3, 3] = world.WORLD_OFFSET + np.array([0.0, -wobble_m * index, 0.0])
            writer.write(dataclasses.replace(world.frame(index, []), T_world_ego=T_world_ego.copy()))
    roads = read_road_map(Log(find_logs(tmp_path)[0]))
    assert roads is not None
    assert roads.on_route == (lane_y_m < 1.75,)
    middle = world.WORLD_OFFSET[:2] + np.array([0.0, lane_y_m if roads.on_route[0] else 0.0])
    expected = [middle - BEYOND_M * heading, middle, middle + BEYOND_M * heading]
    np.testing.assert_allclose(roads.centreline, expected, atol=1e-6)
