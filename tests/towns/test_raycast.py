"""Packets of rays against embreex, which casts them one by one."""

import runpy
import sys

import numpy as np
import pytest
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from foredrive.errors import InputError
from foredrive.towns.place.mesh import Mesh, triangles
from foredrive.towns.sensing import embree
from foredrive.towns.sensing.embree import check_release
from foredrive.towns.sensing.raycast import RaycastScene, ShapeInstances, TriangleScene
from foredrive.towns.sensing.shading import MISS

RAYS = 1003
"""No multiple of a packet's width."""


def some_mesh(rng: np.random.Generator, count: int, size_m: float) -> Mesh:
    middle = rng.uniform(-size_m, size_m, (count, 1, 3))
    return triangles(middle + rng.normal(0.0, 0.25 * size_m, (count, 3, 3)), 0)


def some_rays(rng: np.random.Generator, size_m: float) -> tuple[np.ndarray, np.ndarray]:
    origin = rng.uniform(-2.0 * size_m, 2.0 * size_m, (RAYS, 3)).astype(np.float32)
    direction = rng.uniform(-0.7 * size_m, 0.7 * size_m, (RAYS, 3)) - origin
    return origin, (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)


def one_by_one(xyz: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Distances to triangles [F 3 3], infinite where nothing is hit."""
    scene = EmbreeScene(robust=True)
    mesh = TriangleMesh(scene, np.ascontiguousarray(xyz, dtype=np.float32))
    found = scene.run(origin, direction, output=True)
    del mesh
    return np.where(found["primID"] == MISS, np.inf, found["tfar"])


def test_packets_meet_what_single_rays_meet() -> None:
    rng = np.random.default_rng(0)
    mesh = some_mesh(rng, 60, 5.0)
    origin, direction = some_rays(rng, 5.0)
    hits = TriangleScene(mesh).cast(origin, direction)
    expected = one_by_one(mesh.xyz, origin, direction)
    assert 0.1 < np.isfinite(expected).mean() < 0.9
    np.testing.assert_allclose(hits.t, expected, rtol=1e-4)
    np.testing.assert_array_equal(TriangleScene(mesh).occluded(origin, direction), np.isfinite(expected))
    hit = np.flatnonzero(hits.triangle != MISS)
    a, b, c = np.moveaxis(mesh.xyz[hits.triangle[hit]], 1, 0)
    u, v = hits.u[hit, None], hits.v[hit, None]
    on_triangle = a + u * (b - a) + v * (c - a)
    np.testing.assert_allclose(on_triangle, origin[hit] + hits.t[hit, None] * direction[hit], atol=2e-3)


def test_actors_are_met_where_they_are_when_a_ray_looks() -> None:
    """Affine maps, two actors of one shape, one of which moves."""
    rng = np.random.default_rng(1)
    ground, shape = some_mesh(rng, 20, 6.0), some_mesh(rng, 12, 0.5)
    maps = np.tile(np.eye(4), (2, 1, 1))
    maps[0, :3, :3] = rng.normal(0.0, 2.0, (3, 3))
    maps[1, :3, :3] = np.diag([4.0, 2.0, 1.5])
    maps[:, :3, 3] = [[3.0, 1.0, 0.0], [-3.0, 0.0, 1.0]]
    velocity_mps = np.array([[0.0, 0.0, 0.0], [12.0, -5.0, 0.0]])
    scene = TriangleScene(shape)
    world = RaycastScene(TriangleScene(ground), ShapeInstances((scene, scene), maps, velocity_mps))
    origin, direction = some_rays(rng, 6.0)
    dt_s = rng.choice(np.array([-0.1, 0.0, 0.04], np.float32), RAYS)
    hits, blocked = world.cast(origin, direction, dt_s), world.occluded(origin, direction, dt_s)
    owners = set()
    for when in np.unique(dt_s):
        rows = np.flatnonzero(dt_s == when)
        moved = [
            shape.xyz @ m[:3, :3].T + m[:3, 3] + when * v for m, v in zip(maps, velocity_mps, strict=True)
        ]
        parts = [one_by_one(xyz, origin[rows], direction[rows]) for xyz in (ground.xyz, *moved)]
        np.testing.assert_allclose(hits.t[rows], np.min(parts, axis=0), rtol=2e-4)
        met = np.isfinite(np.min(parts, axis=0))
        np.testing.assert_array_equal(blocked[rows], met)
        np.testing.assert_array_equal(hits.actor[rows][met], np.argmin(parts, axis=0)[met] - 1)
        owners |= set(hits.actor[rows][met].tolist())
    assert owners == {-1, 0, 1}


def test_nobody_there() -> None:
    scene = TriangleScene(triangles(np.array([[[5.0, -1, -1], [5.0, 1, -1], [5.0, 0, 2]]]), 0))
    world = RaycastScene(scene, ShapeInstances((), np.zeros((0, 4, 4)), np.zeros((0, 3))))
    ahead, away = np.array([[1.0, 0, 0]], np.float32), np.array([[-1.0, 0, 0]], np.float32)
    start = np.zeros((1, 3), np.float32)
    assert world.cast(start, ahead).t[0] == pytest.approx(5.0)
    assert world.cast(start, away).triangle[0] == MISS
    assert np.isinf(world.cast(start, away).t[0])


def test_a_machine_without_embreex_gets_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "embreex", None)
    with pytest.raises(InputError, match=r"^towns cast rays with embreex, which is not installed"):
        runpy.run_path(embree.__file__)


def test_an_embree_with_other_structs_is_refused() -> None:
    check_release(40400)
    check_release(40403)
    for version, told in ((40399, r"4\.3\.99"), (40500, r"4\.5\.0"), (50400, r"5\.4\.0")):
        with pytest.raises(InputError, match=told):
            check_release(version)
