"""What stands in a town, and where."""

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from scenes import straight

from foredrive.towns.map.ground_plan import make_ground_plan
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.place.materials import MaterialTable, Surface
from foredrive.towns.place.mesh import Mesh, box, frustum, join, prism, walls
from foredrive.towns.place.parking import footprint
from foredrive.towns.place.road_mesh import build_roads
from foredrive.towns.place.terrain import build_terrain, make_terrain
from foredrive.towns.sensing.raycast import TriangleScene
from foredrive.towns.sensing.shading import MISS
from foredrive.towns.world import World

CORRIDOR_M = 3.0


def signed_volume(mesh: Mesh) -> float:
    a, b, c = mesh.xyz.astype(np.float64).transpose(1, 0, 2)
    return float((a * np.cross(b, c)).sum() / 6)


def lane_points(town: TownMap, offsets: tuple[float, ...] = (0.0,)) -> np.ndarray:
    points = []
    for lane in town.lanes:
        for offset in offsets:  # share of the half width, to the left
            across = lane.left_boundary_xyz - lane.centreline_xyz
            points.append((lane.centreline_xyz + offset * across)[1:-1])
    return np.concatenate(points)


def above(points: np.ndarray, height_m: float) -> np.ndarray:
    return points + np.array([0.0, 0.0, height_m])


def look_down(world: World, from_xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height of the first surface below points, and what it is."""
    down = np.tile(np.array([0, 0, -1], np.float32), (len(from_xyz), 1))
    hits = TriangleScene(world.static.mesh).cast(from_xyz.astype(np.float32), down)
    assert (hits.triangle != MISS).all()
    surface = world.surfaces[world.static.mesh.material[hits.triangle]]
    return from_xyz[:, 2] - hits.t, surface


@given(st.floats(0.1, 5), st.floats(0.1, 5), st.floats(0.1, 5))
def test_primitives_are_closed_and_face_outwards(a: float, b: float, c: float) -> None:
    np.testing.assert_allclose(signed_volume(box((0, 0, 0), (a, b, c), 0)), a * b * c, rtol=1e-4)
    square = shapely.Polygon([(0, 0), (a, 0), (a, b), (0, b)])
    np.testing.assert_allclose(signed_volume(prism(square, 1.0, 1.0 + c, 0, 0)), a * b * c, rtol=1e-3)
    cone = frustum((0, 0, 0), (0, 0, c), (a, 0.0), 64, 0)
    np.testing.assert_allclose(signed_volume(cone), np.pi * a * a * c / 3, rtol=0.01)


def test_wall_coordinates_run_from_both_ends() -> None:
    mesh = walls(np.array([[0.0, 0.0], [4.0, 0.0]]), 1.0, 3.5, 7)
    assert set(map(tuple, mesh.uvw.reshape(-1, 3))) == {(0, 0, 4), (4, 0, 0), (4, 2.5, 0), (0, 2.5, 4)}
    assert (np.cross(mesh.xyz[:, 1] - mesh.xyz[:, 0], mesh.xyz[:, 2] - mesh.xyz[:, 0])[:, 1] < 0).all()


def test_the_road_lies_where_the_map_says(world02: World, town02: TownMap) -> None:
    points = lane_points(town02, (-0.8, 0.0, 0.8))
    z, surface = look_down(world02, above(points, CORRIDOR_M))
    assert (surface == Surface.ROAD).mean() > 0.999  # nothing in the lanes' way, and no hole
    assert np.abs(z - points[:, 2]).max() < 0.02


def test_walkways_are_raised_and_level_with_the_land(world02: World, town02: TownMap) -> None:
    strips = [s for s in town02.strips if s.kind == "sidewalk"]
    middle = np.concatenate([0.5 * (s.left_xyz + s.right_xyz) for s in strips])
    z, surface = look_down(world02, above(middle, 1.0))
    walkway = surface == Surface.SIDEWALK
    assert walkway.mean() > 0.9  # the rest is crossed by roads in junctions
    np.testing.assert_allclose(z[walkway] - middle[walkway, 2], 0.15, atol=0.02)
    beyond = np.concatenate([s.right_xyz + 0.5 * (s.right_xyz - s.left_xyz) / 4 for s in strips])
    z, surface = look_down(world02, above(beyond, 1.0))
    land = surface == Surface.TERRAIN
    assert land.mean() > 0.5
    assert np.abs(z[land] - beyond[land, 2]).max() < 0.4


def test_each_spot_of_a_level_belongs_to_one_piece(town02: TownMap) -> None:
    plan = make_ground_plan(town02)
    for rank in ("sidewalk", "shoulder"):
        area = shapely.union_all([p.area for p in plan.pieces if p.strip.kind == rank])
        assert area.intersection(plan.lanes).area < 0.5
    assert plan.ground.area >= plan.lanes.area


def test_a_road_over_another_is_a_bridge_with_room_below() -> None:
    below, over = straight("1", (-40, 0, 0), (40, 0, 0)), straight("2", (0, -40, 6), (0, 40, 6))
    town = TownMap("Town02", (), (below, over), (), (), {})
    plan = make_ground_plan(town)
    assert {p.strip.id for p in plan.pieces if p.bridge} == {"2"}
    assert all(p.whole for p in plan.pieces)  # neither road cuts the other
    table = MaterialTable()
    terrain = make_terrain(plan, town.bounds_m, np.random.default_rng(0))
    mesh = join([build_roads(town, plan, table), build_terrain(terrain, plan, table)])
    scene, up = TriangleScene(mesh), np.array([[0.0, 0.0, 1.0]], np.float32)
    z = scene.cast(np.array([[0.5, 0.5, 0.5]], np.float32), up).t + 0.5
    assert 4.5 < z[0] < 5.5  # the deck's underside
    away = scene.cast(np.array([[10.5, 0.5, 0.5]], np.float32), up)
    assert away.triangle[0] == MISS  # the sky
    under, embankment = terrain.height(np.array([[0.0, 6.0], [0.0, 30.0]]))
    assert under < 4.5
    assert embankment == pytest.approx(6.0, abs=0.1)


def test_buildings_and_parked_cars_keep_off_the_roads(world02: World, town02: TownMap) -> None:
    lanes = shapely.union_all([strip.polygon for strip in town02.strips])
    mesh = world02.static.mesh
    building = world02.surfaces[mesh.material] == Surface.BUILDING
    shapely.prepare(lanes)
    corners = mesh.xyz[building].reshape(-1, 3)
    assert not shapely.contains_xy(lanes, corners[:, 0], corners[:, 1]).any()
    cars = [footprint(car) for car in world02.parked]
    assert len(cars) > 20
    assert not any(lanes.intersects(car) for car in cars)
    tree = shapely.STRtree(cars)
    first, second = tree.query(cars, predicate="intersects")
    assert (first == second).all()


def test_nothing_hovers(world02: World) -> None:
    """Parked cars stand on the ground below them."""
    feet = np.array([car.centre_m - [0.0, 0.0, 0.5 * car.size_lwh[2]] for car in world02.parked])
    z, _ = look_down(world02, above(feet, 0.05))
    np.testing.assert_allclose(z, feet[:, 2], atol=0.05)


def test_the_same_seed_gives_the_same_town(world02: World, town02: TownMap) -> None:
    again = World(town02, seed=3, conditions=world02.conditions)
    for name in ("xyz", "uvw", "material"):
        a, b = getattr(world02.static.mesh, name), getattr(again.static.mesh, name)
        assert a.tobytes() == b.tobytes()
    assert world02.light.sun.tobytes() == again.light.sun.tobytes()
    assert [repr(car) for car in again.parked] == [repr(car) for car in world02.parked]


def test_another_seed_gives_another_town() -> None:
    street = TownMap("Town02", (), (straight("1", (-40.0, 0.0, 0.0), (40.0, 0.0, 0.0)),), (), (), {})
    one, two = World(street, seed=1), World(street, seed=2)
    assert one.static.mesh.xyz.shape != two.static.mesh.xyz.shape
