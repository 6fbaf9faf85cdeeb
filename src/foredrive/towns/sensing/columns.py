"""Solid matter above each spot of a town as vertical intervals, from which exact occupancy is computed."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from foredrive.towns.place.materials import Surface
from foredrive.towns.place.mesh import Mesh
from foredrive.towns.place.props import ThinPoints
from foredrive.towns.sensing.raycast import TriangleScene
from foredrive.towns.sensing.shading import MISS

TILE_M = 32.0
COLUMN_M = 0.25
EDGE_SPLIT = 4
"""Number of columns along x and y into which a column on the edge of a solid object is split."""
EDGE_M = 0.4
WALL_SPACING_M = 0.2
UPRIGHT = 0.3
"""Maximum vertical component of a wall's unit normal."""
MAX_LAYERS = 40
STEP_M = 2e-3
DECK_DEPTH_M = 1.5
"""Maximum depth below a road, m, at which an underside belongs to the road's deck."""

_GROUND = (Surface.ROAD, Surface.SIDEWALK, Surface.TERRAIN)
_IGNORED = (Surface.HIDDEN, Surface.VEHICLE, Surface.PEDESTRIAN)
"""Surfaces that rays pass. Parked cars are handled like road users."""


class Intervals(NamedTuple):
    """N vertical intervals of matter. Surfaces without depth have low = high."""

    x: Float32[np.ndarray, "N"]
    y: Float32[np.ndarray, "N"]
    low: Float32[np.ndarray, "N"]
    high: Float32[np.ndarray, "N"]
    surface: Int[np.ndarray, "N"]


@dataclass
class TownColumns:
    """Columns of a town in square tiles. Each tile is computed when it is first requested, and kept."""

    scene: TriangleScene
    faces: "Faces"
    top_m: float
    """Height above everything, m."""
    extra: Intervals
    """Intervals of matter that rays from above miss: upright faces, and objects thinner than a column."""
    _tiles: dict[tuple[int, int], Intervals] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # Sort the extra intervals by tile once; each tile has its slice
        key = np.floor(np.stack([self.extra.x, self.extra.y], axis=1) / TILE_M).astype(int)
        order = np.lexsort(key.T)
        starts = np.flatnonzero(np.diff(key[order], axis=0, prepend=key[order][:1] - 1).any(axis=1))
        rows = np.split(order, starts[1:])
        self._extra = {(int(key[r[0], 0]), int(key[r[0], 1])): r for r in rows if len(r)}

    def tiles_around(self, xy: Float[np.ndarray, "P 2"], yaw: float) -> list[Intervals]:
        """Return all tiles that overlap the rectangle around some points, whose sides have the angle `yaw` to
        world x."""
        cos, sin = np.cos(yaw), np.sin(yaw)
        # Separating axes: world axes and the rectangle's own
        axes = np.array([[1.0, 0.0], [0.0, 1.0], [cos, sin], [-sin, cos]])
        low, high = (xy @ axes.T).min(axis=0), (xy @ axes.T).max(axis=0)
        (i0, j0), (i1, j1) = (np.floor(end[:2] / TILE_M).astype(int) for end in (low, high))
        keys = np.stack(np.meshgrid(np.arange(i0, i1 + 1), np.arange(j0, j1 + 1)), axis=-1).reshape(-1, 2)
        # Projections of the tiles onto the axes: centre and half extent
        middle, reach = (keys + 0.5) * TILE_M @ axes.T, 0.5 * TILE_M * np.abs(axes).sum(axis=1)
        meets = ((middle + reach >= low) & (middle - reach <= high)).all(axis=1)
        return [self._kept_tile(i, j) for i, j in keys[meets].tolist()]

    def _kept_tile(self, i: int, j: int) -> Intervals:
        if (i, j) not in self._tiles:
            self._tiles[i, j] = self._tile(i, j)
        return self._tiles[i, j]

    def _tile(self, i: int, j: int) -> Intervals:
        count = round(TILE_M / COLUMN_M)
        # One column at the middle of each cell
        offsets = (np.arange(count) + 0.5) * COLUMN_M
        y, x = (a.ravel() for a in np.meshgrid(j * TILE_M + offsets, i * TILE_M + offsets, indexing="ij"))
        coarse, ray = cast_columns(self.scene, self.faces, x, y, self.top_m)
        # Height of solid matter in each column, from which edges are found
        solid = coarse.high > coarse.low
        height = np.zeros(len(x))
        np.maximum.at(height, ray[solid], (coarse.high - coarse.low)[solid])
        edge = _edges(height.reshape(count, count)).ravel()
        # Columns on edges are split, so that the outline of objects is sharper than a cell
        fine = (np.arange(EDGE_SPLIT) + 0.5) / EDGE_SPLIT * COLUMN_M - 0.5 * COLUMN_M
        dy, dx = (a.ravel() for a in np.meshgrid(fine, fine, indexing="ij"))
        fine_x, fine_y = (x[edge][:, None] + dx).ravel(), (y[edge][:, None] + dy).ravel()
        refined, _ = cast_columns(self.scene, self.faces, fine_x, fine_y, self.top_m)
        rows = self._extra.get((i, j), np.zeros(0, dtype=int))
        return _join([coarse, refined, Intervals(*(column[rows] for column in self.extra))])


def make_columns(
    mesh: Mesh, scene: TriangleScene, material_surface: Int[np.ndarray, "L"], thin: ThinPoints
) -> TownColumns:
    """Prepare the columns of all static objects of a town.

    Args:
        mesh: the triangles of the town.
        scene: the same mesh for ray casting.
        material_surface: the `Surface` of each material.
        thin: points on objects that the columns would miss.
    """
    faces = faces_of(mesh, material_surface)
    x, y, z = thin.xyz.T.astype(np.float32)
    extra = _join([wall_intervals(mesh, faces), Intervals(x, y, z, z, thin.surface)])
    return TownColumns(scene, faces, float(mesh.xyz[..., 2].max()) + 1.0, extra)


def _join(parts: Sequence[Intervals]) -> Intervals:
    x, y, low, high, surface = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return Intervals(x, y, low, high, surface.astype(np.int8))


@dataclass(frozen=True)
class Faces:
    """Properties of the triangles of a mesh that columns need."""

    upward: Bool[np.ndarray, "F"]
    surface: Int[np.ndarray, "F"]


def faces_of(mesh: Mesh, material_surface: Int[np.ndarray, "L"]) -> Faces:
    """Return the orientation and the surface of each triangle."""
    a, b = mesh.xyz[:, 1] - mesh.xyz[:, 0], mesh.xyz[:, 2] - mesh.xyz[:, 0]
    # A triangle points up if it is counter-clockwise seen from above
    upward = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] > 0
    return Faces(upward, material_surface[mesh.material])


def cast_columns(
    scene: TriangleScene,
    faces: Faces,
    x: Float[np.ndarray, "C"],
    y: Float[np.ndarray, "C"],
    top_m: float,
) -> tuple[Intervals, Int[np.ndarray, "N"]]:
    """Return the matter below `top_m` at each x, y, and the index of the column of each interval.

    A ray straight down enters a closed mesh through a face that points up and leaves it through a face that
    points down. The ground is a surface without depth. It also ends any object that reaches into it.
    """
    count = len(x)
    origin = np.column_stack([x, y, np.full(count, top_m)]).astype(np.float32)
    ray = np.arange(count)
    # State of each ray: number of solids that it is in, where the outermost began, and as what
    depth, opened, opened_as = np.zeros(count, int), np.zeros(count, np.float32), np.zeros(count, int)
    last_ground, last_solid = np.full(count, np.inf, np.float32), np.zeros(count, np.float32)
    columns: list[tuple[np.ndarray, ...]] = []

    def emit(rays: np.ndarray, low: np.ndarray, high: np.ndarray, surface: np.ndarray) -> None:
        columns.append((rays, low, high, surface))

    # All rays advance together from layer to layer
    for _ in range(MAX_LAYERS):
        down = np.broadcast_to(np.array([0, 0, -1], np.float32), (len(ray), 3))
        hits = scene.cast(origin[ray], np.ascontiguousarray(down))
        on = hits.triangle != MISS
        # Rays that leave the town inside of something that is not closed: keep its upper side
        ended = ray[~on]
        emit(ended[depth[ended] > 0], *(a[ended[depth[ended] > 0]] for a in (opened, opened, opened_as)))
        ray, triangle, z = ray[on], hits.triangle[on], origin[ray[on], 2] - hits.t[on]
        if len(ray) == 0:
            break
        # Sort the hits: ground, entry into matter, exit from matter; the rest is passed
        surface, upward = faces.surface[triangle], faces.upward[triangle]
        ground = np.isin(surface, _GROUND)
        solid = ~ground & ~np.isin(surface, _IGNORED)
        enters, leaves = solid & upward, solid & ~upward
        # An interval ends at the ground, or where the ray leaves the last solid that it is in
        closing = (ground & (depth[ray] > 0)) | (leaves & (depth[ray] == 1))
        # A ray that grazed the rim of a crown has a wrong count: leaves do not reach the ground.
        leafy = ground & (opened_as[ray] == Surface.VEGETATION)
        end = np.where(leafy, last_solid[ray], z)
        emit(ray[closing], end[closing], opened[ray[closing]], opened_as[ray[closing]])
        emit(ray[ground], z[ground], z[ground], surface[ground])
        # An underside without an entry belongs to a bridge's deck, if a road lies close above
        below = leaves & (depth[ray] == 0)
        deck = np.where(last_ground[ray] - z < DECK_DEPTH_M, last_ground[ray], z)
        emit(ray[below], z[below], deck[below], surface[below])
        # An interval begins where the ray enters matter from outside
        opening = enters & (depth[ray] == 0)
        opened[ray[opening]], opened_as[ray[opening]] = z[opening], surface[opening]
        # The ground resets the count: nothing reaches through it
        depth[ray] = np.where(ground, 0, depth[ray] + enters - (leaves & (depth[ray] > 0)))
        last_ground[ray] = np.where(ground, z, last_ground[ray])
        last_solid[ray] = np.where(solid, z, last_solid[ray])
        # Continue just below the hit
        origin[ray, 2] = z - STEP_M
    rays, low, high, surface = (np.concatenate(parts) for parts in zip(*columns, strict=True))
    return Intervals(origin[rays, 0], origin[rays, 1], low, high, surface), rays


def wall_intervals(mesh: Mesh, faces: Faces) -> Intervals:
    """Return the upright faces of buildings and structures as vertical intervals WALL_SPACING_M apart."""
    built = np.isin(faces.surface, (Surface.BUILDING, Surface.STRUCTURE))
    # Upright faces of buildings: rays from above miss them
    normal = np.cross(mesh.xyz[:, 1] - mesh.xyz[:, 0], mesh.xyz[:, 2] - mesh.xyz[:, 0])
    upright = np.abs(normal[:, 2]) < UPRIGHT * np.linalg.norm(normal, axis=1)
    corner = mesh.xyz[built & upright].astype(np.float64)
    # Horizontal direction within each face; corners sorted along it
    ahead = np.cross(normal[built & upright], [0.0, 0.0, 1.0])
    along = np.einsum("fka,fa->fk", corner, ahead / np.linalg.norm(ahead, axis=1, keepdims=True).clip(1e-9))
    corner = np.take_along_axis(corner, np.argsort(along, axis=1)[..., None], axis=1)
    a, b, c = np.sort(along, axis=1).T
    # Vertical lines across each triangle, evenly between its first and last corner
    count = np.ceil((c - a) / WALL_SPACING_M).astype(int) + 1
    face = np.repeat(np.arange(len(count)), count)
    step = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    share = step / np.maximum(count - 1, 1)[face]  # along the longest side, from the first corner
    s = a[face] + share * (c - a)[face]
    # The longest side runs from the first to the last corner; the other side bends at the middle one
    side = corner[face, 0] + share[:, None] * (corner[face, 2] - corner[face, 0])
    first = s <= b[face]
    start, end = np.where(first, a[face], b[face]), np.where(first, b[face], c[face])
    t = (s - start) / np.maximum(end - start, 1e-9)
    z0 = np.where(first, corner[face, 0, 2], corner[face, 1, 2])
    z1 = np.where(first, corner[face, 1, 2], corner[face, 2, 2])
    other = z0 + t * (z1 - z0)
    low, high = np.minimum(side[:, 2], other), np.maximum(side[:, 2], other)
    surface = faces.surface[built & upright][face]
    x, y, low, high = (v.astype(np.float32) for v in (side[:, 0], side[:, 1], low, high))
    return Intervals(x, y, low, high, surface)


def _edges(height: Float[np.ndarray, "Y X"]) -> Bool[np.ndarray, "Y X"]:
    """Return whether the height at each place differs from that of a neighbour by more than EDGE_M."""
    edge = np.zeros(height.shape, dtype=bool)
    # A cell is on an edge if the step to either neighbour is large
    for axis in (0, 1):
        step = np.abs(np.diff(height, axis=axis)) > EDGE_M
        edge |= np.concatenate([step, np.take(step, [-1], axis) & False], axis)
        edge |= np.concatenate([np.take(step, [0], axis) & False, step], axis)
    return edge
