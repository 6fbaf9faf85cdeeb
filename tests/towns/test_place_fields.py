"""Farmland: where fields lie, and what the land's mesh makes of them."""

import numpy as np
import pytest
import shapely
from scenes import straight

from foredrive.towns.map.ground_plan import make_ground_plan
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.place.fields import HEDGE_M, ROAD_SETBACK_M, build_on_fields, lay_out_fields
from foredrive.towns.place.materials import MaterialTable, Surface, Texture
from foredrive.towns.place.site import Site
from foredrive.towns.place.terrain import build_terrain, make_terrain


@pytest.fixture(scope="module")
def site() -> Site:
    town = TownMap("Town07", (), (straight("1", (-40, 0, 0), (40, 0, 0)),), (), (), {})
    plan = make_ground_plan(town)
    return Site(plan, make_terrain(plan, town.bounds_m, np.random.default_rng(0)))


def test_fields_keep_off_roads_and_what_stands_and_each_other(site: Site) -> None:
    barn = shapely.box(20.0, 30.0, 35.0, 40.0)
    site.take(barn)
    table = MaterialTable()
    fields = lay_out_fields(site, table, np.random.default_rng(1))
    assert len(fields) > 2
    areas = [field.area for field in fields]
    assert min(area.distance(site.plan.ground) for area in areas) > ROAD_SETBACK_M - 1.5
    assert min(area.distance(barn) for area in areas) > 3.0
    pairs = [a.distance(b) for k, a in enumerate(areas) for b in areas[:k]]
    assert min(pairs) > 2.0 * HEDGE_M - 1.1
    assert not any(site.is_free(area) for area in areas)

    plain, tilled = (build_terrain(site.terrain, site.plan, table, some) for some in ((), fields))
    assert len(plain.material) == len(tilled.material)
    crop = np.isin(tilled.material, [n for n, x in enumerate(table.materials) if x.texture is Texture.FIELD])
    inside = tilled.uvw[crop][..., 2] > 0.0
    points = shapely.points(tilled.xyz[crop][inside][:, :2].astype(np.float64))
    sown = shapely.union_all([field.area for field in fields if field.material is not None])
    assert (shapely.distance(sown, points) < 1e-3).all()

    mesh, thin = build_on_fields(fields, site, table, np.random.default_rng(2))
    stands = shapely.points(mesh.xyz.mean(1)[:, :2].astype(np.float64))
    assert (shapely.distance(shapely.union_all(areas), stands) < 0.2).all()
    assert set(thin.surface) <= {int(Surface.STRUCTURE)}
