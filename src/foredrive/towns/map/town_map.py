"""Maps of CARLA's towns: lanes, cross-section strips, markings, crosswalks and stop zones, with heights.

The maps are the OpenDRIVE files in py123d's wheel (CARLA, CC BY 4.0), read with py123d's parser.
"""

import dataclasses
import enum
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import py123d.parser.opendrive
import shapely
from jaxtyping import Float64
from py123d.geometry.utils.rotation_utils import normalize_angle
from py123d.parser.opendrive.utils.collection import collect_element_helpers
from py123d.parser.opendrive.utils.stop_zone_helper import create_stop_zones_from_signals
from py123d.parser.opendrive.xodr_parser.opendrive import XODR
from py123d.parser.opendrive.xodr_parser.reference import XODRReferenceLine

from foredrive.towns.map.junction_heights import level_junction
from foredrive.towns.map.names import check_town

MAP_FOLDER = Path(py123d.parser.opendrive.__file__).parent / "carla_maps"
SAMPLE_SPACING_M = 1.0
CONNECTION_TOLERANCE_M = 0.1
MIN_MARKING_M = 0.1
DEFAULT_LINE_WIDTH_M = 0.125

Points = Float64[np.ndarray, "N 3"]


class StripKind(enum.StrEnum):
    """The use of one strip of a road's cross-section (OpenDRIVE's lane types)."""

    DRIVING = "driving"
    SHOULDER = "shoulder"
    SIDEWALK = "sidewalk"
    PARKING = "parking"
    MEDIAN = "median"
    BORDER = "border"
    BIDIRECTIONAL = "bidirectional"
    NONE = "none"


class MarkingKind(enum.StrEnum):
    """The paint or kerb of a strip boundary (OpenDRIVE's road mark types)."""

    NONE = "none"
    SOLID = "solid"
    BROKEN = "broken"
    SOLID_SOLID = "solid solid"
    SOLID_BROKEN = "solid broken"
    BROKEN_SOLID = "broken solid"
    BROKEN_BROKEN = "broken broken"
    CURB = "curb"


class StopZoneKind(enum.StrEnum):
    """The type of signal that makes vehicles stop."""

    TRAFFIC_LIGHT = "traffic_light"
    STOP_SIGN = "stop_sign"
    YIELD_SIGN = "yield_sign"


@dataclass(frozen=True)
class Marking:
    """A painted line or a kerb along a part of a strip's border."""

    start_m: float
    """Distance from the start of the strip in the direction of travel, m."""
    end_m: float
    kind: MarkingKind
    """Kind as seen from the strip: of two lines, the strip's own line comes first."""
    yellow: bool
    width_m: float


@dataclass(frozen=True)
class Strip:
    """One strip of a road's cross-section.

    Both borders have the same number of samples, in the direction of travel.
    """

    id: str
    kind: StripKind
    road_id: int
    junction_id: int | None
    left_xyz: Points
    right_xyz: Points
    left_markings: tuple[Marking, ...]
    right_markings: tuple[Marking, ...]

    @cached_property
    def outline_xyz(self) -> Points:
        """Return the closed outline."""
        return np.concatenate([self.left_xyz, self.right_xyz[::-1], self.left_xyz[:1]])

    @cached_property
    def polygon(self) -> shapely.Polygon:
        """Return the outline seen from above, made valid."""
        return shapely.Polygon(self.outline_xyz[:, :2]).buffer(0)


@dataclass(frozen=True)
class Lane:
    """One driving lane, in the direction of travel. The ids are py123d's."""

    lane_id: str
    group_id: str
    """Id shared by the lanes that lie side by side in one direction."""
    junction_id: int | None
    centreline_xyz: Points
    left_boundary_xyz: Points
    right_boundary_xyz: Points
    speed_limit_mps: float | None
    successor_ids: tuple[str, ...]
    """Ids of the next lanes. Where two lanes merge, a successor may begin half a lane or more to the side
    (once in Town03)."""
    predecessor_ids: tuple[str, ...]
    left_id: str | None
    """Id of the left neighbour with the same direction of travel."""
    right_id: str | None
    left_marking: MarkingKind
    """Marking at half length, as seen from the lane. It says whether the line may be crossed."""
    right_marking: MarkingKind

    @cached_property
    def width_m(self) -> float:
        """Return the median width, m."""
        return float(np.median(np.linalg.norm(self.left_boundary_xyz - self.right_boundary_xyz, axis=1)))


@dataclass(frozen=True)
class Crosswalk:
    """A pedestrian crossing."""

    id: int
    outline_xyz: Points
    """Closed outline."""


@dataclass(frozen=True)
class StopZone:
    """The half metre behind the stop line of a light or a sign."""

    id: int
    kind: StopZoneKind
    lane_ids: tuple[str, ...]
    """Ids of the lanes that begin at the line (inside the junction)."""
    outline_xyz: Points
    """Closed outline."""
    post_xyz: Float64[np.ndarray, "3"]
    """Foot of the post that holds the light or the sign."""
    post_yaw: float
    """Direction of travel of the traffic that has to obey, rad. The signal faces the opposite way."""


@dataclass(frozen=True, eq=False)  # hashed by identity: derived values are cached by it
class TownMap:
    """A town's road network in the world frame (m, z up), with traffic on the right."""

    name: str
    lanes: tuple[Lane, ...]
    strips: tuple[Strip, ...]
    """All strips of all cross-sections, driving lanes included."""
    crosswalks: tuple[Crosswalk, ...]
    stop_zones: tuple[StopZone, ...]
    junctions: dict[int, shapely.Polygon | shapely.MultiPolygon]
    """Area of each junction's driving lanes, seen from above."""

    def strips_of(self, *kinds: StripKind) -> tuple[Strip, ...]:
        """Return the strips of the given kinds, for example SIDEWALK for walkways or PARKING for car
        parks."""
        return tuple(strip for strip in self.strips if strip.kind in kinds)

    @cached_property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """Return the smallest x, y and the largest x, y of all strips, m."""
        every = np.concatenate([strip.outline_xyz for strip in self.strips])
        (x0, y0), (x1, y1) = every[:, :2].min(0), every[:, :2].max(0)
        return float(x0), float(y0), float(x1), float(y1)


@lru_cache(maxsize=2)
def load_town_map(name: str) -> TownMap:
    """Read a town's map (takes 0.2 to 2 s).

    Raises:
        InputError: there is no such town.
    """
    check_town(name)
    xodr = XODR.parse_from_file(MAP_FOLDER / f"{name}.xodr.gz")
    roads, _, helpers, _, objects, centre_marks, signals = collect_element_helpers(
        xodr, SAMPLE_SPACING_M, CONNECTION_TOLERANCE_M
    )
    # Heights from the elevation profile, then junctions brought to one height
    strips = _level([_strip(helper, helpers, centre_marks, roads) for helper in helpers.values()])
    lanes = tuple(_lane(strip, helpers) for strip in strips if strip.kind is StripKind.DRIVING)
    crosswalks = tuple(
        Crosswalk(o.object_id, np.concatenate([o.outline_3d, o.outline_3d[:1]])) for o in objects.values()
    )
    return TownMap(
        name=name,
        lanes=lanes,
        strips=strips,
        crosswalks=crosswalks,
        stop_zones=tuple(_stop_zones(helpers, signals, xodr)),
        junctions=_junctions(strips),
    )


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
    return Strip(
        id=helper.lane_id,
        kind=StripKind(helper.type if helper.type in set(StripKind) else StripKind.NONE),
        road_id=road.id,
        junction_id=None if road.junction is None else int(road.junction),
        left_xyz=_with_road_height(helper, helper.inner_polyline_3d.array, roads),
        right_xyz=_with_road_height(helper, helper.outer_polyline_3d.array, roads),
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


def marking_at(markings: tuple[Marking, ...], along_m: float) -> Marking | None:
    """Return the marking at a distance (m) from the start of its strip, or None."""
    return next((m for m in markings if m.start_m <= along_m < m.end_m), None)


def _lane(strip: Strip, helpers: dict[str, Any]) -> Lane:
    helper = helpers[strip.id]

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
        centreline_xyz=0.5 * (strip.left_xyz + strip.right_xyz),
        left_boundary_xyz=strip.left_xyz,
        right_boundary_xyz=strip.right_xyz,
        speed_limit_mps=None if limit is None else float(limit),
        successor_ids=driving(helper.successor_lane_ids),
        predecessor_ids=driving(helper.predecessor_lane_ids),
        left_id=next(iter(driving([_beside(helper, -1)])), None),
        right_id=next(iter(driving([_beside(helper, 1)])), None),
        left_marking=kind_halfway(strip.left_markings),
        right_marking=kind_halfway(strip.right_markings),
    )


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


def _junctions(strips: tuple[Strip, ...]) -> dict[int, shapely.Polygon | shapely.MultiPolygon]:
    parts: dict[int, list[shapely.Polygon]] = {}
    for strip in strips:
        if strip.junction_id is not None and strip.kind is StripKind.DRIVING:
            parts.setdefault(strip.junction_id, []).append(strip.polygon)
    # Growing and shrinking closes the slivers between lanes that only touch.
    return {key: shapely.union_all(p).buffer(0.25).buffer(-0.25) for key, p in sorted(parts.items())}
