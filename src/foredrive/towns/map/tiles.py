"""Tiles of the large towns: the roads of a square, cut out of the OpenDRIVE file and at the square's edge."""

import contextlib
import copy
import dataclasses
import gzip
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely

from foredrive.towns.map.opendrive import MIN_MARKING_M, junction_areas
from foredrive.towns.map.town_map import Lane, Marking, Strip, TownMap

Bounds = tuple[float, float, float, float]
"""Smallest x, y and largest x, y, m."""
LEAST_POINTS = 12
"""Least number of points of a road that is cut off at the edge; shorter pieces are left out."""
NO_JUNCTION = "-1"


@dataclass(frozen=True)
class _Outline:
    """Holds what is known of a road before it is read."""

    junction: str
    touches: bool
    """True if it may touch the tile."""
    roads: tuple[str, ...]
    """Roads that it is linked to; `junctions` likewise."""
    junctions: tuple[str, ...]


@contextlib.contextmanager
def roads_within(path: Path, bounds_m: Bounds) -> Iterator[Path]:
    """Yield a file of the roads of an OpenDRIVE file (`.xodr.gz`) that touch a square, and of those around.

    Links to roads that are left out are those to a junction that does not exist.
    """
    roads = {road.get("id", ""): _outline(road, bounds_m) for road in _elements(path, "road")}
    near = _with_neighbours(roads)
    root = ElementTree.Element("OpenDRIVE")
    for element in _elements(path, "header", "road", "junction"):
        if element.tag == "road":
            if element.get("id") not in near:
                continue
            _cut_links(element, near)
            if not roads[element.get("id", "")].touches:
                _narrow(element)
        for connection in element.findall("connection"):
            if not {connection.get("incomingRoad"), connection.get("connectingRoad")} <= near:
                element.remove(connection)
        if element.tag != "junction" or element.find("connection") is not None:
            root.append(copy.copy(element))  # the element itself is emptied
    with tempfile.TemporaryDirectory() as folder:
        cut = Path(folder) / f"{path.name.split('.')[0]}.xodr"
        ElementTree.ElementTree(root).write(cut)
        yield cut


def _elements(path: Path, *tags: str) -> Iterator[ElementTree.Element]:
    """Yield elements of a file that is too large to be kept whole; each is emptied after its turn."""
    with gzip.open(path) as file:
        for _, element in ElementTree.iterparse(file):
            if element.tag in tags:
                yield element
            if element.tag in ("header", "road", "junction", "controller"):
                element.clear()


def _outline(road: ElementTree.Element, bounds_m: Bounds) -> _Outline:
    x0, y0, x1, y1 = bounds_m
    touches = False
    # Each piece reaches as far from its start as it is long
    for piece in road.iterfind("planView/geometry"):
        x, y, reach_m = (float(piece.get(key, "nan")) for key in ("x", "y", "length"))
        touches |= x0 - reach_m < x < x1 + reach_m and y0 - reach_m < y < y1 + reach_m
    linked = [(_is_junction(link), link.get("elementId", "")) for link in _links(road)]
    return _Outline(
        road.get("junction", NO_JUNCTION),
        touches,
        tuple(name for is_junction, name in linked if not is_junction),
        tuple(name for is_junction, name in linked if is_junction),
    )


def _with_neighbours(roads: Mapping[str, _Outline]) -> set[str]:
    """Return the roads that may touch the square, with those that are linked to them and whole junctions."""
    of_junction: dict[str, set[str]] = {}
    for name, road in roads.items():
        if road.junction != NO_JUNCTION:
            of_junction.setdefault(road.junction, set()).add(name)
    chosen = {name for name, road in roads.items() if road.touches}
    # Open ends must be outside
    linked = [roads[name] for name in chosen]
    junctions = {junction for road in linked for junction in (road.junction, *road.junctions)}
    chosen |= {name for road in linked for name in road.roads if name in roads}
    chosen |= {name for junction in junctions for name in of_junction.get(junction, ())}
    return chosen


def _links(road: ElementTree.Element) -> Sequence[ElementTree.Element]:
    return [*road.iterfind("link/predecessor"), *road.iterfind("link/successor")]


def _is_junction(link: ElementTree.Element) -> bool:
    return link.get("elementType") == "junction"


def _cut_links(road: ElementTree.Element, kept: set[str]) -> None:
    for link in _links(road):
        if not _is_junction(link) and link.get("elementId") not in kept:
            link.attrib.update(elementType="junction", elementId=NO_JUNCTION)


def _narrow(road: ElementTree.Element) -> None:
    """Leave one driving lane a direction: of several at an open end py123d removes some, but not the links
    to them."""
    for side in (*road.iterfind("lanes/laneSection/left"), *road.iterfind("lanes/laneSection/right")):
        driving = [lane for lane in side.iterfind("lane") if lane.get("type") == "driving"]
        innermost = min(driving, key=lambda lane: abs(int(lane.get("id", "0"))), default=None)
        for lane in driving:
            if lane is not innermost:
                lane.set("type", "none")


@dataclass(frozen=True)
class _Piece:
    """The part of a strip within a tile."""

    run: slice
    has_begin: bool
    has_end: bool


def cut_out(roads: TownMap, bounds_m: Bounds) -> TownMap:
    """Return the part of a map within a square. Junctions at its edge stay whole."""
    pieces = {strip.id: piece for strip in roads.strips if (piece := _piece(strip, bounds_m))}
    strips = tuple(_cut_strip(strip, pieces[strip.id].run) for strip in roads.strips if strip.id in pieces)
    lanes = [_cut_lane(lane, pieces) for lane in roads.lanes if lane.lane_id in pieces]
    driven = {lane.lane_id for lane in lanes}
    x0, y0, x1, y1 = bounds_m
    square = shapely.box(x0, y0, x1, y1)
    return dataclasses.replace(
        roads,
        lanes=tuple(lanes),
        strips=strips,
        crosswalks=tuple(
            crosswalk
            for crosswalk in roads.crosswalks
            if square.contains(shapely.Polygon(crosswalk.outline_xyz[:, :2]))
        ),
        stop_zones=tuple(
            dataclasses.replace(zone, lane_ids=_among(zone.lane_ids, driven))
            for zone in roads.stop_zones
            if driven & set(zone.lane_ids)
        ),
        junctions=junction_areas(strips),
    )


def _piece(strip: Strip, bounds_m: Bounds) -> _Piece | None:
    x0, y0, x1, y1 = bounds_m
    x, y = 0.5 * (strip.left_xyz + strip.right_xyz)[:, :2].T
    inside = (x > x0) & (x < x1) & (y > y0) & (y < y1)
    if inside.all() or (strip.junction_id is not None and inside.any()):
        return _Piece(slice(0, len(inside)), True, True)
    # The longest run of points within the square
    steps = np.diff(np.pad(inside, 1).astype(int))
    begins, ends = np.flatnonzero(steps > 0), np.flatnonzero(steps < 0)
    if not len(begins) or (ends - begins).max() < LEAST_POINTS:
        return None
    longest = int(np.argmax(ends - begins))
    run = slice(int(begins[longest]), int(ends[longest]))
    return _Piece(run, run.start == 0, run.stop == len(inside))


def _cut_strip(strip: Strip, run: slice) -> Strip:
    """Return a piece of a strip, with its markings."""
    middle = 0.5 * (strip.left_xyz + strip.right_xyz)[:, :2]
    step_m = float(np.linalg.norm(np.diff(middle, axis=0), axis=1).mean())
    from_m, to_m = run.start * step_m, (run.stop - 1) * step_m

    def moved(markings: tuple[Marking, ...]) -> tuple[Marking, ...]:
        return tuple(
            dataclasses.replace(
                marking,
                start_m=max(marking.start_m, from_m) - from_m,
                end_m=min(marking.end_m, to_m) - from_m,
            )
            for marking in markings
            if min(marking.end_m, to_m) - max(marking.start_m, from_m) >= MIN_MARKING_M
        )

    if len(middle) == run.stop - run.start:
        return strip
    return dataclasses.replace(
        strip,
        left_xyz=strip.left_xyz[run],
        right_xyz=strip.right_xyz[run],
        left_markings=moved(strip.left_markings),
        right_markings=moved(strip.right_markings),
    )


def _cut_lane(lane: Lane, pieces: Mapping[str, _Piece]) -> Lane:
    """Return the piece of a lane, with the links to what begins or ends within the square."""
    own = pieces[lane.lane_id]
    begin = {name for name in lane.successor_ids if name in pieces and pieces[name].has_begin}
    end = {name for name in lane.predecessor_ids if name in pieces and pieces[name].has_end}
    return dataclasses.replace(
        lane,
        centreline_xyz=lane.centreline_xyz[own.run],
        left_boundary_xyz=lane.left_boundary_xyz[own.run],
        right_boundary_xyz=lane.right_boundary_xyz[own.run],
        successor_ids=_among(lane.successor_ids, begin) if own.has_end else (),
        predecessor_ids=_among(lane.predecessor_ids, end) if own.has_begin else (),
        left_id=lane.left_id if lane.left_id in pieces else None,
        right_id=lane.right_id if lane.right_id in pieces else None,
    )


def _among(ids: tuple[str, ...], kept: Set[str]) -> tuple[str, ...]:
    return tuple(name for name in ids if name in kept)
