"""A town's map as objects of 123D, with the heights of the town's roads."""

from collections.abc import Iterator

import numpy as np
from py123d.datatypes import BaseMapObject, BaseMapSurfaceObject, Crosswalk, Lane, LaneGroup
from py123d.geometry import Polyline3D
from py123d.parser.opendrive.opendrive_map_parser import OpenDriveMapParser
from scipy.spatial import cKDTree

from foredrive.towns.map.town_map import MAP_FOLDER, TownMap, load_town_map

_LINES = ("_outline", "_polyline", "_left_boundary", "_right_boundary")


def map_objects(town: str) -> Iterator[BaseMapObject]:
    """Yield the objects of a town's map, as py123d parses them, with the heights of the town's roads.

    Their order does not depend on the hashes of strings.
    """
    items = list(OpenDriveMapParser(MAP_FOLDER / f"{town}.xodr.gz").iter_map_objects())
    for item in items:
        if isinstance(item, Lane | LaneGroup):
            # py123d collects these ids in sets, whose order differs from run to run
            item.predecessor_ids.sort()
            item.successor_ids.sort()
    _lift(items, load_town_map(town))
    yield from items


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
