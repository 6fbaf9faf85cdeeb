"""The ground plan of a town's roads: pieces of cross-section strips without overlaps.

In junctions the strips of connecting roads overlap. Seen from above, each spot of a level belongs to the
piece of the highest rank: lanes before shoulders before walkways. Levels (a road over another) are treated
separately.
"""

import itertools
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from foredrive.geometry.polylines import arc_lengths
from foredrive.towns.map.town_map import Points, Strip, StripKind, TownMap

PIECE_SAMPLES = 8
LEVEL_GAP_M = 2.5
"""Height difference above which two pieces lie on different levels, m."""
OVERLAP_M2 = 0.02
BRIDGE_REACH_M = 14.0
BANK_SLOPE = 0.5
"""Maximum slope of an embankment. A road beside a lower road lies on an embankment down to the lower road if
the slope is at most this value, and on a bridge otherwise."""
JUNCTION_CLOSING_M = 2.0
JUNCTION_HOLE_M2 = 150.0
WALKWAY_RAISE_M = 0.15
STRAIGHT_M = 1e-3
BORDER_SPACING_M = 0.5

RANK = {
    StripKind.DRIVING: 0,
    StripKind.BIDIRECTIONAL: 0,
    StripKind.PARKING: 1,
    StripKind.BORDER: 1,
    StripKind.SHOULDER: 1,
    StripKind.NONE: 2,
    StripKind.MEDIAN: 3,
    StripKind.SIDEWALK: 4,
}
RAISED = frozenset({StripKind.MEDIAN, StripKind.SIDEWALK})


@dataclass(frozen=True)
class Piece:
    """A piece of a strip, a few metres long."""

    strip: Strip
    left_xyz: Points
    right_xyz: Points
    along_m: Float[np.ndarray, "N"]
    """Distance of each sample from the start of the strip, m."""
    area: shapely.Geometry
    """The area of the piece after clipping, seen from above."""
    whole: bool
    """True if clipping removed nothing."""
    bridge: bool

    @property
    def raise_m(self) -> float:
        """Return the height above the road, m."""
        return WALKWAY_RAISE_M if self.strip.kind in RAISED else 0.0

    def height(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Return the height of the road at points of the piece.

        The height is that of the nearest point of the piece's middle line.
        """
        middle = 0.5 * (self.left_xyz + self.right_xyz)
        # Foot of the perpendicular on each segment of the middle line, clamped to it
        start, step = middle[:-1, :2], np.diff(middle[:, :2], axis=0)
        offset = xy[:, None] - start
        t = (offset * step).sum(-1) / (step * step).sum(-1).clip(1e-9)
        t = t.clip(0.0, 1.0)
        distance = np.linalg.norm(offset - t[..., None] * step, axis=-1)
        # Height at the nearest one
        nearest = distance.argmin(axis=1)
        t = t[np.arange(len(xy)), nearest]
        return middle[nearest, 2] * (1 - t) + middle[nearest + 1, 2] * t


@dataclass(frozen=True)
class GroundPlan:
    """All pieces of a town and the areas they cover."""

    pieces: tuple[Piece, ...]
    fills: tuple[shapely.Polygon, ...]
    """Asphalt between the lanes of a junction."""
    lanes: shapely.Geometry
    """Driving lanes of all levels."""
    ground: shapely.Geometry
    """All paved area that lies on the ground, walkways and fills included."""
    bridges: shapely.Geometry
    """All area that bridges carry."""
    borders: "BorderHeights"

    @property
    def covered(self) -> shapely.Geometry:
        """Return all paved area of all levels."""
        return self.ground.union(self.bridges)


@dataclass(frozen=True)
class BorderHeights:
    """Heights along the borders of the pieces on the ground."""

    tree: cKDTree
    z: Float[np.ndarray, "N"]
    raised: Float[np.ndarray, "N"]

    def road(self, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """Return the height of the road at the border sample that is nearest to each point."""
        return self.z[self.tree.query(xy)[1]]

    def top(self, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """Return the height of the top surface at the nearest border sample.

        Walkways are higher than the road.
        """
        return self.raised[self.tree.query(xy)[1]]


@lru_cache(maxsize=1)  # several worlds are often generated on one town in a row
def make_ground_plan(town: TownMap) -> GroundPlan:
    """Cut a town's strips into pieces, clip the pieces, and fill the junctions."""
    # Strips are cut into pieces of some metres, so that levels and clipping are local
    parts = [part for strip in town.strips for part in _cut(strip)]
    whole = np.array(
        [shapely.Polygon(np.concatenate([left, right[::-1]])[:, :2]) for _, left, right, _ in parts]
    )
    # A buffer of 0 repairs outlines that cross themselves
    whole = shapely.buffer(whole, 0.0)
    z = np.array([left[:, 2].mean() for _, left, _, _ in parts])
    rank = np.array([RANK[strip.kind] for strip, *_ in parts])
    bridge = _on_bridges(whole, z)
    area, untouched = _clip(whole, z, rank)
    pieces = tuple(
        Piece(*part, area=a, whole=bool(u), bridge=bool(b))
        for part, a, u, b in zip(parts, area, untouched, bridge, strict=True)
        if not shapely.is_empty(a)
    )
    fills = _fill_junctions(pieces)
    grounded = [p.area for p in pieces if not p.bridge]
    return GroundPlan(
        pieces=pieces,
        fills=fills,
        # Lanes have rank 0
        lanes=shapely.union_all([p.area for p in pieces if RANK[p.strip.kind] == 0]),
        # A small buffer closes hairline gaps between pieces
        ground=shapely.union_all(shapely.buffer([*grounded, *fills], 0.01)),
        bridges=shapely.union_all([p.area for p in pieces if p.bridge]),
        borders=_border_heights([piece for piece in pieces if not piece.bridge]),
    )


def _border_heights(pieces: list[Piece]) -> BorderHeights:
    samples, raises = [], []
    # Samples of both borders: the land and the walls take their heights from there
    for piece in pieces:
        along_m = np.arange(piece.along_m[0], piece.along_m[-1], BORDER_SPACING_M)
        along_m = np.append(along_m, piece.along_m[-1])
        for line in (piece.left_xyz, piece.right_xyz):
            samples.append(np.column_stack([np.interp(along_m, piece.along_m, line[:, i]) for i in range(3)]))
            raises.append(np.full(len(along_m), piece.raise_m))
    xyz = np.concatenate(samples)
    return BorderHeights(cKDTree(xyz[:, :2]), xyz[:, 2], xyz[:, 2] + np.concatenate(raises))


def _cut(strip: Strip) -> list[tuple[Strip, Points, Points, Float[np.ndarray, "N"]]]:
    """Cut a strip into pieces of at most PIECE_SAMPLES sample intervals, on each of which the markings do not
    change.

    Samples on straight lines are left out.
    """
    middle = 0.5 * (strip.left_xyz + strip.right_xyz)
    along = arc_lengths(middle)
    # Strips without width or length have no surface
    if np.linalg.norm(strip.left_xyz - strip.right_xyz, axis=1).max() < 0.05 or along[-1] < 0.05:
        return []
    changes = {mark.start_m for mark in strip.left_markings + strip.right_markings}
    changes |= {mark.end_m for mark in strip.left_markings + strip.right_markings}
    # Cut where markings change, and every `PIECE_SAMPLES` intervals
    cuts = {int(np.abs(along - change).argmin()) for change in changes} | {0, len(along) - 1}
    cuts |= set(range(0, len(along), PIECE_SAMPLES))
    parts = []
    for first, last in itertools.pairwise(sorted(cuts)):
        chosen = np.arange(first, last + 1)
        both = np.concatenate([strip.left_xyz, strip.right_xyz], axis=1)[chosen]
        # Second differences of both borders show where they bend
        bend = np.abs(both[:-2] - 2 * both[1:-1] + both[2:]).max(axis=1) > STRAIGHT_M
        chosen = chosen[np.concatenate([[True], bend, [True]])]
        parts.append((strip, strip.left_xyz[chosen], strip.right_xyz[chosen], along[chosen]))
    return parts


def _on_bridges(area: np.ndarray, z: Float[np.ndarray, "P"]) -> Bool[np.ndarray, "P"]:
    """Return for each piece whether it is on a bridge: above, or close beside, a piece of a lower level."""
    # Candidates: pieces clearly above another one, and pieces clearly below another one
    high = np.flatnonzero(z - z.min() > LEVEL_GAP_M)
    low = np.flatnonzero(z.max() - z > LEVEL_GAP_M)
    i, j = shapely.STRtree(area[low]).query(area[high], predicate="dwithin", distance=BRIDGE_REACH_M)
    i, j = high[i], low[j]
    above = z[i] - z[j] > LEVEL_GAP_M
    i, j = i[above], j[above]
    # Steeper than an embankment between them: it must be a bridge
    steep = z[i] - z[j] > LEVEL_GAP_M + BANK_SLOPE * shapely.distance(area[i], area[j])
    bridge = np.zeros(len(area), dtype=bool)
    bridge[i[steep]] = True
    return bridge


def _clip(
    area: np.ndarray, z: Float[np.ndarray, "P"], rank: Int[np.ndarray, "P"]
) -> tuple[np.ndarray, Bool[np.ndarray, "P"]]:
    """Remove from each area its overlaps with areas of a higher rank on the same level."""
    i, j = shapely.STRtree(area).query(area, predicate="intersects")
    # Only areas of higher rank (a smaller number) on the same level cut
    near = (rank[j] < rank[i]) & (np.abs(z[i] - z[j]) < LEVEL_GAP_M)
    i, j = i[near], j[near]
    over = shapely.area(shapely.intersection(area[i], area[j])) > OVERLAP_M2
    i, j = i[over], j[over]
    clipped, untouched = area.copy(), np.ones(len(area), dtype=bool)
    for k in np.unique(i):
        clipped[k] = _polygons(shapely.difference(area[k], shapely.union_all(area[j[i == k]])))
        untouched[k] = False
    return clipped, untouched


def _polygons(geometry: shapely.Geometry) -> shapely.Geometry:
    """Return only the polygons of a geometry, without slivers."""
    # Opening with 1 cm removes slivers
    opened = geometry.buffer(-0.01).buffer(0.01, join_style="mitre")
    parts = shapely.get_parts(opened)
    return shapely.union_all([p for p in parts if p.geom_type == "Polygon" and p.area > OVERLAP_M2])


def _fill_junctions(pieces: tuple[Piece, ...]) -> tuple[shapely.Polygon, ...]:
    """Return the areas inside junctions that no strip covers."""
    areas = np.array([p.area for p in pieces])
    tree = shapely.STRtree(areas)
    by_junction: dict[int, list[shapely.Geometry]] = {}
    for piece in pieces:
        if piece.strip.junction_id is not None and piece.strip.kind not in RAISED and not piece.bridge:
            by_junction.setdefault(piece.strip.junction_id, []).append(piece.area)
    fills = []
    for _, parts in sorted(by_junction.items()):
        # Closing joins the lanes of a junction; large holes stay open
        closed = shapely.union_all(parts).buffer(JUNCTION_CLOSING_M).buffer(-JUNCTION_CLOSING_M)
        shells = [
            shapely.Polygon(
                p.exterior, [h for h in p.interiors if shapely.Polygon(h).area > JUNCTION_HOLE_M2]
            )
            for p in shapely.get_parts(closed)
        ]
        shell = shapely.union_all(shells)
        # What no other strip covers is paved
        rest = _polygons(shell.difference(shapely.union_all(areas[tree.query(shell)])))
        fills += [p for p in shapely.get_parts(rest) if p.area > OVERLAP_M2]
    return tuple(fills)
