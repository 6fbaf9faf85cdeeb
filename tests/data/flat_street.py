"""A made-up street as objects of a 123D map, around the flat log's path."""

import numpy as np
import synthetic_log as world
from py123d.datatypes import (
    BaseMapObject,
    Crosswalk,
    Intersection,
    IntersectionType,
    Lane,
    LaneGroup,
    LaneType,
    RoadEdge,
    RoadEdgeType,
)
from py123d.geometry import Polyline3D


def line(x0: float, x1: float, y: float, z: float = 0.0) -> Polyline3D:
    x = np.arange(x0, x1 + 0.5, 1.0)
    return Polyline3D.from_array(
        np.stack([x, np.full_like(x, y), np.full_like(x, z)], -1) + world.WORLD_OFFSET
    )


def ring(x0: float, x1: float, y0: float, y1: float, z: float = 0.0) -> Polyline3D:
    corners = [[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z], [x0, y0, z]]
    return Polyline3D.from_array(np.array(corners) + world.WORLD_OFFSET)


def lane(number: int, group: int, x0: float, x1: float, y: float, back: bool = False, z: float = 0.0) -> Lane:
    """A lane 3.5 m wide around y."""
    half = -1.75 if back else 1.75
    turned = lambda side: Polyline3D.from_array(side.array[::-1]) if back else side  # noqa: E731
    return Lane(
        object_id=number,
        lane_type=LaneType.SURFACE_STREET,
        lane_group_id=group,
        left_boundary=turned(line(x0, x1, y + half, z)),
        right_boundary=turned(line(x0, x1, y - half, z)),
        centerline=turned(line(x0, x1, y, z)),
    )


def group(number: int, lanes: list[int], junction: int | None, outline: Polyline3D) -> LaneGroup:
    sides = Polyline3D.from_array(outline.array[:2]), Polyline3D.from_array(outline.array[2:4])
    return LaneGroup(number, lanes, *sides, intersection_id=junction, outline=outline)


def edge(number: int, polyline: Polyline3D) -> RoadEdge:
    return RoadEdge(number, RoadEdgeType.ROAD_EDGE_BOUNDARY, polyline)


def street() -> list[BaseMapObject]:
    """A two-way street along x, y from -1.75 to 5.25, in two pieces with 0.1 m between them.

    From x = 18 on it is a junction, with a gap between its lanes. Above all runs a bridge.
    """
    return [
        lane(1, 1, -100.0, 0.0, 0.0),
        lane(2, 2, 0.1, 18.1, 0.0),
        lane(3, 1, -100.0, 0.0, 3.5, back=True),
        lane(4, 2, 0.1, 18.1, 3.5, back=True),
        lane(5, 3, 18.0, 60.0, 0.0),
        group(1, [1, 3], None, ring(-100.0, 0.0, -1.75, 5.25)),
        group(2, [2, 4], None, ring(0.1, 18.1, -1.75, 5.25)),
        group(3, [5], 7, ring(18.0, 60.0, -1.75, 1.75)),
        Intersection(7, IntersectionType.DEFAULT, [3], outline=ring(18.0, 60.0, -1.75, 5.25)),
        edge(1, line(-100.0, 20.0, -1.75)),
        edge(2, line(20.0, 60.0, -1.75)),
        edge(3, line(-100.0, 60.0, 5.25)),
        edge(4, ring(30.0, 33.0, 2.0, 4.0)),  # a gap between lanes of the junction
        Crosswalk(1, outline=ring(8.0, 11.0, -1.75, 5.25)),
        Crosswalk(2, outline=ring(33.0, 37.0, -1.75, 5.25)),  # the patch ends at 35
        lane(6, 4, -100.0, 60.0, -8.0, z=8.0),
        group(4, [6], None, ring(-100.0, 60.0, -9.75, -6.25, 8.0)),
        edge(5, line(-100.0, 60.0, -9.75, 8.0)),
    ]
