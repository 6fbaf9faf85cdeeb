"""Where street furniture, plants and barriers stand."""

import numpy as np
import pytest
import shapely

from foredrive.towns.map.ground_plan import make_ground_plan
from foredrive.towns.map.town_map import Lane, MarkingKind, Strip, StripKind, TownMap
from foredrive.towns.place.assets import AssetSet, assets_of
from foredrive.towns.place.furniture_meshes import (
    FurnitureMaterials,
    furniture_items,
    guard_rail,
    sound_barrier,
)
from foredrive.towns.place.materials import MaterialTable, Surface
from foredrive.towns.place.site import Site
from foredrive.towns.place.street_furniture import build_street_furniture
from foredrive.towns.place.terrain import make_terrain
from foredrive.towns.place.vegetation import build_vegetation
from foredrive.towns.world import World


def volume(xyz: np.ndarray) -> float:
    a, b, c = xyz.astype(np.float64).transpose(1, 0, 2)
    return float((a * np.cross(b, c)).sum() / 6)


def motorway() -> TownMap:
    """400 m of one fast lane, 4 m wide, without walkways."""
    line = np.stack([np.linspace(0.0, 400.0, 201), np.zeros(201), np.zeros(201)], axis=-1)
    aside = np.array([0.0, 2.0, 0.0])
    left, right = line + aside, line - aside
    strip = Strip("1", StripKind.DRIVING, 0, None, left, right, (), ())
    lane = Lane(
        "1", "1", None, line, left, right, 30.0, (), (), None, None, MarkingKind.NONE, MarkingKind.NONE
    )
    return TownMap("Town06", (lane,), (strip,), (), (), {})


@pytest.fixture(scope="module")
def site() -> Site:
    town = motorway()
    plan = make_ground_plan(town)
    return Site(plan, make_terrain(plan, town.bounds_m, np.random.default_rng(0)))


def test_furniture_is_solid_and_rooted() -> None:
    for name, thing in furniture_items(FurnitureMaterials(MaterialTable())).items():
        assert volume(thing.mesh.xyz) > 0, name
        low, high = thing.mesh.xyz.reshape(-1, 3).min(0), thing.mesh.xyz.reshape(-1, 3).max(0)
        assert -0.7 < low[2] < -0.1, name  # reaches into the ground
        assert high[2] > 0.7, name
        assert (np.abs([low, high])[:, 0] <= thing.room_m[0] + 0.06).all(), name
        for _, points in thing.thin:
            assert ((points >= low - 0.06) & (points <= high + 0.06)).all(), name


@pytest.mark.parametrize("build", [guard_rail, sound_barrier])
def test_rails_face_outwards(build) -> None:
    feet = np.column_stack([np.arange(0.0, 41.0, 4.0), np.zeros(11), np.zeros(11)])
    mesh = build(feet, FurnitureMaterials(MaterialTable()))
    assert volume(mesh.xyz) > 0.1
    corners = mesh.xyz.reshape(-1, 3)
    assert corners[:, 0].min() > -0.2
    assert corners[:, 0].max() < 40.2


def test_a_motorway_has_rails_off_its_lanes(site: Site) -> None:
    mesh, thin = build_street_furniture(motorway(), site, MaterialTable(), np.random.default_rng(1))
    corners = mesh.xyz.reshape(-1, 3)
    beside = corners[(corners[:, 0] > 0.0) & (corners[:, 0] < 400.0)]
    assert np.abs(beside[:, 1]).min() > 2.0  # nothing over the lane
    along = np.unique(np.floor(corners[(corners[:, 2] > 0.4) & (corners[:, 2] < 0.8), 0] / 10.0))
    assert len(along) > 20  # most of 2 × 40 stretches of 10 m on either side
    assert len(thin.xyz) == len(thin.surface)


def test_things_keep_off_each_other(site: Site) -> None:
    taken = len(site.taken)
    build_vegetation(site, assets_of(AssetSet.TRAIN), MaterialTable(), np.random.default_rng(2))
    trees = site.taken[taken:]
    assert len(trees) > 20
    tree = shapely.STRtree(site.taken[:taken])
    assert len(tree.query(trees, predicate="intersects")[0]) == 0


def test_thin_points_lie_on_the_town(world02: World) -> None:
    """Every point that stands for a thin thing is close to a triangle of something that can be thin."""
    mesh, thin = world02.static.mesh, world02.static.thin
    chosen = np.random.default_rng(0).choice(len(thin.xyz), 400, replace=False)
    solid = np.isin(
        world02.surfaces[mesh.material], (Surface.POLE, Surface.SIGN, Surface.STRUCTURE, Surface.VEGETATION)
    )
    low, high = mesh.xyz[solid].min(axis=1), mesh.xyz[solid].max(axis=1)
    for point in thin.xyz[chosen]:
        assert ((low < point + 0.25) & (high > point - 0.25)).all(axis=1).any()


def test_furniture_stands_on_the_ground_and_off_the_paved(world02: World, site: Site) -> None:
    town = world02.town
    plan = make_ground_plan(town)
    ground = Site(plan, make_terrain(plan, town.bounds_m, np.random.default_rng(0)))
    mesh, thin = build_street_furniture(town, ground, MaterialTable(), np.random.default_rng(4))
    corners = mesh.xyz.reshape(-1, 3)
    low = corners[corners[:, 2] < 6.0]  # wires hang over roads
    shapely.prepare(plan.lanes)
    assert not shapely.contains_xy(plan.lanes, low[:, 0], low[:, 1]).any()
    feet = np.unique(corners[corners[:, 2] < ground.height(corners[:, :2]) - 0.05], axis=0)
    assert len(feet) > 200
    assert (ground.height(feet[:, :2]) - feet[:, 2]).max() < 1.2
    assert len(thin.xyz) > 100
