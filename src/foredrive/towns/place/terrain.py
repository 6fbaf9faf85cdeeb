"""The land between and around the roads: a height field that meets every road at its edge."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

from foredrive.towns.map.ground_plan import GroundPlan
from foredrive.towns.place.materials import ASPHALT_RGB, GRASS_RGB, Material, MaterialTable, Surface, Texture
from foredrive.towns.place.mesh import Mesh, join, quads, triangles

CELL_M = 4.0
MARGIN_M = 90.0
HORIZON_M = 1500.0
EDGE_DROP_M = 0.02
"""Height of a road's edge above the start of the land, m."""
ROAD_REACH_M = 1.5
SUNK_M = 0.5
DECK_CLEARANCE_M = 2.0
SMOOTHING_ROUNDS = 200
HILL_M, HILL_WAVE_M = 1.6, 45.0
HILL_START_M, HILL_RAMP_M = 30.0, 60.0
TILE_CELLS = 10
GAP_M2 = 12.0
"""Area below which a gap between lanes is paved, m²."""

Grid = Float[np.ndarray, "Y X"]


@dataclass(frozen=True)
class Terrain:
    """Heights of the land at the nodes of a grid."""

    origin_xy: Float[np.ndarray, "2"]
    z: Grid

    def height(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Return the height of the land, bilinear between the nodes."""
        # map_coordinates takes rows before columns
        rows_columns = ((xy - self.origin_xy) / CELL_M).T[::-1]
        return map_coordinates(self.z, rows_columns, order=1, mode="nearest")


@dataclass(frozen=True)
class Field:
    """A piece of farmland, at least the diagonal of a grid cell away from roads and other fields."""

    area: shapely.Polygon
    along: Float[np.ndarray, "2"]
    """Unit direction of its rows."""
    kind: str
    material: int | None
    """Number of its material, or None if it looks like the rest of the land."""


def make_terrain(
    plan: GroundPlan, bounds_m: tuple[float, float, float, float], rng: np.random.Generator
) -> Terrain:
    """Make land that is level with the roads on the ground and has gentle hills further away."""
    # A grid around the roads with a margin
    origin = np.array(bounds_m[:2]) - MARGIN_M
    columns, rows = np.ceil((np.array(bounds_m[2:]) + MARGIN_M - origin) / CELL_M).astype(int) + 1
    y, x = np.meshgrid(np.arange(rows) * CELL_M, np.arange(columns) * CELL_M, indexing="ij")
    xy = np.stack([x + origin[0], y + origin[1]], axis=-1)
    # Known heights: the nodes on and close to the roads
    near_road = _inside(plan.ground.buffer(ROAD_REACH_M), xy)
    # Fill the rest smoothly, then add hills that begin some way from the roads
    z = _spread(np.where(near_road, plan.borders.top(xy), 0.0), near_road)
    away_m = distance_transform_edt(~near_road) * CELL_M
    # Gaussian noise of a given wavelength, scaled to unit deviation
    noise = gaussian_filter(rng.standard_normal(z.shape), HILL_WAVE_M / CELL_M / 2.5, mode="wrap")
    hills = HILL_M * noise / noise.std()
    z += hills * np.clip((away_m - HILL_START_M) / HILL_RAMP_M, 0.0, 1.0)
    return Terrain(origin, _below_decks(z, xy, plan))


def build_terrain(
    terrain: Terrain, plan: GroundPlan, table: MaterialTable, fields: Sequence[Field] = ()
) -> Mesh:
    """Build the mesh of the land: whole cells, cells cut along the roads, and a far plain up to the horizon.

    Below the roads the land continues at a lower height, for rays that pass through a crack between the
    pieces of the road.
    """
    sunk = table.add(Material(Surface.HIDDEN, Texture.PLAIN, (0.3, 0.3, 0.3), 0.15))
    material = table.add(Material(Surface.TERRAIN, Texture.GRASS, GRASS_RGB, 0.45))
    asphalt = table.add(Material(Surface.ROAD, Texture.ROAD, ASPHALT_RGB, 0.15))
    rows, columns = terrain.z.shape
    j, i = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    lower = terrain.origin_xy + CELL_M * np.stack([i, j], axis=-1)
    cells = shapely.box(*np.moveaxis(lower, -1, 0), *np.moveaxis(lower + CELL_M, -1, 0))
    # Cells that the roads do not touch stay whole; cells on their border are cut; the others are sunk
    shapely.prepare(plan.ground)
    touched = shapely.intersects(plan.ground, cells)
    cut = touched & ~shapely.contains_properly(plan.ground, cells)
    whole, tilled = ~touched, []
    for field in fields:
        # Cells that a field touches get its texture; beyond its border the texture is grass
        if field.material is not None:
            inside = whole & shapely.intersects(field.area, cells)
            tilled.append(_tilled(field, _cell_corners(terrain, j[inside], i[inside]), field.material))
            whole &= ~inside
    edges = _cut_cells(terrain, plan, cells[cut], np.stack([j[cut], i[cut]], axis=-1), material)
    return join(
        [
            quads(_cell_corners(terrain, j[whole], i[whole]), material),
            *tilled,
            _paved_in_gaps(edges, plan, asphalt),
            # Below the roads, for rays through cracks
            quads(_cell_corners(terrain, j[touched], i[touched]) - np.array([0.0, 0.0, SUNK_M]), sunk),
            _horizon(terrain, material),
        ]
    )


def _inside(area: shapely.Geometry, xy: Float[np.ndarray, "Y X 2"]) -> Bool[np.ndarray, "Y X"]:
    shapely.prepare(area)
    return shapely.contains_xy(area, xy[..., 0], xy[..., 1])


def _spread(z: Grid, known: Bool[np.ndarray, "Y X"]) -> Grid:
    """Fill unknown heights smoothly (Laplace's equation), starting from the nearest known heights."""
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    # From coarse to fine, so that the relaxation converges in few rounds
    filled = z[tuple(nearest)]
    for sigma in (16.0, 8.0, 4.0, 2.0):
        filled = np.where(known, z, gaussian_filter(filled, sigma, mode="nearest"))
    # Jacobi iteration: each unknown height becomes the mean of its four neighbours
    for _ in range(SMOOTHING_ROUNDS):
        padded = np.pad(filled, 1, mode="edge")
        mean = 0.25 * (padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:])
        filled = np.where(known, z, mean)
    return filled


def _below_decks(z: Grid, xy: Float[np.ndarray, "Y X 2"], plan: GroundPlan) -> Grid:
    """Lower the land under bridges that it would otherwise reach."""
    decks = [piece for piece in plan.pieces if piece.bridge]
    if not decks:
        return z
    # Nodes under bridges: lower them below the nearest deck's lowest edge, less a clearance
    under = _inside(plan.bridges.buffer(CELL_M), xy)
    index = shapely.STRtree([p.area for p in decks]).query_nearest(
        shapely.points(xy[under]), all_matches=False
    )[1]
    ceiling = np.array([decks[i].left_xyz[:, 2].min() for i in index]) - DECK_CLEARANCE_M
    lowered = z.copy()
    lowered[under] = np.minimum(z[under], ceiling)
    return lowered


def _node_xyz(terrain: Terrain, j: np.ndarray, i: np.ndarray) -> Float[np.ndarray, "n 3"]:
    xy = terrain.origin_xy + CELL_M * np.stack([i, j], axis=-1)
    return np.concatenate([xy, terrain.z[j, i][..., None]], axis=-1)


def _cell_corners(terrain: Terrain, j: np.ndarray, i: np.ndarray) -> Float[np.ndarray, "n 4 3"]:
    return np.stack(
        [_node_xyz(terrain, j + dj, i + di) for dj, di in ((0, 0), (0, 1), (1, 1), (1, 0))], axis=1
    )


def _tilled(field: Field, corners: Float[np.ndarray, "n 4 3"], material: int) -> Mesh:
    """Build the cells of a field, with the distance to its border in their texture coordinates."""
    xy = corners[..., :2]
    points = shapely.points(xy)
    # Distance from the border, positive inside
    within = shapely.distance(field.area.exterior, points)
    within = np.where(shapely.covers(field.area, points), within, -within)
    across = np.array([-field.along[1], field.along[0]])
    middle = shapely.get_coordinates(field.area.centroid)[0]
    # Texture: across the rows, along them, from the border inwards
    uvw = np.stack([(xy - middle) @ across, (xy - middle) @ field.along, within], axis=-1)
    return quads(corners, material, uvw)


def _cut_cells(
    terrain: Terrain, plan: GroundPlan, cells: np.ndarray, index: np.ndarray, material: int
) -> Mesh:
    """Build the remainder of the cells that the roads cut.

    Nodes keep their height. Points on the cut have the height of the road.
    """
    # Clip the roads tile by tile: differences with the whole network would be slow
    tiles, tile_of_cell = np.unique(index // TILE_CELLS, axis=0, return_inverse=True)
    low = terrain.origin_xy + tiles[:, ::-1] * TILE_CELLS * CELL_M - 0.5
    high = low + TILE_CELLS * CELL_M + 1.0
    roads = np.array(
        [shapely.clip_by_rect(plan.ground, *a, *b) for a, b in zip(low.tolist(), high.tolist(), strict=True)]
    )
    rest = shapely.difference(cells, roads[tile_of_cell.reshape(-1)])
    parts = shapely.get_parts(shapely.get_parts(shapely.constrained_delaunay_triangles(rest)))
    xy = shapely.get_coordinates(shapely.orient_polygons(parts)).reshape(-1, 4, 2)[:, :3]
    # Corners of the triangles that are nodes of the grid keep the land's height
    at_node = np.abs((xy - terrain.origin_xy) / CELL_M % 1.0 - 0.5).min(axis=-1) > 0.5 - 1e-6
    z = np.where(
        at_node, terrain.height(xy.reshape(-1, 2)).reshape(at_node.shape), plan.borders.top(xy) - EDGE_DROP_M
    )
    return triangles(np.concatenate([xy, z[..., None]], axis=-1), material)


def _paved_in_gaps(land: Mesh, plan: GroundPlan, material: int) -> Mesh:
    """Return the land with small gaps between lanes paved."""
    # Holes in the ground with a small area are gaps between lanes
    rings = [ring for part in shapely.get_parts(plan.ground) for ring in part.interiors]
    gaps = [gap for gap in map(shapely.Polygon, rings) if gap.area < GAP_M2]
    middle = land.xyz[..., :2].mean(axis=1)
    inside = shapely.STRtree(gaps).query(shapely.points(middle), predicate="intersects")[0]
    materials = land.material.copy()
    materials[inside] = material
    return Mesh(land.xyz, np.zeros_like(land.uvw), materials)


def _horizon(terrain: Terrain, material: int) -> Mesh:
    """Build a far plain around the grid."""
    rows, columns = terrain.z.shape
    # Around the border of the grid, counter-clockwise
    ring = [(0, i) for i in range(columns)] + [(j, columns - 1) for j in range(1, rows)]
    ring += [(rows - 1, i) for i in range(columns - 2, -1, -1)] + [(j, 0) for j in range(rows - 2, -1, -1)]
    j, i = np.array(ring).T
    inner = _node_xyz(terrain, j, i)
    centre = terrain.origin_xy + 0.5 * CELL_M * np.array([columns - 1, rows - 1])
    away = inner[:, :2] - centre
    # Each border node is pushed outwards from the centre, to a common height
    outer_xy = inner[:, :2] + away / np.linalg.norm(away, axis=1, keepdims=True) * HORIZON_M
    outer = np.column_stack([outer_xy, np.full(len(inner), inner[:, 2].mean())])
    return quads(np.stack([inner[:-1], outer[:-1], outer[1:], inner[1:]], axis=1), material)
