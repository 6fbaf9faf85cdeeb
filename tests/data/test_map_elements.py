"""Map elements and raster layers of a street of two lane pieces, a junction, crossings, another level."""

from pathlib import Path

import numpy as np
import pytest
import synthetic_log as world
import torch
from flat_street import lane, street
from py123d.datatypes import BaseMapObject, Lane, LaneType
from py123d.geometry import Polyline3D

from foredrive.data import LogPath, find_logs
from foredrive.data.clip_config import UNIAD_RASTER
from foredrive.data.formats.convert import convert
from foredrive.data.log_writer import LogWriter
from foredrive.data.logs import Log
from foredrive.data.maps import write_map
from foredrive.data.truth.map_elements import read_map_elements, read_map_raster
from foredrive.scene.map_elements import ElementKind, MapElements, RasterLayer

PATCH = (60.0, 30.0)
EGO_X = 5.0
"""Of frame 10."""


def log_with(objects: list[BaseMapObject], root: Path, yaw: float = 0.0) -> Log:
    maps_dir = write_map(objects, "Flatland", root)
    with LogWriter(root, "flat_train", "log", [], maps_dir, "Flatland", None) as writer:
        for index in range(11):
            frame = world.frame(index, [])
            frame.T_world_ego[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
            writer.write(frame)
    return Log(find_logs(root)[0])


def of_kind(elements: MapElements, kind: ElementKind) -> list[np.ndarray]:
    rows = (elements.kind == kind).nonzero()[:, 0]
    return [elements.vertices[row][elements.valid[row]].numpy() for row in rows]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    return log_with(street(), tmp_path_factory.mktemp("street"))


def test_the_line_between_two_lanes_of_two_pieces_is_one_divider(log: Log) -> None:
    """Four boundaries of four lanes become one line, from the patch's border to the junction."""
    elements = read_map_elements(log, 10, PATCH)
    assert bool(elements.known)
    (divider,) = of_kind(elements, ElementKind.DIVIDER)
    assert sorted([divider[0, 0], divider[-1, 0]]) == pytest.approx([-30.0, 18.1 - EGO_X], abs=1e-3)
    np.testing.assert_allclose(divider[:, 1], 1.75, atol=1e-3)


def test_boundaries_are_road_edges_without_gaps_in_junctions(log: Log) -> None:
    found = of_kind(read_map_elements(log, 10, PATCH), ElementKind.BOUNDARY)
    assert sorted(round(float(part[0, 1]), 3) for part in found) == [-1.75, 5.25]
    for part in found:
        assert sorted([part[0, 0], part[-1, 0]]) == pytest.approx([-30.0, 30.0], abs=1e-3)


def test_a_crossing_is_closed_within_the_patch_and_open_at_its_border(log: Log) -> None:
    inside, cut = of_kind(read_map_elements(log, 10, PATCH), ElementKind.CROSSING)
    assert inside[0].tolist() == inside[-1].tolist()
    assert {tuple(corner) for corner in inside.round(3).tolist()} == {
        (x - EGO_X, y) for x in (8.0, 11.0) for y in (-1.75, 5.25)
    }
    assert len(cut) == 4
    assert sorted(cut[[0, -1]].round(3).tolist()) == [[30.0, -1.75], [30.0, 5.25]]
    assert sorted(cut[1:3].round(3).tolist()) == [[28.0, -1.75], [28.0, 5.25]]


def test_centrelines_are_joined_in_the_direction_of_travel(log: Log) -> None:
    found = of_kind(read_map_elements(log, 10, PATCH), ElementKind.CENTRELINE)
    ahead, back = sorted(found, key=lambda part: part[0, 1])
    np.testing.assert_allclose(ahead[[0, -1]], [[-30.0, 0.0], [30.0, 0.0]], atol=1e-3)
    np.testing.assert_allclose(back[[0, -1]], [[18.1 - EGO_X, 3.5], [-30.0, 3.5]], atol=1e-3)


def test_the_patch_turns_with_the_ego_vehicle(tmp_path: Path) -> None:
    """Facing along world y, the street crosses the narrow side of the patch."""
    (divider,) = of_kind(
        read_map_elements(log_with(street(), tmp_path, 0.5 * np.pi), 10, PATCH), ElementKind.DIVIDER
    )
    np.testing.assert_allclose(divider[:, 0], 1.75, atol=1e-3)
    assert sorted([divider[0, 1], divider[-1, 1]]) == pytest.approx([-(18.1 - EGO_X), 15.0], abs=1e-3)


def test_the_wide_patch_shows_more(log: Log) -> None:
    (divider,) = of_kind(read_map_elements(log, 10, (100.0, 50.0)), ElementKind.DIVIDER)
    assert divider[:, 0].min() == pytest.approx(-50.0, abs=1e-3)


def test_a_fork_ends_the_lines_that_meet_there(tmp_path: Path) -> None:
    fork = lane(3, 1, 10.0, 40.0, 0.0)
    bent = fork.centerline.array.copy()
    bent[:, 1] += 0.2 * (bent[:, 0] - bent[0, 0])
    away = Lane(
        object_id=4,
        lane_type=LaneType.SURFACE_STREET,
        lane_group_id=1,
        left_boundary=Polyline3D.from_array(bent + np.array([0.0, 1.75, 0.0])),
        right_boundary=Polyline3D.from_array(bent - np.array([0.0, 1.75, 0.0])),
        centerline=Polyline3D.from_array(bent),
    )
    before = lane(2, 1, -40.0, 10.0, 0.0)
    elements = read_map_elements(log_with([before, fork, away], tmp_path), 10, PATCH)
    assert len(of_kind(elements, ElementKind.CENTRELINE)) == 3


def test_layers_are_drawn_as_uniad_draws_them(log: Log) -> None:
    layers = read_map_raster(log, 10, UNIAD_RASTER, 2).layers.numpy()
    drivable, divider = layers[RasterLayer.DRIVABLE], layers[RasterLayer.DIVIDER]
    crossing, boundary = layers[RasterLayer.CROSSING], layers[RasterLayer.BOUNDARY]
    row = lambda y: int((y + 51.2) / 0.512)  # noqa: E731
    column = lambda x: int((x - EGO_X + 51.2) / 0.512)  # noqa: E731
    assert drivable[row(-1.7) + 1 : row(5.2), column(-40.0) : column(40.0)].all()
    assert not drivable[row(-1.75) - 2].any()
    assert not drivable[row(5.25) + 2].any()
    assert divider[row(1.75), column(-40.0) : column(4.0)].all()
    assert set(np.nonzero(divider)[0].tolist()) <= {row(1.75) - 1, row(1.75), row(1.75) + 1}
    assert not divider[:, column(7.0) : column(12.0)].any()  # erased by the crossing
    assert not divider[:, column(20.0) :].any()
    assert boundary[row(-1.75), column(-40.0) : column(40.0)].all()
    assert not boundary[row(2.0) : row(4.0)].any()
    assert crossing[row(1.75), column(8.0)]
    assert crossing[row(1.75), column(11.0)]
    assert not crossing[row(1.75), column(9.5)]  # the short edges are not drawn, and the inside is empty
    assert not (boundary & crossing).any()


def test_a_log_without_a_map_has_nothing_and_says_so(flat_log: Path) -> None:
    bare = Log(LogPath(flat_log, flat_log.parents[2] / "maps"))
    elements, raster = read_map_elements(bare, 0, PATCH), read_map_raster(bare, 0, UNIAD_RASTER, 2)
    assert not elements.known
    assert not raster.known
    assert elements.vertices.shape[0] == 0
    assert not raster.layers.any()


def test_a_map_without_anything_near_is_known_to_be_empty(tmp_path: Path) -> None:
    far = lane(1, 1, 5000.0, 5100.0, 0.0)
    elements = read_map_elements(log_with([far], tmp_path), 10, PATCH)
    assert bool(elements.known)
    assert elements.vertices.shape[0] == 0


@pytest.mark.real
def test_argoverses_map_lies_in_the_patch_and_in_the_drivable_area(real_data: Path, tmp_path: Path) -> None:
    for path in convert(real_data / "av2", "av2", tmp_path):
        log = Log(path)
        elements = read_map_elements(log, len(log) // 2, PATCH)
        assert (elements.vertices.abs() <= torch.tensor([30.0, 15.0]) + 1e-3).all()
        dividers = of_kind(elements, ElementKind.DIVIDER)
        assert 1 <= len(dividers) < 20
        raster = read_map_raster(log, len(log) // 2, UNIAD_RASTER, 2)
        points = np.concatenate(dividers)
        cells = ((points + 51.2) / 0.512).astype(int)
        drivable = raster.layers[RasterLayer.DRIVABLE].numpy()
        assert drivable[cells[:, 1], cells[:, 0]].mean() > 0.95
        assert len(of_kind(elements, ElementKind.BOUNDARY)) >= 1
