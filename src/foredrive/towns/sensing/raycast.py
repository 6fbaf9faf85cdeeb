"""Rays against a town: Embree for the static world and, in its own frame, for each actor's shape.

embreex has no instances. An actor is one all the same: rays that pass its bounding sphere are taken into the
unit box in which its shape has been built once and for all, where their distances stay what they are. A ray
that looks at another time than that of the scene meets an actor that moves on straight ahead: it is taken to
start as much further back.
"""

from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Bool, Float, Float32, Int

from foredrive.towns.place.mesh import Mesh
from foredrive.towns.sensing.shading import MISS, Hits

Rays = Float32[np.ndarray, "N 3"]
Times = Float32[np.ndarray, "N"]


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
    velocity_mps: Float32[np.ndarray, "A 3"]
    """Along the world's axes."""


def place(
    scenes: tuple[TriangleScene, ...],
    T_world_unit: Float[np.ndarray, "A 4 4"],
    velocity_mps: Float[np.ndarray, "A 3"],
) -> PlacedShapes:
    """Place shapes by the affine maps from their unit boxes to the world."""
    half_diagonal = 0.5 * np.linalg.norm(np.linalg.norm(T_world_unit[:, :3, :3], axis=1), axis=-1)
    return PlacedShapes(
        scenes,
        np.ascontiguousarray(T_world_unit[:, :3], dtype=np.float32),
        np.ascontiguousarray(np.linalg.inv(T_world_unit)[:, :3], dtype=np.float32),
        half_diagonal.astype(np.float32),
        velocity_mps.astype(np.float32),
    )


def cast(
    static: TriangleScene, placed: PlacedShapes, origin: Rays, direction: Rays, dt_s: Times | None = None
) -> Hits:
    """Nearest hits of unit rays with the static world and the actors.

    Args:
        dt_s: when each ray looks, relative to the time at which the actors are where they were placed; None:
            all at that time.
    """
    hits = static.cast(origin, direction)
    passing = _passing(placed, origin, direction, hits.t, dt_s)
    for a, scene in enumerate(placed.scenes):
        rays = np.flatnonzero(passing[a])
        if len(rays) == 0:
            continue
        start = _start(placed.velocity_mps[a], origin, rays, dt_s)
        near = scene.cast(*_to_unit(placed.T_unit_world[a], start, direction[rays]))
        closer = (near.triangle != MISS) & (near.t < hits.t[rays])
        won = rays[closer]
        hits.t[won], hits.triangle[won], hits.actor[won] = near.t[closer], near.triangle[closer], a
        hits.u[won], hits.v[won] = near.u[closer], near.v[closer]
    return hits


def occluded(
    static: TriangleScene, placed: PlacedShapes, origin: Rays, direction: Rays, dt_s: Times | None = None
) -> Bool[np.ndarray, "N"]:
    """Whether unit rays hit the static world or an actor; `dt_s` as in `cast`."""
    blocked = static.occluded(origin, direction)
    far = np.where(blocked, 0.0, np.inf).astype(np.float32)
    passing = _passing(placed, origin, direction, far, dt_s)
    for a, scene in enumerate(placed.scenes):
        rays = np.flatnonzero(passing[a])
        if len(rays):
            start = _start(placed.velocity_mps[a], origin, rays, dt_s)
            unit = _to_unit(placed.T_unit_world[a], start, direction[rays])
            blocked[rays] |= scene.occluded(*unit)
    return blocked


def _start(
    velocity_mps: Float32[np.ndarray, "3"], origin: Rays, rays: Int[np.ndarray, "n"], dt_s: Times | None
) -> Float32[np.ndarray, "n 3"]:
    """Where rays start, seen from an actor that stands where it was placed."""
    return origin[rays] if dt_s is None else origin[rays] - dt_s[rays, None] * velocity_mps


def _to_unit(T: Float32[np.ndarray, "3 4"], origin: Rays, direction: Rays) -> tuple[Rays, Rays]:
    rotation = np.ascontiguousarray(T[:, :3].T)
    return origin @ rotation + T[:, 3], direction @ rotation


def _passing(
    placed: PlacedShapes,
    origin: Rays,
    direction: Rays,
    far: Float32[np.ndarray, "N"],
    dt_s: Times | None,
) -> Bool[np.ndarray, "A N"]:
    """Which rays pass the bounding sphere of each actor before they end."""
    out = np.empty((len(placed.scenes), len(origin)), np.bool_)
    rows = np.ascontiguousarray(np.concatenate([origin, direction], axis=1).T)  # rays side by side, for SIMD
    times = np.zeros(0, np.float32) if dt_s is None else dt_s
    _pass_spheres(placed.T_world_unit, placed.radius_m, placed.velocity_mps, rows, times, far, out)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
@no_type_check
def _pass_spheres(T_world_unit, radius_m, velocity_mps, rows, dt_s, far, out):
    ox, oy, oz, dx, dy, dz = rows[0], rows[1], rows[2], rows[3], rows[4], rows[5]
    for a in range(len(radius_m)):
        x, y, z, r = T_world_unit[a, 0, 3], T_world_unit[a, 1, 3], T_world_unit[a, 2, 3], radius_m[a]
        vx, vy, vz = velocity_mps[a, 0], velocity_mps[a, 1], velocity_mps[a, 2]
        passes = out[a]
        if len(dt_s) == 0 or vx * vx + vy * vy + vz * vz == 0.0:
            for i in range(len(far)):
                cx, cy, cz = x - ox[i], y - oy[i], z - oz[i]
                along = cx * dx[i] + cy * dy[i] + cz * dz[i]
                aside = cx * cx + cy * cy + cz * cz - along * along
                passes[i] = (aside < r * r) & (along > -r) & (along - r < far[i])
        else:
            for i in range(len(far)):
                cx, cy, cz = x + vx * dt_s[i] - ox[i], y + vy * dt_s[i] - oy[i], z + vz * dt_s[i] - oz[i]
                along = cx * dx[i] + cy * dy[i] + cz * dz[i]
                aside = cx * cx + cy * cy + cz * cz - along * along
                passes[i] = (aside < r * r) & (along > -r) & (along - r < far[i])
