"""Ray casting in a town: one tree for the static world, one tree over instances of the actors' shapes.

An actor's shape is built once, in its unit box. A ray is transformed into that box, where distances keep
their values. For a ray at another time than that of the scene, the actors have moved straight ahead.
"""

import weakref
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32

from foredrive.towns.place.mesh import Mesh
from foredrive.towns.sensing import embree
from foredrive.towns.sensing.shading import Hits

Rays = Float32[np.ndarray, "N 3"]
Times = Float32[np.ndarray, "N"]

LOOKAHEAD_S = 0.5
"""Maximum time between a ray and the actors' placement, s, before or after."""
_ALWAYS = np.zeros(0, np.float32)


class TriangleScene:
    """The search tree over one mesh."""

    def __init__(self, mesh: Mesh) -> None:
        padding = np.zeros((1, 3), np.float32)  # Embree reads past the last vertex
        self._xyz = np.concatenate([mesh.xyz.reshape(-1, 3), padding])
        self._faces = np.arange(len(self._xyz) - 1, dtype=np.uint32).reshape(-1, 3)
        self.handle = embree.new_triangles(self._xyz, self._faces)
        weakref.finalize(self, embree.release, self.handle)

    def cast(self, origin: Rays, direction: Rays) -> Hits:
        """Return the nearest hits. Directions need not have unit length; distances are multiples of them."""
        return _intersect([self.handle], origin, direction, None)

    def occluded(self, origin: Rays, direction: Rays) -> Bool[np.ndarray, "N"]:
        """Return whether rays hit anything."""
        return embree.occluded(_scenes([self.handle]), origin, direction, _ALWAYS)


class ShapeInstances:
    """A actors in the world, ready for ray casting.

    Args:
        scenes: the shape of each actor, in the unit box around the origin.
        T_world_unit: affine maps from the unit boxes to the world.
        velocity_mps: velocities along the world's axes, m/s.
    """

    def __init__(
        self,
        scenes: tuple[TriangleScene, ...],
        T_world_unit: Float[np.ndarray, "A 4 4"],
        velocity_mps: Float[np.ndarray, "A 3"],
    ) -> None:
        self._scenes = scenes  # kept alive
        self.T_world_unit = np.ascontiguousarray(T_world_unit[:, :3], dtype=np.float32)
        # Poses at both ends of the interval: actors move in a straight line
        steps = np.repeat(T_world_unit[:, None, :3].astype(np.float64), 2, axis=1)
        steps[..., 3] += np.array([[-LOOKAHEAD_S], [LOOKAHEAD_S]]) * velocity_mps[:, None]
        self.handle = embree.new_instances([scene.handle for scene in scenes], steps)
        weakref.finalize(self, embree.release, self.handle)


@dataclass(frozen=True)
class RaycastScene:
    """The static world and the actors in it."""

    static: TriangleScene
    placed: ShapeInstances

    def cast(self, origin: Rays, direction: Rays, dt_s: Times | None = None) -> Hits:
        """Return the nearest hits of unit rays.

        Args:
            dt_s: time of each ray relative to the time of the actors' placement, s, at most `LOOKAHEAD_S`
                away. None: all at that time.
        """
        return _intersect(self._handles, origin, direction, dt_s)

    def occluded(self, origin: Rays, direction: Rays, dt_s: Times | None = None) -> Bool[np.ndarray, "N"]:
        """Return whether unit rays hit anything. `dt_s` is as in `cast`."""
        return embree.occluded(_scenes(self._handles), origin, direction, _time(dt_s))

    @property
    def _handles(self) -> list[int]:
        return [self.static.handle, self.placed.handle]


def _intersect(handles: list[int], origin: Rays, direction: Rays, dt_s: Times | None) -> Hits:
    count = len(origin)
    t, u, v = (np.empty(count, np.float32) for _ in range(3))
    hits = Hits(t, np.empty(count, np.int32), np.empty(count, np.int32), u, v)
    embree.intersect(_scenes(handles), origin, direction, _time(dt_s), hits)
    return hits


def _scenes(handles: list[int]) -> embree.Scenes:
    return np.array(handles, dtype=np.uint64)


def _time(dt_s: Times | None) -> embree.Times:
    """Convert to Embree's time, from 0 to 1."""
    return _ALWAYS if dt_s is None else dt_s * np.float32(0.5 / LOOKAHEAD_S) + np.float32(0.5)
