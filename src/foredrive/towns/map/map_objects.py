"""A town's map as objects of 123D, with the heights of the town's roads."""

from collections.abc import Iterator

import numpy as np
from py123d.datatypes import BaseMapObject, BaseMapSurfaceObject, Crosswalk, Lane, LaneGroup
from py123d.geometry import Polyline3D
from py123d.parser.opendrive.opendrive_map_parser import OpenDriveMapParser
from scipy.spatial import cKDTree

from foredrive.towns.map.loading import load_roads, load_town_map, xodr_file
from foredrive.towns.map.names import tile_bounds_m
from foredrive.towns.map.opendrive import CONNECTION_TOLERANCE_M
from foredrive.towns.map.tiles import Bounds
from foredrive.towns.map.town_map import TownMap

_LINES = ("_outline", "_polyline", "_left_boundary", "_right_boundary")


def map_objects(town: str) -> Iterator[BaseMapObject]:
    """Yield the objects of a town's map, as py123d parses them, with the heights of the town's roads.

    Their order does not depend on the hashes of strings. Objects that reach out of a tile are whole, but
    lanes that a tile has not are left out.
    """
    with xodr_file(town) as path:
        items = list(
            OpenDriveMapParser(path, connection_distance_threshold=CONNECTION_TOLERANCE_M).iter_map_objects()
        )
    for item in items:
        if isinstance(item, Lane | LaneGroup):
            # py123d collects these ids in sets, whose order differs from run to run
            item.predecessor_ids.sort()
            item.successor_ids.sort()
    _lift(items, load_roads(town))
    bounds_m = tile_bounds_m(town)
    yield from items if bounds_m is None else objects_within(items, load_town_map(town), bounds_m)


def objects_within(items: list[BaseMapObject], tile: TownMap, bounds_m: Bounds) -> Iterator[BaseMapObject]:
    """Yield the objects of a tile, with the links between them."""
    lanes, (x0, y0, x1, y1) = {lane.lane_id for lane in tile.lanes}, bounds_m
    groups = {lane.group_id for lane in tile.lanes}
    for item in items:
        if isinstance(item, Lane | LaneGroup):
            kept = lanes if isinstance(item, Lane) else groups
            if item.object_id not in kept:
                continue
            item.predecessor_ids[:] = [name for name in item.predecessor_ids if name in kept]
            item.successor_ids[:] = [name for name in item.successor_ids if name in kept]
            if isinstance(item, LaneGroup):
                item.lane_ids[:] = [name for name in item.lane_ids if name in lanes]
            else:
                item._left_lane_id = item.left_lane_id if item.left_lane_id in lanes else None
                item._right_lane_id = item.right_lane_id if item.right_lane_id in lanes else None
        else:
            # py123d finds no outline for some intersections: theirs is empty, and they are left out
            line = item.outline_3d if isinstance(item, BaseMapSurfaceObject) else item.polyline_3d
            x, y = line.array[:, :2].T
            if not ((x > x0) & (x < x1) & (y > y0) & (y < y1)).any():
                continue
        yield item


def _lift(items: list[BaseMapObject], town: TownMap) -> None:
    """Move each vertex by as much as the nearest border of a strip is higher in the town than in py123d.

    Crosswalks stay: py123d does not take their heights from borders.
    """
    outlines = {strip.id: strip.outline_xyz for strip in town.strips}
    strips = [i for i in items if isinstance(i, BaseMapSurfaceObject) and i.object_id in outlines]
    parsed = np.concatenate([strip.outline_3d.array for strip in strips])
    lift_m = np.concatenate([outlines[str(strip.object_id)][:, 2] for strip in strips]) - parsed[:, 2]
    tree = cKDTree(parsed)
    for item in items:
        if isinstance(item, Crosswalk):
            continue
        for name in _LINES:
            if hasattr(item, name):
                xyz = getattr(item, name).array
                xyz[:, 2] += lift_m[tree.query(xyz)[1]]
                setattr(item, name, Polyline3D.from_array(xyz))
        if isinstance(item, Lane):
            middle = 0.5 * (item.left_boundary.array + item.right_boundary.array)
            item._centerline = Polyline3D.from_array(middle)
