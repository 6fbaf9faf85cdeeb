"""Maps of towns: lanes, cross-section strips, markings, crosswalks and stop zones, with heights."""

import enum
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from jaxtyping import Float64

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
    """One driving lane, in the direction of travel. The ids are py123d's.

    Its line is the middle of its strip, but for lanes that open from no width or end so: these branch off
    from the lane beside, or run into it, at full width.
    """

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


def marking_at(markings: tuple[Marking, ...], along_m: float) -> Marking | None:
    """Return the marking at a distance (m) from the start of its strip, or None."""
    return next((m for m in markings if m.start_m <= along_m < m.end_m), None)
