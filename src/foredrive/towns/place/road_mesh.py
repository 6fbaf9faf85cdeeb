"""Meshes of roads: asphalt with lines, kerbs and walkways, crosswalks, stop lines, bridges."""

from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float

from foredrive.geometry.polylines import arc_lengths, points_at
from foredrive.towns.map.ground_plan import GroundPlan, Piece
from foredrive.towns.map.town_map import Marking, MarkingKind, StripKind, TownMap, marking_at
from foredrive.towns.place.materials import (
    ASPHALT_RGB,
    GRASS_RGB,
    LinePattern,
    Material,
    MaterialTable,
    Surface,
    Texture,
)
from foredrive.towns.place.mesh import Mesh, frustum, join, polygon_triangles, quads, ribbon, triangles, walls

KERB_FOOT_M = 0.3
PAINT_M = 0.008
"""Height of paint above the road, m."""
STOP_LINE_M = 0.45
STOP_LINE_GAP_M = 0.6
STRIPE_PERIOD_M, STRIPE_M = 1.0, 0.5
DECK_M = 0.9
PARAPET_M, PARAPET_WIDTH_M = 0.85, 0.25
PILLAR_SPACING_M, PILLAR_RADIUS_M = 24.0, 0.7
PILLAR_CLEARANCE_M = 1.0
PATCH_M = 1.0

_PATTERN = {
    MarkingKind.SOLID: LinePattern.SOLID,
    MarkingKind.BROKEN: LinePattern.BROKEN,
    MarkingKind.SOLID_SOLID: LinePattern.DOUBLE_SOLID,
    MarkingKind.SOLID_BROKEN: LinePattern.DOUBLE_SOLID,
    MarkingKind.BROKEN_SOLID: LinePattern.DOUBLE_BROKEN,
    MarkingKind.BROKEN_BROKEN: LinePattern.DOUBLE_BROKEN,
}
CONCRETE_RGB = (0.60, 0.585, 0.56)


@dataclass(frozen=True)
class RoadMaterials:
    """Numbers of the materials of roads."""

    walkway: int
    kerb: int
    median: int
    stripes: int
    line: int
    concrete: int


def add_road_materials(table: MaterialTable) -> RoadMaterials:
    """Add the materials of roads to a table."""
    kerb = Material(Surface.SIDEWALK, Texture.PLAIN, (0.66, 0.65, 0.62), 0.4, params=(0.5,))
    stripes = Material(
        Surface.ROAD, Texture.STRIPES, (0.86, 0.86, 0.84), 0.75, params=(STRIPE_PERIOD_M, STRIPE_M)
    )
    return RoadMaterials(
        walkway=table.add(Material(Surface.SIDEWALK, Texture.SLABS, CONCRETE_RGB, 0.35, params=(1.2,))),
        kerb=table.add(kerb),
        median=table.add(Material(Surface.TERRAIN, Texture.GRASS, GRASS_RGB, 0.45)),
        stripes=table.add(stripes),
        line=table.add(Material(Surface.ROAD, Texture.PLAIN, (0.86, 0.86, 0.84), 0.75, params=(0.5,))),
        concrete=table.add(
            Material(Surface.STRUCTURE, Texture.PLAIN, (0.62, 0.61, 0.58), 0.35, params=(1.0,))
        ),
    )


def build_roads(town: TownMap, plan: GroundPlan, table: MaterialTable) -> Mesh:
    """Build all paved surfaces of a town."""
    mats = add_road_materials(table)
    # One surface per piece of the road, then kerbs around raised ones
    parts = [_surface(piece, mats, table) for piece in plan.pieces]
    parts += [_kerbs(piece, mats) for piece in plan.pieces if piece.raise_m > 0]
    plain = table.add(_asphalt(None, None))
    # Fills close the gaps between pieces; paint is laid on top
    parts += [drape(fill, plan, plain, 0.0) for fill in plan.fills]
    parts += _crosswalks(town, plan, mats) + _stop_lines(town, mats)
    parts += _bridges(plan, mats)
    return join(parts)


def drape(area: shapely.Geometry, plan: GroundPlan, material: int, lift_m: float) -> Mesh:
    """Lay a polygon over the surrounding roads."""
    xy = polygon_triangles(area)
    z = plan.borders.road(xy) + lift_m
    return triangles(np.concatenate([xy, z[..., None]], axis=-1), material)


def _asphalt(left: Marking | None, right: Marking | None) -> Material:
    params: list[float] = []
    for marking in (left, right):
        if marking is None or marking.kind not in _PATTERN:
            params += [float(LinePattern.NONE), 0.0, 0.0]
        else:
            params += [float(_PATTERN[marking.kind]), float(marking.yellow), marking.width_m]
    return Material(Surface.ROAD, Texture.ROAD, ASPHALT_RGB, 0.15, params=tuple(params))


def _piece_material(piece: Piece, mats: RoadMaterials, table: MaterialTable) -> int:
    if piece.strip.kind is StripKind.SIDEWALK:
        return mats.walkway
    if piece.strip.kind is StripKind.MEDIAN:
        return mats.median
    if piece.strip.junction_id is not None or not piece.whole:
        return table.add(_asphalt(None, None))
    # Lane lines change along a road: the marking at the middle of the piece counts
    middle_m = float(piece.along_m[[0, -1]].mean())
    left = marking_at(piece.strip.left_markings, middle_m)
    return table.add(_asphalt(left, marking_at(piece.strip.right_markings, middle_m)))


def _surface(piece: Piece, mats: RoadMaterials, table: MaterialTable) -> Mesh:
    material = _piece_material(piece, mats, table)
    lift = np.array([0.0, 0.0, piece.raise_m])
    if not piece.whole:
        # A cut piece: triangles over its area, without lines (texture coordinates far from the borders)
        xy = polygon_triangles(piece.area)
        z = piece.height(xy.reshape(-1, 2)).reshape(xy.shape[:2]) + piece.raise_m
        return triangles(
            np.concatenate([xy, z[..., None]], axis=-1), material, np.full((*xy.shape[:2], 3), 9.0)
        )
    # A whole piece: a band between its borders; u and v are the distances from them
    left, right = piece.left_xyz + lift, piece.right_xyz + lift
    width = np.linalg.norm(left - right, axis=1)
    zero = np.zeros_like(width)
    return ribbon(
        left,
        right,
        material,
        (np.column_stack([zero, width, piece.along_m]), np.column_stack([width, zero, piece.along_m])),
    )


def _kerbs(piece: Piece, mats: RoadMaterials) -> Mesh:
    """Build vertical faces around a raised piece. Faces between two raised pieces are hidden."""
    if piece.whole:
        ring = np.concatenate([piece.right_xyz, piece.left_xyz[::-1], piece.right_xyz[:1]])
        z = ring[:, 2]
        return walls(ring[:, :2], z - KERB_FOOT_M, z + piece.raise_m, mats.kerb)
    rings = [shapely.get_coordinates(r) for r in _rings(piece.area)]
    heights = [piece.height(ring) for ring in rings]
    return join(
        [walls(r, z - KERB_FOOT_M, z + piece.raise_m, mats.kerb) for r, z in zip(rings, heights, strict=True)]
    )


def _rings(area: shapely.Geometry) -> list[shapely.LinearRing]:
    """Return all rings, with the solid on their left."""
    oriented = shapely.get_parts(shapely.orient_polygons(area))
    return [ring for polygon in oriented for ring in (polygon.exterior, *polygon.interiors)]


def _crosswalks(town: TownMap, plan: GroundPlan, mats: RoadMaterials) -> list[Mesh]:
    """Build stripes along the lanes, cut off at walkways and laid over the road metre by metre."""
    walkways = shapely.union_all([p.area for p in plan.pieces if p.raise_m > 0])
    parts = []
    for crosswalk in town.crosswalks:
        area = shapely.Polygon(crosswalk.outline_xyz[:, :2]).buffer(0)
        # Stripes run along the lanes, so they are counted along the longer side of the crosswalk
        corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(area))[:4]
        sides = corners[1:3] - corners[:2]
        along = max(sides, key=lambda side: float(np.linalg.norm(side)))
        length = float(np.linalg.norm(along))
        along /= length
        across = np.array([-along[1], along[0]])
        start = float((corners @ along).min())
        raised = shapely.clip_by_rect(walkways, *area.bounds)
        # Narrow bands keep the paint close to a road that is not flat
        for s in np.arange(start, start + length, PATCH_M):
            band = shapely.Polygon(
                [
                    along * u + across * v
                    for u, v in ((s, -1e4), (s + PATCH_M, -1e4), (s + PATCH_M, 1e4), (s, 1e4))
                ]
            )
            # The part of the crosswalk in the band, without walkways
            patch = area.intersection(band).difference(raised)
            mesh = drape(patch, plan, mats.stripes, PAINT_M)
            # Texture: distance across the stripes
            u = mesh.xyz[..., :2] @ along - start
            parts.append(triangles(mesh.xyz, mats.stripes, np.stack([u, 0 * u, 0 * u], axis=-1)))
    return parts


def _stop_lines(town: TownMap, mats: RoadMaterials) -> list[Mesh]:
    """Build a line across each lane before a light or a stop sign, and before its crosswalk if there is
    one."""
    crosswalks = shapely.union_all([shapely.Polygon(c.outline_xyz[:, :2]) for c in town.crosswalks])
    lanes = {lane.lane_id: lane for lane in town.lanes}
    # Lanes that lead to a light or a sign
    entries = {i for zone in town.stop_zones for lane in zone.lane_ids for i in lanes[lane].predecessor_ids}
    parts = []
    for name in sorted(entries):
        lane = lanes[name]
        # Move the line back until it is clear of the crosswalk
        for gap in np.arange(STOP_LINE_GAP_M, 8.0, 0.5):
            left = _before_end(lane.left_boundary_xyz, gap)
            right = _before_end(lane.right_boundary_xyz, gap)
            corners = np.stack([right[0], right[1], left[1], left[0]])
            if not shapely.Polygon(corners[:, :2]).buffer(STOP_LINE_GAP_M).intersects(crosswalks):
                parts.append(quads(corners[None] + [0.0, 0.0, PAINT_M], mats.line))
                break
    return parts


def _before_end(line: Float[np.ndarray, "N 3"], gap_m: float) -> Float[np.ndarray, "2 3"]:
    """Return the points at STOP_LINE_M + gap and at gap before the end of a line."""
    along = arc_lengths(line)
    border_m = along[-1] - gap_m - np.array([STOP_LINE_M, 0.0])
    return points_at(line, along, border_m)


def _bridges(plan: GroundPlan, mats: RoadMaterials) -> list[Mesh]:
    """Build decks, parapets along their open sides, and pillars where there is room."""
    bridge = [piece for piece in plan.pieces if piece.bridge]
    if not bridge:
        return []
    top = shapely.STRtree([p.area for p in bridge])
    parts = []
    for piece in bridge:
        # The underside of the deck, facing down
        down = np.array([0.0, 0.0, -DECK_M])
        parts.append(ribbon(piece.right_xyz + down, piece.left_xyz + down, mats.concrete))
    # Parapets run along the border of all decks together, so that none stands between two pieces
    decks = shapely.union_all([p.area for p in bridge]).buffer(0.05)
    for ring in _rings(shapely.orient_polygons(decks)):
        parts += _edge(shapely.get_coordinates(ring), bridge, top, plan, mats)
    parts += _pillars(bridge, plan, mats)
    return parts


def _edge(
    ring: Float[np.ndarray, "N 2"],
    bridge: list[Piece],
    top: shapely.STRtree,
    plan: GroundPlan,
    mats: RoadMaterials,
) -> list[Mesh]:
    """Build fascia and parapet along one ring of the decks, with no parapet where the road continues."""
    # Height of the nearest deck at each point of the border
    nearest = top.query_nearest(shapely.points(ring), all_matches=False)[1]
    z = np.array([bridge[n].height(xy[None])[0] for n, xy in zip(nearest, ring, strict=True)])
    step = ring[1:] - ring[:-1]
    length = np.linalg.norm(step, axis=1)
    # The solid is on the left of the ring, so outward is to the right
    outward = np.column_stack([step[:, 1], -step[:, 0]]) / length.clip(1e-6)[:, None]
    # Where the road continues at about the same height beyond the edge, there is no parapet
    beyond = 0.5 * (ring[1:] + ring[:-1]) + 0.6 * outward
    road_z = plan.borders.road(beyond)
    goes_on = shapely.contains_xy(plan.ground, beyond[:, 0], beyond[:, 1])
    goes_on &= np.abs(road_z - 0.5 * (z[1:] + z[:-1])) < 1.5
    parts = [walls(ring, z - DECK_M, z, mats.concrete)]
    for i in np.flatnonzero(~goes_on & (length > 0.05)):
        # A wall of `PARAPET_WIDTH_M` on the deck's edge, with a top
        inner = np.stack([ring[i], ring[i + 1]]) - PARAPET_WIDTH_M * outward[i]
        foot = np.concatenate([ring[i : i + 2], inner[::-1], ring[i : i + 1]])
        z_foot = np.concatenate([z[i : i + 2], z[i : i + 2][::-1], z[i : i + 1]])
        parts.append(walls(foot, z_foot, z_foot + PARAPET_M, mats.concrete))
        parts.append(quads(np.column_stack([foot[:4], z_foot[:4] + PARAPET_M])[None], mats.concrete))
    return parts


def _pillars(bridge: list[Piece], plan: GroundPlan, mats: RoadMaterials) -> list[Mesh]:
    ground = shapely.prepared.prep(plan.ground)
    parts, placed = [], shapely.MultiPoint()
    for piece in bridge:
        x, y, z = (0.5 * (piece.left_xyz + piece.right_xyz))[0]
        spot = shapely.Point(x, y)
        # Pillars keep their distance from each other and stay off the roads below
        if spot.distance(placed) < PILLAR_SPACING_M * 0.5:
            continue
        if ground.intersects(spot.buffer(PILLAR_RADIUS_M + PILLAR_CLEARANCE_M)):
            continue
        placed = placed.union(spot)
        base = float(plan.borders.road(np.array([[x, y]]))[0]) - 1.0
        radii = (PILLAR_RADIUS_M, PILLAR_RADIUS_M)
        parts.append(frustum((x, y, base), (x, y, z - DECK_M), radii, 10, mats.concrete))
    return parts
