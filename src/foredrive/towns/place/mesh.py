"""Triangle meshes and the primitives from which they are built.

Meshes are unconnected triangles with outward normals (counter-clockwise seen from outside). Solid objects are
closed, which distinguishes their inside from their outside.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float, Float32, Int32

Vector = Sequence[float | int]


@dataclass(frozen=True)
class Mesh:
    """F triangles."""

    xyz: Float32[np.ndarray, "F 3 3"]
    """Corners, m."""
    uvw: Float32[np.ndarray, "F 3 3"]
    """Texture coordinates of the corners. The material's texture defines their meaning."""
    material: Int32[np.ndarray, "F"]
    """Number in a `MaterialTable`."""

    def transformed(self, T: Float[np.ndarray, "4 4"]) -> "Mesh":
        """Return the mesh mapped by an affine transform that keeps orientation."""
        return Mesh((self.xyz @ T[:3, :3].T + T[:3, 3]).astype(np.float32), self.uvw, self.material)


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Join many meshes into one."""
    if not meshes:
        return triangles(np.zeros((0, 3, 3)), 0)
    return Mesh(
        np.concatenate([m.xyz for m in meshes]),
        np.concatenate([m.uvw for m in meshes]),
        np.concatenate([m.material for m in meshes]),
    )


def triangles(
    xyz: Float[np.ndarray, "F 3 3"], material: int, uvw: Float[np.ndarray, "F 3 3"] | None = None
) -> Mesh:
    """Build triangles of one material. Texture coordinates default to the positions of the corners."""
    xyz32 = np.ascontiguousarray(xyz, dtype=np.float32)
    uvw32 = xyz32 if uvw is None else np.ascontiguousarray(uvw, dtype=np.float32)
    return Mesh(xyz32, uvw32, np.full(len(xyz32), material, dtype=np.int32))


def quads(
    corners: Float[np.ndarray, "Q 4 3"], material: int, uvw: Float[np.ndarray, "Q 4 3"] | None = None
) -> Mesh:
    """Build quads of two triangles each, with corners counter-clockwise seen from outside."""
    # Triangles of a quad
    halves = np.array([[0, 1, 2], [0, 2, 3]])
    xyz = np.asarray(corners)[:, halves].reshape(-1, 3, 3)
    return triangles(xyz, material, None if uvw is None else np.asarray(uvw)[:, halves].reshape(-1, 3, 3))


def ribbon(
    left: Float[np.ndarray, "N 3"],
    right: Float[np.ndarray, "N 3"],
    material: int,
    uvw: tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]] | None = None,
) -> Mesh:
    """Build the band between two lines. It faces up if `left` lies to the left.

    `uvw` holds the texture coordinates of the left and the right line.
    """

    # Corners of each quad: counter-clockwise seen from above if `left` is left
    def corners(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.stack([b[:-1], b[1:], a[1:], a[:-1]], axis=1)

    return quads(corners(left, right), material, None if uvw is None else corners(*uvw))


def polygon_cap(polygon: shapely.Polygon, z: float, material: int, up: bool = True) -> Mesh:
    """Build a horizontal face with x, y as texture coordinates."""
    xy = polygon_triangles(polygon)
    xyz = np.concatenate([xy, np.full((*xy.shape[:2], 1), z)], axis=-1)
    return triangles(xyz if up else xyz[:, ::-1], material)


def polygon_triangles(polygon: shapely.Geometry) -> Float[np.ndarray, "F 3 2"]:
    """Return the constrained Delaunay triangulation of one or several polygons, counter-clockwise."""
    parts = shapely.get_parts(shapely.constrained_delaunay_triangles(polygon))
    if len(parts) == 0:
        return np.zeros((0, 3, 2))
    # Triangles come as closed rings of four points; turn those that run clockwise
    xy = shapely.get_coordinates(parts).reshape(-1, 4, 2)[:, :3]
    a, b = xy[:, 1] - xy[:, 0], xy[:, 2] - xy[:, 0]
    clockwise = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] < 0
    xy[clockwise] = xy[clockwise, ::-1]
    return xy


def walls(
    ring_xy: Float[np.ndarray, "N 2"],
    z0: Float[np.ndarray, "N"] | float,
    z1: Float[np.ndarray, "N"] | float,
    material: int,
) -> Mesh:
    """Build vertical faces over a line.

    Outside is on the right of the line, so the ring of a solid runs counter-clockwise. Texture coordinates
    are the distances from the start of each face, above its lower edge and from its end, m.
    """
    a, b = ring_xy[:-1], ring_xy[1:]
    low, high = np.broadcast_to(z0, len(ring_xy)), np.broadcast_to(z1, len(ring_xy))
    corners = np.stack(
        [
            np.column_stack([a, low[:-1]]),
            np.column_stack([b, low[1:]]),
            np.column_stack([b, high[1:]]),
            np.column_stack([a, high[:-1]]),
        ],
        axis=1,
    )
    length = np.linalg.norm(b - a, axis=1)
    # Texture: distance from the start, above the lower edge, from the end of each face
    zero, height = np.zeros_like(length), (high - low)[:-1]
    u = np.stack([zero, length, length, zero], axis=1)
    v = np.stack([zero, zero, height, height], axis=1)
    return quads(corners, material, np.stack([u, v, length[:, None] - u], axis=-1))


def prism(polygon: shapely.Polygon, z0: float, z1: float, side_material: int, top_material: int) -> Mesh:
    """Build an extruded polygon without holes."""
    ring = shapely.get_coordinates(shapely.orient_polygons(polygon).exterior)
    top, bottom = polygon_cap(polygon, z1, top_material), polygon_cap(polygon, z0, side_material, up=False)
    return join([walls(ring, z0, z1, side_material), top, bottom])


def box(lower: Vector, upper: Vector, material: int) -> Mesh:
    """Build an axis-aligned box."""
    (x0, y0, z0), (x1, y1, z1) = lower, upper
    return hexahedron(
        [[x0, y0, z0], [x1, y0, z0], [x1, y1, z0], [x0, y1, z0]],
        [[x0, y0, z1], [x1, y0, z1], [x1, y1, z1], [x0, y1, z1]],
        [material] * 6,
    )


def boxes(lower: Float[np.ndarray, "B 3"], upper: Float[np.ndarray, "B 3"], material: int) -> Mesh:
    """Build many axis-aligned boxes."""
    ends = np.stack([lower, upper])
    # Corner order of `_HEX_FACES`: bottom ring, then top ring, counter-clockwise
    which = np.array([[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))])
    corners = ends[which, :, np.arange(3)].transpose(2, 0, 1)
    return quads(corners[:, np.array(_HEX_FACES)].reshape(-1, 4, 3), material)


_HEX_FACES = ((3, 2, 1, 0), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))


def hexahedron(bottom: Sequence[Vector], top: Sequence[Vector], materials: Sequence[int]) -> Mesh:
    """Build a solid between two quads, each counter-clockwise seen from above.

    Args:
        materials: materials of the bottom, the top, then the sides from corner 0–1 on.
    """
    mesh = quads(np.array([*bottom, *top], dtype=float)[np.array(_HEX_FACES)], 0)
    return Mesh(mesh.xyz, mesh.uvw, np.repeat(np.array(materials, dtype=np.int32), 2))


def frustum(bottom: Vector, top: Vector, radii: tuple[float, float], sides: int, material: int) -> Mesh:
    """Build a closed cone frustum between two points. A top radius of 0 gives a cone."""
    base, tip = np.asarray(bottom, dtype=float), np.asarray(top, dtype=float)
    axis = (tip - base) / np.linalg.norm(tip - base)
    # Any vector that is not parallel to the axis gives a perpendicular one
    helper = np.array([1.0, 0.0, 0.0]) if abs(axis[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    across = np.cross(axis, helper)
    across /= np.linalg.norm(across)
    angle = np.arange(sides + 1) * (2 * np.pi / sides)
    circle = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(axis, across)
    # Rings at both ends; the first point is repeated at the end
    low, high = base + radii[0] * circle, tip + radii[1] * circle
    ends = np.broadcast_to(base, (sides, 3)), np.broadcast_to(tip, (sides, 3))
    # Two triangles per side, and a fan for either end, all facing outwards
    faces = [
        (low[:-1], low[1:], high[1:]),
        (low[:-1], high[1:], high[:-1]),
        (ends[0], low[1:], low[:-1]),
        (ends[1], high[:-1], high[1:]),
    ]
    return triangles(np.concatenate([np.stack(corners, axis=1) for corners in faces]), material)
