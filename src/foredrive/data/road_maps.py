"""Roads around a log's drive as areas, for scores that need a map."""

import numpy as np
import shapely
from jaxtyping import Bool, Float64
from py123d.datatypes import BaseMapSurfaceObject, Lane, MapLayer
from py123d.geometry import Point2D

from foredrive.data.arrow_files import reading
from foredrive.data.logs import Log
from foredrive.data.maps import RADIUS_M
from foredrive.scene.road_map import RoadMap

BEYOND_M = 60.0
"""Length by which the centreline goes straight on before and behind the drive, m."""
SPACING_M = 1.0
_AREAS = (MapLayer.LANE_GROUP, MapLayer.INTERSECTION, MapLayer.CARPARK, MapLayer.GENERIC_DRIVABLE)


def read_road_map(log: Log) -> RoadMap | None:
    """Read the roads within `RADIUS_M` of a log's drive. Return None without a map, or without lanes.

    Lanes of the route are those that the log drives along, and the others of their lane groups. The
    centreline is the middle of the driven lanes; where the log drives in no lane, it is the driven path. It
    goes straight on along the heading of a vehicle that stands.

    Raises:
        InputError: the map cannot be read.
    """
    driven = log.T_world_ego[:, :2, 3]
    middle = 0.5 * (driven.min(axis=0) + driven.max(axis=0))
    reach_m = float(np.hypot(*(driven - middle).T).max()) + RADIUS_M
    with reading(log.path.folder, "its map"):
        api = log.scene.get_map_api()
        if api is None:
            return None
        near = api.get_map_objects_in_radius(Point2D(*middle), reach_m, [MapLayer.LANE, *_AREAS])
        lanes = [lane for lane in near[MapLayer.LANE] if isinstance(lane, Lane)]
        areas = {
            layer: tuple(_ring(item) for item in near[layer] if isinstance(item, BaseMapSurfaceObject))
            for layer in _AREAS
        }
    if not lanes:
        return None
    outlines = tuple(_lane_ring(lane) for lane in lanes)
    along = np.stack([_driven_along(lane, ring, log) for lane, ring in zip(lanes, outlines, strict=True)])
    used = [bool(row.any()) for row in along]
    # Parallel lanes of a driven lane belong to the route too
    groups = {lane.lane_group_id for lane, on in zip(lanes, used, strict=True) if on} - {None}
    on_route = tuple(on or lane.lane_group_id in groups for lane, on in zip(lanes, used, strict=True))
    return RoadMap(
        lanes=outlines,
        on_route=on_route,
        drivable=(*outlines, *(ring for rings in areas.values() for ring in rings)),
        intersections=areas[MapLayer.INTERSECTION],
        centreline=_centreline(lanes, along, log),
    )


def _ring(item: BaseMapSurfaceObject) -> Float64[np.ndarray, "V 2"]:
    return np.asarray(item.outline_2d.array, dtype=np.float64)[:, :2]


def _lane_ring(lane: Lane) -> Float64[np.ndarray, "V 2"]:
    sides = (lane.left_boundary, lane.right_boundary)
    left, right = (np.asarray(side.array, dtype=np.float64)[:, :2] for side in sides)
    return np.concatenate([left, right[::-1]])


def _driven_along(lane: Lane, ring: Float64[np.ndarray, "V 2"], log: Log) -> Bool[np.ndarray, "F"]:
    """Return at which frames the vehicle is in a lane and points along it."""
    xy, forward = log.T_world_ego[:, :2, 3], log.T_world_ego[:, :2, 0]
    # Outlines of lanes may cross themselves
    inside = np.asarray(shapely.contains_xy(shapely.make_valid(shapely.Polygon(ring)), *xy.T))
    line = lane.centerline_2d.linestring
    at_m = shapely.line_locate_point(line, shapely.points(xy))
    # The lane's direction here: a chord of two metres around the nearest point
    step = shapely.get_coordinates(shapely.line_interpolate_point(line, np.minimum(at_m + 1.0, line.length)))
    step -= shapely.get_coordinates(shapely.line_interpolate_point(line, np.maximum(at_m - 1.0, 0.0)))
    return np.asarray(inside & ((step * forward).sum(axis=1) > 0))


def _centreline(lanes: list[Lane], along: Bool[np.ndarray, "L F"], log: Log) -> Float64[np.ndarray, "N 2"]:
    points = list[np.ndarray]()
    for frame, xy in enumerate(log.T_world_ego[:, :2, 3]):
        rows = np.flatnonzero(along[:, frame]).tolist()
        spot, lines = shapely.Point(xy), [lanes[row].centerline_2d.linestring for row in rows]
        nearest = min(lines, key=spot.distance, default=None)
        if nearest is not None:
            xy = np.array(nearest.interpolate(nearest.project(spot)).coords[0][:2])
        # Points of a slow vehicle are thinned out, so that the direction between them is defined
        if not points or np.hypot(*(xy - points[-1])) >= SPACING_M:
            points.append(xy)
    line = np.stack(points)
    # A vehicle that stands has no direction of motion, or that of the noise in its positions
    heading = log.T_world_ego[0, :2, 0]
    first, last = (line[1] - line[0], line[-1] - line[-2]) if len(line) > 1 else (heading, heading)
    return np.vstack(
        [line[0] - BEYOND_M * first / np.hypot(*first), line, line[-1] + BEYOND_M * last / np.hypot(*last)]
    )
