"""Maps of OpenDRIVE files, read with py123d's parser."""

import copy
import dataclasses
import logging
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from py123d.geometry.utils.rotation_utils import normalize_angle
from py123d.parser.opendrive.utils.collection import collect_element_helpers
from py123d.parser.opendrive.utils.signal_helper import OpenDriveSignalHelper
from py123d.parser.opendrive.utils.stop_zone_helper import create_stop_zones_from_signals
from py123d.parser.opendrive.xodr_parser.opendrive import XODR
from py123d.parser.opendrive.xodr_parser.reference import XODRReferenceLine

from foredrive.towns.map.junction_heights import level_junction
from foredrive.towns.map.town_map import (
    Crosswalk,
    Lane,
    Marking,
    MarkingKind,
    Points,
    StopZone,
    StopZoneKind,
    Strip,
    StripKind,
    TownMap,
    marking_at,
)

# py123d tells each lane without links that it mends
logging.getLogger("py123d.parser.opendrive.utils.collection").setLevel(logging.ERROR)

SAMPLE_SPACING_M = 1.0
CONNECTION_TOLERANCE_M = 0.5
"""Largest gap between linked lanes, m. Town12 has gaps of 0.13 m, over which py123d's default drops links."""
MIN_MARKING_M = 0.1
DEFAULT_LINE_WIDTH_M = 0.125
_BORDERS = "inner_polyline_3d", "outer_polyline_3d"


def read_opendrive(path: Path, name: str) -> TownMap:
    """Read an OpenDRIVE file (`.xodr` or `.xodr.gz`).

    Args:
        path: the file.
        name: name of the map.
    """
    xodr = XODR.parse_from_file(path)
    roads, _, helpers, _, objects, centre_marks, signals = collect_element_helpers(
        xodr, SAMPLE_SPACING_M, CONNECTION_TOLERANCE_M
    )
    # Heights from the elevation profile, then junctions brought to one height
    strips = _level([_strip(helper, helpers, centre_marks, roads) for helper in helpers.values()])
    lanes = tuple(_lane(strip, helpers, roads) for strip in strips if strip.kind is StripKind.DRIVING)
    crosswalks = tuple(
        Crosswalk(o.object_id, np.concatenate([o.outline_3d, o.outline_3d[:1]])) for o in objects.values()
    )
    _add_own_lanes(signals, helpers, xodr)
    stop_zones = tuple(_stop_zones(helpers, signals, xodr))
    return TownMap(name, lanes, strips, crosswalks, stop_zones, junction_areas(strips))


def _with_road_height(helper: Any, xyz: Points, roads: dict[int, Any]) -> Points:
    """Set z from the road's elevation profile.

    py123d looks up the outer borders of later lane sections at a wrong place in the profile (errors of up to
    1 m in Town04).
    """
    profile = roads[int(helper.lane_id.split("_")[0])].elevation_profile.elevations
    # Cubic polynomial of the profile's piece at each sample
    s = np.linspace(helper.s_range[0], helper.s_range[1], len(xyz))
    starts = np.array([e.s for e in profile])
    index = np.clip(np.searchsorted(starts, s, side="right") - 1, 0, None)
    a, b, c, d = np.array([[e.a, e.b, e.c, e.d] for e in profile])[index].T
    ds = s - starts[index]
    z = a + ds * (b + ds * (c + ds * d))
    # Strips on the left run against the road's direction
    return np.column_stack([xyz[:, :2], z[::-1] if helper.id > 0 else z])


def _strip(
    helper: Any, helpers: dict[str, Any], centre_marks: dict[str, Any], roads: dict[int, Any]
) -> Strip:
    section, _, index = helper.lane_id.rsplit("_", 2)
    road = roads[int(section.split("_")[0])]
    # The inner border's markings are those of the next strip inwards, or of the reference line
    inward = helpers.get(_beside(helper, -1))
    if abs(int(index)) == 1:
        inner_marks = centre_marks.get(section, [])
    else:
        inner_marks = [] if inward is None else inward.open_drive_lane.road_marks
    # On the reference line, "solid broken" names the left line first. Elsewhere it names the inner line
    # first.
    swap_inner = abs(int(index)) > 1 or helper.id < 0
    # py123d moves the borders of lanes that open or end between others; without them it computes the file's
    written = copy.copy(helper)
    for name in _BORDERS:
        written.__dict__.pop(name, None)
    return Strip(
        id=helper.lane_id,
        kind=StripKind(helper.type if helper.type in set(StripKind) else StripKind.NONE),
        road_id=road.id,
        junction_id=None if road.junction is None else int(road.junction),
        left_xyz=_with_road_height(helper, written.inner_polyline_3d.array, roads),
        right_xyz=_with_road_height(helper, written.outer_polyline_3d.array, roads),
        left_markings=_markings(helper, inner_marks, swap_inner),
        right_markings=_markings(helper, helper.open_drive_lane.road_marks, swap=False),
    )


def _level(strips: list[Strip]) -> tuple[Strip, ...]:
    """Bring the roads that cross in junctions to one height."""
    levelled = list(strips)
    by_junction: dict[int, list[int]] = {}
    for index, strip in enumerate(strips):
        if strip.junction_id is not None:
            by_junction.setdefault(strip.junction_id, []).append(index)
    for indices in by_junction.values():
        borders = level_junction([(strips[i].left_xyz, strips[i].right_xyz) for i in indices])
        for index, (left, right) in zip(indices, borders, strict=True):
            levelled[index] = dataclasses.replace(strips[index], left_xyz=left, right_xyz=right)
    return tuple(levelled)


def _beside(helper: Any, step: int) -> str:
    """Return the id of the strip `step` places further out from the road's reference line."""
    group, index = helper.lane_id.rsplit("_", 1)
    return f"{group}_{int(index) + step * (1 if helper.id > 0 else -1)}"


_SWAPPED = {
    MarkingKind.SOLID_BROKEN: MarkingKind.BROKEN_SOLID,
    MarkingKind.BROKEN_SOLID: MarkingKind.SOLID_BROKEN,
}


def _markings(helper: Any, marks: list[Any], swap: bool) -> tuple[Marking, ...]:
    """Convert road marks from the road's s coordinate to the strip's direction of travel."""
    if not marks:
        return ()
    length = float(helper.s_range[1] - helper.s_range[0])
    ends = [mark.s_offset for mark in marks[1:]] + [length]
    markings = []
    for mark, end_s in zip(marks, ends, strict=True):
        start_m, end_m = max(0.0, mark.s_offset), min(length, end_s)
        name = (mark.type or "none").lower()
        kind = MarkingKind(name) if name in set(MarkingKind) else MarkingKind.SOLID
        if end_m - start_m < MIN_MARKING_M or kind is MarkingKind.NONE:
            continue
        # From the road's coordinate to the strip's own direction
        if helper.id > 0:
            start_m, end_m = length - end_m, length - start_m
        yellow = (mark.color or "").lower() == "yellow"
        kind = _SWAPPED.get(kind, kind) if swap else kind
        markings.append(Marking(start_m, end_m, kind, yellow, mark.width or DEFAULT_LINE_WIDTH_M))
    return tuple(sorted(markings, key=lambda marking: marking.start_m))


def _lane(strip: Strip, helpers: dict[str, Any], roads: dict[int, Any]) -> Lane:
    helper, borders = helpers[strip.id], [strip.left_xyz, strip.right_xyz]
    # A lane that opens branches off from the one that py123d links it to, at full width
    moved = [getattr(helper, name).array for name in _BORDERS]
    if not all(np.allclose(xyz[:, :2], own[:, :2]) for xyz, own in zip(moved, borders, strict=True)):
        borders = [_with_road_height(helper, xyz, roads) for xyz in moved]
    left_xyz, right_xyz = borders

    def driving(lane_ids: list[str]) -> tuple[str, ...]:
        return tuple(sorted({i for i in lane_ids if i in helpers and helpers[i].type == "driving"}))

    def kind_halfway(markings: tuple[Marking, ...]) -> MarkingKind:
        marking = marking_at(markings, 0.5 * float(helper.s_range[1] - helper.s_range[0]))
        return MarkingKind.NONE if marking is None else marking.kind

    limit = helper.speed_limit_mps
    return Lane(
        lane_id=strip.id,
        group_id=strip.id.rsplit("_", 1)[0],
        junction_id=strip.junction_id,
        centreline_xyz=0.5 * (left_xyz + right_xyz),
        left_boundary_xyz=left_xyz,
        right_boundary_xyz=right_xyz,
        speed_limit_mps=None if limit is None else float(limit),
        successor_ids=driving(helper.successor_lane_ids),
        predecessor_ids=driving(helper.predecessor_lane_ids),
        left_id=next(iter(driving([_beside(helper, -1)])), None),
        right_id=next(iter(driving([_beside(helper, 1)])), None),
        left_marking=kind_halfway(strip.left_markings),
        right_marking=kind_halfway(strip.right_markings),
    )


def _add_own_lanes(signals: dict[int, Any], helpers: dict[str, Any], xodr: XODR) -> None:
    """Add the signals of junctions that name their lanes themselves: py123d reads those of references alone.

    Elsewhere a lane of a signal does not begin at its line.
    """
    of_road: dict[int, list[Any]] = {}
    for helper in helpers.values():
        of_road.setdefault(int(helper.lane_id.split("_")[0]), []).append(helper)
    for road in xodr.roads:
        for signal in road.signals if road.junction is not None else ():
            ranges = [sorted((valid.from_lane, valid.to_lane)) for valid in signal.validity]
            lane_ids = [
                helper.lane_id
                for helper in of_road.get(road.id, [])
                if helper.s_range[0] <= signal.s <= helper.s_range[1]
                and any(low <= helper.id <= high for low, high in ranges)
            ]
            if not lane_ids or signal.id in signals:
                continue
            signals[signal.id] = OpenDriveSignalHelper(signal.id, signal.type, lane_ids, None, signal)
            # Such a signal has no heading of its own; lanes on the left run against the road
            if all(low > 0 for low, _ in ranges):
                signal.h_offset = (signal.h_offset or 0.0) + np.pi


def _stop_zones(helpers: dict[str, Any], signals: dict[int, Any], xodr: XODR) -> list[StopZone]:
    posts = {}
    # Post of each signal: a point beside the reference line, with the heading of the traffic
    for road in xodr.roads:
        if road.signals:
            line = XODRReferenceLine.from_plan_view(
                road.plan_view, road.lanes.lane_offsets, road.elevation_profile.elevations
            )
            for signal in road.signals:
                s = min(signal.s, road.length)
                yaw = line.interpolate_se2(s)[2] + (signal.h_offset or 0.0)
                posts[signal.id] = (line.interpolate_3d(s, signal.t), normalize_angle(yaw))
    zones = []
    for signal_id, zone in create_stop_zones_from_signals(signals, helpers).items():
        driving = [i for i in zone.lane_ids if helpers[i].type == "driving"]
        kind = StopZoneKind(zone.stop_zone_type.name.lower())
        xyz, yaw = posts[signal_id]
        outline = zone.outline.array
        zones.append(StopZone(signal_id, kind, tuple(sorted(driving)), outline, xyz, float(yaw)))
    return zones


def junction_areas(strips: tuple[Strip, ...]) -> dict[int, shapely.Polygon | shapely.MultiPolygon]:
    """Return the area of each junction's driving lanes, seen from above."""
    parts: dict[int, list[shapely.Polygon]] = {}
    for strip in strips:
        if strip.junction_id is not None and strip.kind is StripKind.DRIVING:
            parts.setdefault(strip.junction_id, []).append(strip.polygon)
    # Growing and shrinking closes the slivers between lanes that only touch.
    return {key: shapely.union_all(p).buffer(0.25).buffer(-0.25) for key, p in sorted(parts.items())}
