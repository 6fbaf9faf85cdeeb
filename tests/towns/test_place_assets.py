"""Train and test towns are furnished from different assets."""

import numpy as np
import pytest

from foredrive.scene import Category
from foredrive.scene.actors import ActorState
from foredrive.towns.map.names import LARGE_TOWNS, TEST_TOWNS, TOWNS, UNSEEN_TOWNS
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.place.actor_materials import MeshMaterials
from foredrive.towns.place.actor_meshes import PEOPLE, SHAPES_OF_KIND, VEHICLES
from foredrive.towns.place.assets import AssetSet, asset_set_of, assets_of
from foredrive.towns.place.materials import MaterialTable, Surface, Texture
from foredrive.towns.sensing.actor_shapes import make_shape_library, unit_to_world
from foredrive.towns.world import World

SIZES = {
    Category.CAR: (4.5, 1.8, 1.5),
    Category.TRUCK: (7.5, 2.4, 3.0),
    Category.BUS: (10.0, 2.4, 3.0),
    Category.MOTORCYCLE: (2.1, 0.8, 1.5),
    Category.BICYCLE: (1.7, 0.6, 1.7),
    Category.PEDESTRIAN: (0.6, 0.6, 1.75),
}


def actor(category: Category, style: int, **changes: object) -> ActorState:
    size = np.array(SIZES[category])
    fields = {
        "track_id": 1,
        "category": category,
        "centre_m": np.array([0.0, 0.0, 0.5 * size[2]]),
        "yaw": 0.0,
        "pitch": 0.0,
        "size_lwh": size,
        "velocity_mps": np.zeros(3),
        "style": style,
        "parked": False,
    }
    return ActorState(**{**fields, **changes})


def test_held_out_towns_have_the_test_assets() -> None:
    held_out = {*TEST_TOWNS, *UNSEEN_TOWNS}
    assert {town for town in (*TOWNS, *LARGE_TOWNS) if asset_set_of(town) is AssetSet.TEST} == held_out
    assert asset_set_of("Town13_Tile_3_-4") is AssetSet.TEST
    assert asset_set_of("Town12_Tile_3_-4") is AssetSet.TRAIN


def test_no_asset_is_in_both_sets() -> None:
    train, test, mixed = (vars(assets_of(chosen)) for chosen in AssetSet)
    for name in train:
        assert not set(train[name]) & set(test[name]), name
        assert set(mixed[name]) == set(train[name]) | set(test[name])


@pytest.mark.parametrize("chosen", list(AssetSet))
def test_every_kind_of_road_user_has_a_shape_in_each_set(chosen: AssetSet) -> None:
    library = make_shape_library(MaterialTable(), assets_of(chosen))
    heights = {"low_car": 1.45, "high_car": 1.7}
    seen = set()
    for category in SIZES:
        for height in heights.values() if category is Category.CAR else (SIZES[category][2],):
            for style in range(6):
                state = actor(category, style, size_lwh=np.array([*SIZES[category][:2], height]))
                seen.add(id(library.shape_of(state)))
                assert len(library.paint_of(state, rear_light=7)) == 4
    assert len(seen) >= 11
    assert all(any(name in library.shapes for name in names) for names in SHAPES_OF_KIND.values())


@pytest.mark.parametrize("name", [*VEHICLES, *PEOPLE])
def test_shapes_are_sane(name: str) -> None:
    """No empty triangles, about as large as they should be, mirrored left and right, feet on the ground."""
    mesh = {**VEHICLES, **PEOPLE}[name](MeshMaterials(MaterialTable()))
    area = np.linalg.norm(np.cross(mesh.xyz[:, 1] - mesh.xyz[:, 0], mesh.xyz[:, 2] - mesh.xyz[:, 0]), axis=1)
    assert (area > 1e-7).mean() > 0.98
    low, high = mesh.xyz.reshape(-1, 3).min(0), mesh.xyz.reshape(-1, 3).max(0)
    assert low[2] == pytest.approx(0.0, abs=0.03)
    if name in VEHICLES:
        assert low[1] == pytest.approx(-high[1], abs=0.03)
        a, b, c = mesh.xyz.astype(np.float64).transpose(1, 0, 2)
        volume = (a * np.cross(b, c)).sum() / 6  # of closed parts that face outwards
        assert volume > 0.08 * np.prod(high - low) * (0.2 if high[1] < 0.6 else 1.0)
    else:
        assert 1.6 < high[2] < 1.85


def test_shapes_stay_in_their_boxes() -> None:
    library = make_shape_library(MaterialTable(), assets_of(AssetSet.MIXED))
    for category in SIZES:
        for style in range(4):
            state = actor(category, style, velocity_mps=np.array([1.2, 0.0, 0.0]))
            xyz = library.shape_of(state).mesh.transformed(unit_to_world(state)).xyz.reshape(-1, 3)
            half = 0.5 * state.size_lwh
            assert (np.abs(xyz - state.centre_m) <= half + 1e-4).all()
            if category is not Category.PEDESTRIAN:  # those fill it only in mid-stride
                np.testing.assert_allclose(np.ptp(xyz, axis=0), state.size_lwh, rtol=1e-3)


def test_legs_move_with_the_distance_walked() -> None:
    library = make_shape_library(MaterialTable(), assets_of(AssetSet.TRAIN))

    def pose(x_m: float) -> int:
        state = actor(
            Category.PEDESTRIAN,
            0,
            centre_m=np.array([x_m, 0.0, 0.9]),
            velocity_mps=np.array([1.4, 0.0, 0.0]),
        )
        return id(library.shape_of(state))

    poses = [pose(x_m) for x_m in np.arange(0.05, 1.4, 0.175)]
    assert len(set(poses)) == 8
    assert pose(1.45) == poses[0]


def test_a_held_out_world_shows_no_look_of_training(world02: World, town02: TownMap) -> None:
    other = World(town02, seed=3, assets=AssetSet.TEST)

    def seen(world: World, *surfaces: Surface) -> set[tuple[float, ...]]:
        materials = world._materials
        used = np.unique(world.static.mesh.material)
        patterned = np.isin(materials.texture[used], (Texture.FACADE, Texture.FOLIAGE, Texture.TILES))
        used = used[patterned & np.isin(materials.surface[used], surfaces)]
        kinds = np.where(materials.texture[used] == Texture.FACADE, materials.params[used, 8] + 1, 0)
        return {(k, *rgb) for k, rgb in zip(kinds.tolist(), materials.albedo[used].tolist(), strict=True)}

    for surface in (Surface.BUILDING, Surface.VEGETATION):
        assert len(seen(world02, surface)) > 3
        assert not seen(world02, surface) & seen(other, surface)
