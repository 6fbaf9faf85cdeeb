"""A graph of walkways and of crossings, with the lanes that the crossings cross."""

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from jaxtyping import Bool, Float64, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from foredrive.geometry.polylines import arc_lengths, points_at
from foredrive.towns.map.ground_plan import WALKWAY_RAISE_M
from foredrive.towns.map.town_map import StripKind, TownMap
from foredrive.towns.traffic.lane_graph import LaneControl, LaneGraph

JOIN_M = 1.5
"""Distance below which ends of walkways are one place, m."""
REACH_M = 7.0
"""Maximum distance from the end of a crosswalk to a walkway, m."""
MARKED_NEARBY_M = 15.0
PAST_LINE_M = 1.5
MAX_CROSSING_M = 28.0
MIN_KERB_M = 1.0
MIN_WALK_M = 0.5
ALONG_LANE_M = 1.7
"""Half the length of lane that people on a crossing may occupy, m."""
ACROSS_LANE_M = 2.2
"""Half the length of crossing that vehicles on a lane may occupy, with a margin, m."""


@dataclass(frozen=True)
class WalkGraph:
    """A graph of E walks (polylines) between V places.

    The vertices are stored end to end in `xyz`, as in a lane graph.
    """

    xyz: Float64[np.ndarray, "P 3"]
    along_m: Float64[np.ndarray, "P"]
    """Arc length of each vertex on its walk, m."""
    first: Int[np.ndarray, "E_1"]
    length_m: Float64[np.ndarray, "E"]
    ends: Int[np.ndarray, "E 2"]
    """Places at the start and the end of each walk."""
    is_crossing: Bool[np.ndarray, "E"]
    half_width_m: Float64[np.ndarray, "E"]
    """Maximum distance of people from the middle of the walk, m, to either side."""
    incident: Int[np.ndarray, "V I"]
    """Walks that meet at each place, padded with -1."""
    crossing: Int[np.ndarray, "K"]
    """Walk of each of the K places where a crossing and a lane meet, sorted by lane."""
    lane: Int[np.ndarray, "K"]
    lane_span_m: Float64[np.ndarray, "K 2"]
    """Arc length range on the lane in which people cross, m."""
    walk_span_m: Float64[np.ndarray, "K 2"]
    """Arc length range on the crossing in which vehicles pass, m."""

    def position(
        self, walk: Int[np.ndarray, "n"], s_m: Float64[np.ndarray, "n"]
    ) -> Float64[np.ndarray, "n 3"]:
        """Return points on walks at given arc lengths."""
        point, _ = self._locate(walk, s_m)
        return point

    def right_of(
        self, walk: Int[np.ndarray, "n"], s_m: Float64[np.ndarray, "n"]
    ) -> Float64[np.ndarray, "n 3"]:
        """Return horizontal unit vectors to the right of the walks' direction."""
        _, ahead = self._locate(walk, s_m)
        right = np.stack([ahead[:, 1], -ahead[:, 0], np.zeros(len(ahead))], axis=1)
        return right / np.linalg.norm(right, axis=1, keepdims=True).clip(1e-9)

    @cached_property
    def _axis(self) -> tuple[Float64[np.ndarray, "E"], Float64[np.ndarray, "P"]]:
        """Return one sorted axis for all walks: the origins of the walks and the vertices on the axis.

        Walk e covers [origin[e], origin[e] + length[e]].
        """
        # A gap of 1 m between walks keeps their ranges on the axis apart
        origin = np.cumsum(self.length_m + 1.0) - self.length_m - 1.0
        return origin, self.along_m + np.repeat(origin, np.diff(self.first))

    def _locate(self, walk: np.ndarray, s_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        origin, axis = self._axis
        s = np.clip(s_m, 0.0, self.length_m[walk])
        # One binary search for all walks: the vertex before the point
        i = np.searchsorted(axis, origin[walk] + s, side="right") - 1
        i = np.clip(i, self.first[walk], self.first[walk + 1] - 2)
        leg = self.xyz[i + 1] - self.xyz[i]
        # Position within the leg; legs of length 0 give the vertex
        fraction = (s - self.along_m[i]) / (self.along_m[i + 1] - self.along_m[i]).clip(1e-9)
        return self.xyz[i] + fraction[:, None] * leg, leg


def build_walk_graph(town: TownMap, lanes: LaneGraph) -> WalkGraph:
    """Build the graph from walkways, marked crosswalks, and unmarked crossings at lights that have no
    crosswalk."""
    # Walkways: the middle line of each sidewalk strip, raised to the height of the kerb
    strips = [s for s in town.strips_of(StripKind.SIDEWALK) if len(s.left_xyz) > 1]
    walks = [0.5 * (s.left_xyz + s.right_xyz) + [0.0, 0.0, WALKWAY_RAISE_M] for s in strips]
    widths = [float(np.linalg.norm(s.left_xyz - s.right_xyz, axis=1).min()) for s in strips]
    kept = [i for i, walk in enumerate(walks) if _length(walk) > MIN_WALK_M and widths[i] > 0.8]
    walks, widths = [walks[i] for i in kept], [widths[i] for i in kept]
    # Crossings join two walkways; these are cut where crossings are attached
    crossings = _crossings(town, lanes, walks, widths)
    cuts: list[list[float]] = [[] for _ in walks]
    lines = [shapely.LineString(walk[:, :2]) for walk in walks]
    for walk_index, point in ((i, p) for crossing in crossings for i, p in crossing.attached):
        cuts[walk_index].append(float(lines[walk_index].project(shapely.Point(point[:2]))))
    pieces = [
        (piece, w)
        for walk, cuts_of_walk, w in zip(walks, cuts, widths, strict=True)
        for piece in _cut(walk, cuts_of_walk)
    ]
    every = [piece for piece, _ in pieces] + [c.xyz for c in crossings]
    # People keep half a metre from the edges
    half = np.array([max(0.1, 0.5 * w - 0.5) for _, w in pieces] + [1.0] * len(crossings))
    is_crossing = np.arange(len(every)) >= len(pieces)
    counts = np.array([len(line) for line in every], dtype=np.int64)
    ends, incident = _join(every)
    meeting = _crossed_lanes(every, is_crossing, lanes)
    return WalkGraph(
        xyz=np.concatenate(every) if every else np.zeros((0, 3)),
        along_m=np.concatenate([arc_lengths(line) for line in every]) if every else np.zeros(0),
        first=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        length_m=np.array([_length(line) for line in every]),
        ends=ends,
        is_crossing=is_crossing,
        half_width_m=half,
        incident=incident,
        crossing=meeting[:, 0].astype(np.int64),
        lane=meeting[:, 1].astype(np.int64),
        lane_span_m=meeting[:, 2:4],
        walk_span_m=meeting[:, 4:6],
    )


# Middle line of the crossing with its attachments
@dataclass(frozen=True)
class _Crossing:
    xyz: Float64[np.ndarray, "_ 3"]
    attached: tuple[tuple[int, np.ndarray], tuple[int, np.ndarray]]
    """Walkways that the crossing joins, each with its joining point."""


def _crossings(
    town: TownMap, lanes: LaneGraph, walks: list[np.ndarray], widths_m: list[float]
) -> list[_Crossing]:
    if not walks:
        return []
    lines = shapely.STRtree([shapely.LineString(walk[:, :2]) for walk in walks])
    # Marked crosswalks first, then lights without a crosswalk nearby
    chords = [_chord(crosswalk.outline_xyz, lines) for crosswalk in town.crosswalks]
    marked = np.array([c.outline_xyz[:-1].mean(axis=0) for c in town.crosswalks]).reshape(-1, 3)
    for zone in np.unique(lanes.zone[lanes.control == LaneControl.LIGHT]):
        start = lanes.position(np.flatnonzero(lanes.zone == zone)[:1], np.array([PAST_LINE_M]))[0]
        # An unmarked crossing just behind the line, straight across the road
        if np.linalg.norm(marked - start, axis=1).min(initial=np.inf) > MARKED_NEARBY_M:
            lane = int(np.flatnonzero(lanes.zone == zone)[0])
            chords.append(_perpendicular(start, lanes.samples(lane)[:2], lines, widths_m))
    crossings = []
    for chord in chords:
        if chord is None:
            continue
        # Both ends need a walkway within reach, and two different ones
        attached = [_attach(end, lines, walks) for end in chord]
        a, b = attached
        if a is None or b is None or a[0] == b[0]:
            continue
        # The crossing includes the ways from the walkways to the kerb
        xyz = np.stack([a[1], chord[0], chord[1], b[1]])
        if _length(xyz) < MAX_CROSSING_M:
            crossings.append(_Crossing(_without_repeats(xyz), (a, b)))
    return crossings


def _chord(outline: Float64[np.ndarray, "_ 3"], walkways: shapely.STRtree) -> np.ndarray | None:
    """Return the middle line of a crosswalk, between the two opposite sides that are closer to walkways."""
    # A crosswalk is a rotated rectangle; its middle line runs between two opposite sides
    box = shapely.minimum_rotated_rectangle(shapely.Polygon(outline[:, :2]))
    if not isinstance(box, shapely.Polygon):
        return None
    corners = np.asarray(box.exterior.coords)[:4]
    middles = 0.5 * (corners + np.roll(corners, -1, axis=0))
    z = np.full((2, 1), outline[:, 2].mean())
    chords = [np.hstack([middles[[i, i + 2]], z]) for i in (0, 1)]
    # Of the two middle lines, the one whose ends are closer to walkways leads across the road
    return min(chords, key=lambda chord: sum(_distance(end, walkways) for end in chord))


def _perpendicular(
    start: Float64[np.ndarray, "3"],
    lane: Float64[np.ndarray, "2 3"],
    walkways: shapely.STRtree,
    widths_m: list[float],
) -> np.ndarray | None:
    """Return a line straight across the road, from kerb to kerb, or None."""
    ahead = (lane[1] - lane[0])[:2] / np.linalg.norm((lane[1] - lane[0])[:2])
    here, ends = shapely.Point(start[:2]), []
    # To both sides: the nearest walkway on the ray, less half its width, is the kerb
    for side in (np.array([-ahead[1], ahead[0]]), np.array([ahead[1], -ahead[0]])):
        ray = shapely.LineString([start[:2], start[:2] + MAX_CROSSING_M * side])
        to_kerb = [
            here.distance(ray.intersection(walkways.geometries[i])) - 0.5 * widths_m[i]
            for i in walkways.query(ray, predicate="intersects")
        ]
        # No walkway, or the line starts on it
        if min(to_kerb, default=0.0) < MIN_KERB_M:
            return None
        ends.append(np.append(start[:2] + min(to_kerb) * side, start[2]))
    return np.stack(ends)


def _distance(point: np.ndarray, walkways: shapely.STRtree) -> float:
    where = shapely.Point(point[:2])
    return float(where.distance(walkways.geometries[walkways.nearest(where)]))


def _attach(
    point: np.ndarray, walkways: shapely.STRtree, walks: list[np.ndarray]
) -> tuple[int, np.ndarray] | None:
    where = shapely.Point(point[:2])
    index = int(walkways.nearest(where))
    line = walkways.geometries[index]
    if where.distance(line) > REACH_M:
        return None
    # Arc length seen from above, scaled to the walk's length in 3-D
    at_m = line.project(where) * _length(walks[index]) / line.length
    return index, points_at(walks[index], arc_lengths(walks[index]), at_m)


def _length(line: Float64[np.ndarray, "_ 3"]) -> float:
    return float(arc_lengths(line)[-1])


def _without_repeats(line: Float64[np.ndarray, "_ 3"]) -> Float64[np.ndarray, "_ 3"]:
    return line[np.concatenate([[True], np.linalg.norm(np.diff(line, axis=0), axis=1) > 1e-3])]


def _cut(line: Float64[np.ndarray, "_ 3"], at_flat_m: list[float]) -> list[Float64[np.ndarray, "_ 3"]]:
    """Cut a walk at the points (arc length seen from above, m) where crossings join it."""
    along = arc_lengths(line)
    flat = arc_lengths(line[:, :2])
    # Cut points as arc lengths in 3-D; unique also sorts them
    stops = np.unique(np.interp([0.0, *at_flat_m, flat[-1]], flat, along))
    pieces = []
    for a, b in itertools.pairwise(stops.tolist()):
        inner = line[(along > a + 1e-3) & (along < b - 1e-3)]
        pieces.append(np.vstack([points_at(line, along, a), inner, points_at(line, along, b)]))
    return [piece for piece in pieces if _length(piece) > 1e-2]


def _join(walks: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the places at the ends of the walks, and the walks that meet at each place."""
    if not walks:
        return np.zeros((0, 2), dtype=np.int64), np.zeros((0, 1), dtype=np.int64)
    # Ends closer than `JOIN_M` are one place: connected components of the graph of close pairs
    tips = np.concatenate([line[[0, -1]] for line in walks])
    pairs = cKDTree(tips).query_pairs(JOIN_M, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(tips), len(tips)))
    count, place = connected_components(links, directed=False)
    rows: list[list[int]] = [[] for _ in range(count)]
    for tip, where in enumerate(place.tolist()):
        # Tips 2 i and 2 i + 1 are the start and the end of walk i
        rows[where].append(tip // 2)
    incident = np.full((count, max(map(len, rows))), -1)
    for row, values in zip(incident, rows, strict=True):
        row[: len(values)] = values
    return place.reshape(-1, 2).astype(np.int64), incident


def _crossed_lanes(walks: list[np.ndarray], is_crossing: np.ndarray, lanes: LaneGraph) -> np.ndarray:
    """Return rows of crossing, lane, range on the lane and range on the crossing, sorted by lane."""
    rows = []
    lines = [shapely.LineString(lanes.samples(i)[:, :2]) for i in range(len(lanes.ids))]
    tree = shapely.STRtree(lines)
    for walk in np.flatnonzero(is_crossing):
        way = shapely.LineString(walks[walk][:, :2])
        for lane in tree.query(way, predicate="intersects").tolist():
            points = lanes.samples(lane)
            # Samples of the lane that people on the crossing may occupy, on the same level
            near = shapely.distance(shapely.points(points[:, :2]), way) < ALONG_LANE_M
            near &= np.abs(points[:, 2] - walks[walk][:, 2].mean()) < 3.0
            if not near.any():
                continue
            on_lane = np.flatnonzero(near)[[0, -1]] * lanes.step_m[lane]
            # Where the lane passes on the crossing, with a margin
            on_walk = shapely.line_locate_point(way, shapely.points(points[near, :2]))  # some run along it
            rows.append([walk, lane, *on_lane, on_walk.min() - ACROSS_LANE_M, on_walk.max() + ACROSS_LANE_M])
    table = np.array(rows).reshape(-1, 6)
    # Sorted by lane, then by crossing
    return table[np.lexsort((table[:, 0], table[:, 1]))]
