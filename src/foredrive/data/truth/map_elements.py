"""Map elements and map rasters around the ego vehicle, from a log's 123D map."""

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
import torch
from py123d.datatypes import BaseMapSurfaceObject, Lane, MapLayer, RoadEdge
from shapely import LinearRing, LineString, Polygon

from foredrive.data.arrow_files import reading
from foredrive.data.logs import Log
from foredrive.data.truth.map_lines import (
    Line,
    clipped,
    coordinates,
    distinct,
    line_strings,
    merged,
    united,
    without_near,
)
from foredrive.data.truth.raster import draw_lines, fill_polygon
from foredrive.scene.map_elements import ElementKind, MapElements, MapRaster, PlaneSpec, RasterLayer

REACH_M = 110.0
"""Distance around the driven path up to which a map is read. It exceeds the corners of every patch."""
EDGE_M = 0.5
"""A lane boundary within this distance of a road edge is no divider. A road edge that lies deeper than this
in the outline of a junction is no boundary: it borders a gap between the junction's lanes."""
MIN_LENGTH_M = 2.0
"""Minimum length of a merged line before it is clipped."""
MIN_PIECE_M = 0.5
"""Minimum length of a line within the patch."""
LEVEL_M = 4.5
"""Maximum height of an element above or below the ego vehicle. Others belong to another level of the road."""
_DRIVABLE = (MapLayer.LANE, MapLayer.INTERSECTION, MapLayer.CARPARK, MapLayer.GENERIC_DRIVABLE)
_EVERYWHERE_M = 1e8
_ERASED_PX = 4
"""Cells by which UniAD draws a line wider where it erases those of the layers before it."""


@dataclass(frozen=True, eq=False)
class LogMap:
    """The elements of the map around a log's path, in the world frame."""

    lines: dict[ElementKind, list[Line]]
    drivable: list[list[Line]]
    """Outline and holes of each drivable area."""
    crossing_edges: list[Line]
    """The two longest edges of each pedestrian crossing."""
    flat: bool
    """The map has no heights."""


def read_map_elements(log: Log, frame: int, patch_lw_m: tuple[float, float]) -> MapElements:
    """Read the elements in a patch around the ego vehicle, unbatched.

    Dividers are the boundaries of lanes outside junctions that are no road edges. Boundaries are the road
    edges but for those within junctions, crossings the outlines of united crossings, and centrelines those
    of all lanes. Lines are joined where exactly two of them meet, and cut off at the border of the patch. An
    outline is open where the border cuts it, as MapTR's are.

    Args:
        log: the log.
        frame: the frame at now.
        patch_lw_m: extent along x and along y, centred on the ego frame, m. MapTR's 30 × 60 m is (60, 30).

    Raises:
        InputError: the map cannot be read.
    """
    own_map = log_map(log)
    pieces: list[tuple[int, Line]] = []
    if own_map is not None:
        upper = (0.5 * patch_lw_m[0], 0.5 * patch_lw_m[1])
        for kind, lines in own_map.lines.items():
            # Parts of each line inside of the patch
            inside = _inside(lines, log, frame, own_map.flat, (-upper[0], -upper[1]), upper)
            pieces += [(int(kind), piece) for piece in inside]
    count, longest = len(pieces), max((len(piece) for _, piece in pieces), default=0)
    vertices = torch.zeros(count, longest, 2)
    valid = torch.zeros(count, longest, dtype=torch.bool)
    # Padding behind each line's vertices is not valid
    for row, (_, piece) in enumerate(pieces):
        vertices[row, : len(piece)] = torch.from_numpy(piece[:, :2]).float()
        valid[row, : len(piece)] = True
    kinds = torch.tensor([kind for kind, _ in pieces], dtype=torch.int64)
    return MapElements(vertices, valid, kinds, known=torch.tensor(own_map is not None))


def read_map_raster(log: Log, frame: int, spec: PlaneSpec, line_px: int) -> MapRaster:
    """Draw the map around the ego vehicle, unbatched.

    Drivable areas are filled. The other layers are lines: dividers, the two longest edges of each crossing,
    and boundaries. As in UniAD (`VectorizedLocalMap`, `preprocess_map`), a crossing erases the dividers
    around it, and a boundary the dividers and crossings around it. In contrast to UniAD, all layers are in
    the ego frame.

    Args:
        log: the log.
        frame: the frame at now.
        spec: the grid.
        line_px: width of a line, cells.

    Raises:
        InputError: the map cannot be read.
    """
    layers = np.zeros((len(RasterLayer), *spec.shape_yx), dtype=np.int32)
    own_map = log_map(log)
    if own_map is not None:
        sources = {
            RasterLayer.DIVIDER: own_map.lines[ElementKind.DIVIDER],
            RasterLayer.CROSSING: own_map.crossing_edges,
            RasterLayer.BOUNDARY: own_map.lines[ElementKind.BOUNDARY],
        }
        # Later layers erase what lies around their lines in the layers before
        for layer, lines in sources.items():
            parts = _inside(lines, log, frame, own_map.flat, spec.lower_m, spec.upper_m)
            layers[:layer, draw_lines(parts, line_px + _ERASED_PX, spec) > 0] = 0
            layers[layer] = draw_lines(parts, line_px, spec)
        # A drivable area counts if any of its outline is on the vehicle's level
        for area in own_map.drivable:
            rings = _in_ego_frame(area, log, frame, own_map.flat)
            if np.abs(rings[0][:, 2]).min() <= LEVEL_M:
                fill_polygon(rings, 1, spec, layers[RasterLayer.DRIVABLE])
    return MapRaster(spec, torch.from_numpy(layers > 0), known=torch.tensor(own_map is not None))


def read_shared_drivable(log: Log) -> list[list[Line]] | None:
    """Read the drivable areas of the whole map that a log shares with others, world frame.

    Returns:
        Outline and holes of each, or None if the log has no map, or one of its own.

    Raises:
        InputError: the map cannot be read.
    """
    with reading(log.path.folder, "its map"):
        api = log.scene.get_map_api()
        # A map of this log alone is not shared with others
        if api is None or api.get_map_metadata().map_is_per_log:
            return None
        # The whole map
        everywhere = shapely.box(*(-_EVERYWHERE_M,) * 2, *(_EVERYWHERE_M,) * 2)
        return _drivable(api.query(everywhere, list(_DRIVABLE), "intersects"))


def log_map(log: Log) -> LogMap | None:
    """Read and merge the map around a log's path. Return None if the log has no map.

    Raises:
        InputError: the map cannot be read.
    """
    with reading(log.path.folder, "its map"):
        return _log_map(log)


@functools.lru_cache(maxsize=64)
def _log_map(log: Log) -> LogMap | None:
    api = log.scene.get_map_api()
    if api is None:
        return None
    driven = log.T_world_ego[:, :2, 3]
    around = shapely.box(*(driven.min(axis=0) - REACH_M), *(driven.max(axis=0) + REACH_M))
    # A map without heights is taken to lie on the ground under the vehicle
    flat = not api.get_map_metadata().map_has_z
    objects = api.query(around, [MapLayer.ROAD_EDGE, MapLayer.CROSSWALK, *_DRIVABLE], "intersects")
    lanes = [lane for lane in objects[MapLayer.LANE] if isinstance(lane, Lane)]
    edges = [edge for edge in objects[MapLayer.ROAD_EDGE] if isinstance(edge, RoadEdge)]
    junctions = [_polygon(item) for item in _surfaces(objects[MapLayer.INTERSECTION])]
    # Road edges without the parts that lie deep in a junction, which border gaps between its lanes
    edge_lines = without_near(line_strings(edge.polyline_3d.array for edge in edges), junctions, -EDGE_M)
    crossings = [_polygon(item) for item in _surfaces(objects[MapLayer.CROSSWALK])]
    # Dividers: lane boundaries outside of junctions, once each, without those along road edges
    kinds = {
        ElementKind.DIVIDER: merged(
            without_near(distinct(_inner_boundaries(lanes)), edge_lines, EDGE_M), MIN_LENGTH_M
        ),
        ElementKind.CROSSING: [LineString(ring) for area in united(crossings) for ring in _rings(area)],
        ElementKind.BOUNDARY: merged(edge_lines, MIN_LENGTH_M),
        ElementKind.CENTRELINE: merged(
            line_strings(lane.centerline_3d.array for lane in lanes), MIN_LENGTH_M, directed=True
        ),
    }
    return LogMap(
        lines={kind: [coordinates(line) for line in lines] for kind, lines in kinds.items()},
        drivable=_drivable(objects),
        crossing_edges=[edge for area in crossings for edge in _long_edges(area.exterior)],
        flat=flat,
    )


def _drivable(objects: Mapping[MapLayer, Sequence[object]]) -> list[list[Line]]:
    """Return outline and holes of each drivable area."""
    areas = (item for layer in _DRIVABLE for item in _surfaces(objects[layer]))
    return [_rings(_polygon(item)) for item in areas]


def _inner_boundaries(lanes: Sequence[Lane]) -> list[LineString]:
    """Return both boundaries of the lanes outside junctions."""
    outside = [lane for lane in lanes if (group := lane.lane_group) is None or group.intersection_id is None]
    return line_strings(
        side.array for lane in outside for side in (lane.left_boundary_3d, lane.right_boundary_3d)
    )


def _surfaces(objects: Sequence[object]) -> Iterator[BaseMapSurfaceObject]:
    return (item for item in objects if isinstance(item, BaseMapSurfaceObject))


def _polygon(item: BaseMapSurfaceObject) -> Polygon:
    """Return the area of a map object with heights; holes have the mean height of the outline."""
    outline = np.asarray(item.outline_3d.array, dtype=np.float64)
    holes = [shapely.force_3d(hole, float(outline[:, 2].mean())) for hole in item.shapely_polygon.interiors]
    polygon = Polygon(outline, holes)
    # An outline that crosses itself is replaced by its largest valid part
    return polygon if polygon.is_valid else _largest(polygon)


def _largest(polygon: Polygon) -> Polygon:
    """Return the largest valid part of an outline that crosses itself."""
    parts = [part for part in shapely.get_parts(polygon.buffer(0.0)) if isinstance(part, Polygon)]
    return max(parts, key=lambda part: part.area) if parts else polygon


def _rings(polygon: Polygon) -> list[Line]:
    """Return the outline and the holes."""
    return [coordinates(ring) for ring in (polygon.exterior, *polygon.interiors)]


def _long_edges(ring: LinearRing) -> list[Line]:
    """Return the two longest edges of a ring."""
    xyz = coordinates(ring)
    # Lengths over ground, without heights
    longest = np.argsort(np.linalg.norm(np.diff(xyz[:, :2], axis=0), axis=-1), kind="stable")[-2:]
    return [xyz[edge : edge + 2] for edge in longest]


def _in_ego_frame(lines: Sequence[Line], log: Log, frame: int, flat: bool) -> list[Line]:
    """Transform lines from the world to the ego frame. In a flat map they are on the ground."""
    if not lines:
        return []
    # All lines in one transform, then split again
    points, T_world_ego = np.concatenate(lines), log.T_world_ego[frame]
    if flat:
        # In a flat map all lines get the height of the ego vehicle
        points[:, 2] = T_world_ego[2, 3]
    T_ego_world = np.linalg.inv(T_world_ego)
    points = points @ T_ego_world[:3, :3].T + T_ego_world[:3, 3]
    return np.split(points, np.cumsum([len(line) for line in lines])[:-1])


def _inside(
    lines: Sequence[Line],
    log: Log,
    frame: int,
    flat: bool,
    lower_m: tuple[float, float],
    upper_m: tuple[float, float],
) -> list[Line]:
    """Return the parts of lines in a rectangle of the ego frame, on the ego vehicle's level of the road."""
    out = []
    for line in _in_ego_frame(lines, log, frame, flat):
        # A cheap test of extents before the exact clipping
        if (line[:, :2].min(axis=0) > upper_m).any() or (line[:, :2].max(axis=0) < lower_m).any():
            continue
        for piece in clipped(line, lower_m, upper_m):
            length_m = np.linalg.norm(np.diff(piece[:, :2], axis=0), axis=-1).sum()
            # Short remains, and lines of other levels of the road, are left out
            if length_m >= MIN_PIECE_M and np.abs(piece[:, 2]).min() <= LEVEL_M:
                out.append(piece)
    return out
