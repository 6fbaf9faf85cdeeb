"""Rays against a town: Embree for the static world and, in its own frame, for each actor's shape.

embreex has no instances. An actor is one all the same: rays that pass its bounding sphere are taken into the
unit box in which its shape has been built once and for all, where their distances stay what they are.
"""

from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Bool, Float, Float32

from foredrive.towns.place.mesh import Mesh
from foredrive.towns.sensing.shading import MISS, Hits

Rays = Float32[np.ndarray, "N 3"]


class TriangleScene:
    """An Embree scene of one mesh."""

    def __init__(self, mesh: Mesh) -> None:
        self._scene = EmbreeScene(robust=True)  # no leaks along shared edges
        self._mesh = TriangleMesh(self._scene, np.ascontiguousarray(mesh.xyz))
        up = np.array([[0.0, 0.0, 1.0]], dtype=np.float32)
        self._scene.run(up, up)  # builds the tree, which is not safe to do from several threads

    def cast(self, origin: Rays, direction: Rays) -> Hits:
        """Nearest hits; directions need not have unit length, distances are multiples of them."""
        found = self._scene.run(origin, direction, output=True)
        actor = np.full(len(origin), -1, dtype=np.int32)
        return Hits(found["tfar"], found["primID"], actor, found["u"], found["v"])

    def occluded(self, origin: Rays, direction: Rays) -> Bool[np.ndarray, "N"]:
        """Whether rays hit anything."""
        return self._scene.run(origin, direction, query="OCCLUDED") >= 0


@dataclass(frozen=True)
class PlacedShapes:
    """A actors in the world, ready to be met by rays."""

    scenes: tuple[TriangleScene, ...]
    """The shape of each actor, in the unit box about the origin."""
    T_world_unit: Float32[np.ndarray, "A 3 4"]
    T_unit_world: Float32[np.ndarray, "A 3 4"]
    radius_m: Float32[np.ndarray, "A"]
    """Of the bounding sphere about the box centre."""


def place(scenes: tuple[TriangleScene, ...], T_world_unit: Float[np.ndarray, "A 4 4"]) -> PlacedShapes:
    """Place shapes by the affine maps from their unit boxes to the world."""
    half_diagonal = 0.5 * np.linalg.norm(np.linalg.norm(T_world_unit[:, :3, :3], axis=1), axis=-1)
    return PlacedShapes(
        scenes,
        np.ascontiguousarray(T_world_unit[:, :3], dtype=np.float32),
        np.ascontiguousarray(np.linalg.inv(T_world_unit)[:, :3], dtype=np.float32),
        half_diagonal.astype(np.float32),
    )


def cast(static: TriangleScene, placed: PlacedShapes, origin: Rays, direction: Rays) -> Hits:
    """Nearest hits of unit rays with the static world and the actors."""
    hits = static.cast(origin, direction)
    passing = _passing(placed, origin, direction, hits.t)
    for a, scene in enumerate(placed.scenes):
        rays = np.flatnonzero(passing[a])
        if len(rays) == 0:
            continue
        near = scene.cast(*_to_unit(placed.T_unit_world[a], origin[rays], direction[rays]))
        closer = (near.triangle != MISS) & (near.t < hits.t[rays])
        won = rays[closer]
        hits.t[won], hits.triangle[won], hits.actor[won] = near.t[closer], near.triangle[closer], a
        hits.u[won], hits.v[won] = near.u[closer], near.v[closer]
    return hits


def occluded(
    static: TriangleScene, placed: PlacedShapes, origin: Rays, direction: Rays
) -> Bool[np.ndarray, "N"]:
    """Whether unit rays hit the static world or an actor."""
    blocked = static.occluded(origin, direction)
    far = np.where(blocked, 0.0, np.inf).astype(np.float32)
    passing = _passing(placed, origin, direction, far)
    for a, scene in enumerate(placed.scenes):
        rays = np.flatnonzero(passing[a])
        if len(rays):
            unit = _to_unit(placed.T_unit_world[a], origin[rays], direction[rays])
            blocked[rays] |= scene.occluded(*unit)
    return blocked


def _to_unit(T: Float32[np.ndarray, "3 4"], origin: Rays, direction: Rays) -> tuple[Rays, Rays]:
    rotation = np.ascontiguousarray(T[:, :3].T)
    return origin @ rotation + T[:, 3], direction @ rotation


def _passing(
    placed: PlacedShapes, origin: Rays, direction: Rays, far: Float32[np.ndarray, "N"]
) -> Bool[np.ndarray, "A N"]:
    """Which rays pass the bounding sphere of each actor before they end."""
    out = np.empty((len(placed.scenes), len(origin)), np.bool_)
    rows = np.ascontiguousarray(np.concatenate([origin, direction], axis=1).T)  # rays side by side, for SIMD
    _pass_spheres(placed.T_world_unit, placed.radius_m, rows, far, out)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
@no_type_check
def _pass_spheres(T_world_unit, radius_m, rows, far, out):
    ox, oy, oz, dx, dy, dz = rows[0], rows[1], rows[2], rows[3], rows[4], rows[5]
    for a in range(len(radius_m)):
        x, y, z, r = T_world_unit[a, 0, 3], T_world_unit[a, 1, 3], T_world_unit[a, 2, 3], radius_m[a]
        passes = out[a]
        for i in range(len(far)):
            cx, cy, cz = x - ox[i], y - oy[i], z - oz[i]
            along = cx * dx[i] + cy * dy[i] + cz * dz[i]
            aside = cx * cx + cy * cy + cz * cz - along * along
            passes[i] = (aside < r * r) & (along > -r) & (along - r < far[i])
