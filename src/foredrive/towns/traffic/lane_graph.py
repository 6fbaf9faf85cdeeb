"""A town's lanes as flat arrays: geometry by arc length, neighbours, places where paths meet, and
controls."""

import dataclasses
import enum
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy.spatial import cKDTree

from foredrive.scene import Command
from foredrive.towns.map.town_map import Lane, MarkingKind, StopZoneKind, TownMap
from foredrive.towns.traffic.centrelines import (
    curvatures,
    headings,
    join_centrelines,
    resample,
    speed_profile,
)
from foredrive.towns.traffic.lane_overlaps import LaneOverlaps, find_overlaps

TURN_RAD = np.deg2rad(30.0)
CITY_SPEED_MPS = 13.9
"""Maximum speed in the city, m/s. The towns' files give most city streets the 55 mph of their OpenDRIVE road
type; traffic there drives at most 50 km/h. Lanes with a limit above `MOTORWAY_LIMIT_MPS` are driven as
posted."""
MOTORWAY_LIMIT_MPS = 26.0
BEFORE_LIGHT_M = 40.0
"""Distance before a light in which traffic drives at most `CITY_SPEED_MPS`, m. A faster vehicle could neither
stop for the light nor pass it while it is yellow."""
WAITING_ROOM_M = 12.0
MIN_OPEN_WIDTH_M = 2.8
CROSSABLE = (
    MarkingKind.NONE,
    MarkingKind.BROKEN,
    MarkingKind.BROKEN_BROKEN,
    MarkingKind.BROKEN_SOLID,
)
"""Lines between lanes of one direction that may be crossed, as seen from the lane."""


class LaneControl(enum.IntEnum):
    """The control at the start of a lane."""

    NONE = 0
    LIGHT = 1
    STOP = 2
    YIELD = 3


CONTROL_OF_ZONE = {
    StopZoneKind.TRAFFIC_LIGHT: LaneControl.LIGHT,
    StopZoneKind.STOP_SIGN: LaneControl.STOP,
    StopZoneKind.YIELD_SIGN: LaneControl.YIELD,
}


class Neighbours(NamedTuple):
    """Left and right neighbours, as arguments of compiled functions."""

    lane: Int[np.ndarray, "2 L"]
    """Neighbour, -1 for none."""
    neighbour_s_m: Float64[np.ndarray, "2 P"]
    """Arc length on the neighbour of the point beside each sample of a lane, m."""
    first: Int[np.ndarray, "L"]
    sample_count: Int[np.ndarray, "L"]
    step_m: Float64[np.ndarray, "L"]


@dataclass(frozen=True)
class LaneGraph:
    """L lanes. Centrelines are sampled evenly, at most `SAMPLE_M` apart, and stored end to end in `xyz`."""

    ids: tuple[str, ...]
    """Lane ids of the map. Where the map cuts a path through a junction into pieces, it is one lane here,
    with the id of the first piece."""
    xyz: Float64[np.ndarray, "P 3"]
    speed_mps: Float64[np.ndarray, "P"]
    """Driving speed, m/s: the minimum of the limit and of comfort in curves, reduced in time for later parts
    of the lane."""
    first: Int[np.ndarray, "L"]
    count: Int[np.ndarray, "L"]
    step_m: Float64[np.ndarray, "L"]
    length_m: Float64[np.ndarray, "L"]
    limit_mps: Float64[np.ndarray, "L"]
    """Speed limit that traffic obeys, m/s (see `CITY_SPEED_MPS`)."""
    width_m: Float64[np.ndarray, "L"]
    min_radius_m: Float64[np.ndarray, "L"]
    """Smallest radius of the centreline, m."""
    turn_rad: Float64[np.ndarray, "L"]
    """Change of the heading over the lane, rad, positive to the left."""
    successors: Int[np.ndarray, "L S"]
    """Successors, padded with -1."""
    successor_count: Int[np.ndarray, "L"]
    predecessors: Int[np.ndarray, "L Q"]
    left: Int[np.ndarray, "L"]
    """Left neighbour of the same direction, -1 for none; `right` likewise."""
    right: Int[np.ndarray, "L"]
    sides: Neighbours
    may_cross: Bool[np.ndarray, "2 L"]
    """Whether a vehicle may change to the left and the right neighbour: not over solid lines, not in
    junctions."""
    junction: Int[np.ndarray, "L"]
    """Junction id, -1 outside junctions."""
    control: Int[np.ndarray, "L"]
    """`LaneControl` at the start of the lane."""
    zone: Int[np.ndarray, "L"]
    """Index of the stop zone that guards the lane, -1 for none."""
    siblings: LaneOverlaps
    """Lanes that part from a common start. A vehicle ahead on a sibling stays a leader until it is clear."""
    conflicts: LaneOverlaps
    """Lanes that cross or merge. Only one vehicle at a time may use such a place."""

    contested: Bool[np.ndarray, "L"]
    """Lanes that may be entered only with right of way: lanes that others cross, and the lanes before them
    that leave no room to wait."""

    def position(
        self, lane: Int[np.ndarray, "*n"], s_m: Float64[np.ndarray, "*n"]
    ) -> Float64[np.ndarray, "*n 3"]:
        """Return points on centrelines at given arc lengths, clamped to the lane."""
        i, fraction = self._sample(lane, s_m)
        a = self.xyz[i]
        return a + fraction[..., None] * (self.xyz[i + 1] - a)

    def speed(self, lane: Int[np.ndarray, "*n"], s_m: Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
        """Return the driving speed at points of lanes, m/s."""
        i, fraction = self._sample(lane, s_m)
        a = self.speed_mps[i]
        return a + fraction * (self.speed_mps[i + 1] - a)

    def samples(self, lane: int) -> Float64[np.ndarray, "n 3"]:
        """Return the centreline of one lane."""
        return self.xyz[self.first[lane] : self.first[lane] + self.count[lane]]

    def _sample(self, lane: np.ndarray, s_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # Sample number and the fraction to the next one; the last sample belongs to the last interval
        steps = np.clip(s_m / self.step_m[lane], 0, self.count[lane] - 1)
        i = np.minimum(steps.astype(np.int64), self.count[lane] - 2)
        return self.first[lane] + i, steps - i

    def command(self, lane: int) -> Command:
        """Return the command of a lane by its change of heading, STRAIGHT outside junctions."""
        if self.junction[lane] < 0 or abs(self.turn_rad[lane]) < TURN_RAD:
            return Command.STRAIGHT
        return Command.LEFT if self.turn_rad[lane] > 0 else Command.RIGHT


@lru_cache(maxsize=1)  # several drives in a row are often in one town
def build_lane_graph(town: TownMap) -> LaneGraph:
    """Build the lane graph of a town."""
    # Order matters: geometry first, then controls, limits and conflicts that build on it
    lanes, index = _merge_connectors(town.lanes)
    lines = [resample(line) for line in join_centrelines(lanes, index)]
    length = np.array([np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in lines])
    curves = [curvatures(line) for line in lines]
    control, zone = _lane_controls(town, index, len(lanes))
    limit = np.array([_limit(lane.speed_limit_mps) for lane in lanes])
    count = np.array([len(line) for line in lines])
    successors = [[index[i] for i in lane.successor_ids] for lane in lanes]
    # Traffic slows to city speed before and at lights
    limit = np.where(control == LaneControl.LIGHT, np.minimum(limit, CITY_SPEED_MPS), limit)
    to_light = _to_light_m(control == LaneControl.LIGHT, length, successors)
    limits = [_limits(*lane) for lane in zip(limit, length, lines, to_light, strict=True)]
    predecessors = [[index[i] for i in lane.predecessor_ids] for lane in lanes]
    junction = np.array([-1 if lane.junction_id is None else lane.junction_id for lane in lanes])
    groups = [lane.group_id for lane in lanes]
    # Overlaps decide right of way: siblings part from one start, conflicts cross or merge
    siblings, conflicts = find_overlaps(lines, length, successors, predecessors, junction, groups)
    beside = np.array([[index.get(i or "", -1) for i in (lane.left_id, lane.right_id)] for lane in lanes]).T
    return LaneGraph(
        ids=tuple(lane.lane_id for lane in lanes),
        xyz=np.concatenate(lines),
        speed_mps=np.concatenate([speed_profile(*lane) for lane in zip(curves, limits, length, strict=True)]),
        first=np.cumsum(count) - count,
        count=count,
        step_m=length / (count - 1),
        length_m=length,
        limit_mps=limit,
        width_m=np.array([lane.width_m for lane in lanes]),
        # Curvature 0 would be an infinite radius: clip at 1e6 m
        min_radius_m=np.array([1 / np.abs(curvature).max().clip(1e-6) for curvature in curves]),
        turn_rad=np.array([headings(line)[-1] - headings(line)[0] for line in lines]),
        successors=_padded(successors),
        successor_count=np.array([len(row) for row in successors]),
        predecessors=_padded(predecessors),
        left=beside[0],
        right=beside[1],
        sides=_sides(lines, beside, count, length / (count - 1)),
        # Lane changes are not allowed within junctions
        may_cross=(junction < 0) & _crossable(lanes),
        junction=junction,
        control=control,
        zone=zone,
        siblings=siblings,
        conflicts=conflicts,
        contested=_contested(
            (np.diff(conflicts.first) > 0) | (control != LaneControl.NONE),
            length,
            successors,
            predecessors,
            junction,
        ),
    )


def _merge_connectors(lanes: tuple[Lane, ...]) -> tuple[list[Lane], dict[str, int]]:
    """Join the pieces of each path through a junction into one lane.

    Also return the new index of every original lane. Maps cut lanes where the cross-section of the road
    changes; the places where other lanes cross would be cut as well.
    """
    # A piece is continued by its only successor if that lies in
    # the same junction and has no other predecessor
    by_id = {lane.lane_id: lane for lane in lanes}

    def continued_by(lane: Lane) -> Lane | None:
        following = by_id[lane.successor_ids[0]] if len(lane.successor_ids) == 1 else None
        if following is None or lane.junction_id is None or following.junction_id != lane.junction_id:
            return None
        return following if following.predecessor_ids == (lane.lane_id,) else None

    # Pieces that continue another one do not begin a lane of their own
    absorbed = {following.lane_id for lane in lanes if (following := continued_by(lane))}
    whole: list[Lane] = []
    index: dict[str, int] = {}
    for lane in lanes:
        if lane.lane_id in absorbed:
            continue
        pieces = [lane]
        while following := continued_by(pieces[-1]):
            pieces.append(following)
        # All pieces map to the index of the whole
        index.update({piece.lane_id: len(whole) for piece in pieces})
        whole.append(
            dataclasses.replace(
                lane,
                successor_ids=pieces[-1].successor_ids,
                centreline_xyz=_concatenated([piece.centreline_xyz for piece in pieces]),
                left_boundary_xyz=_concatenated([piece.left_boundary_xyz for piece in pieces]),
                right_boundary_xyz=_concatenated([piece.right_boundary_xyz for piece in pieces]),
            )
        )
    return whole, index


def _concatenated(lines: list[Float64[np.ndarray, "_ 3"]]) -> Float64[np.ndarray, "_ 3"]:
    """Join lines that continue each other into one."""
    # The first point of each piece repeats the last one of the piece before
    return np.concatenate([lines[0]] + [line[1:] for line in lines[1:]])


def _contested(
    crossed: Bool[np.ndarray, "L"],
    length_m: Float64[np.ndarray, "L"],
    successors: list[list[int]],
    predecessors: list[list[int]],
    junction: Int[np.ndarray, "L"],
) -> Bool[np.ndarray, "L"]:
    """Extend the crossed lanes back to a point where a vehicle can wait with its rear outside the
    junction."""
    contested = crossed.copy()
    room_m = np.full(len(length_m), WAITING_ROOM_M)  # reduced step by step
    changed = True
    # Fixed point: contested lanes grow backwards until every wait has room for a vehicle
    while changed:
        changed = False
        for lane in np.flatnonzero(~contested).tolist():
            # Free length behind a lane, up to the bound; contested lanes offer none
            behind = min((0.0 if contested[p] else room_m[p] for p in predecessors[lane]), default=np.inf)
            room = min(WAITING_ROOM_M, length_m[lane] + behind)
            # A lane before a contested one is contested too if a waiting vehicle would block something
            before = [n for n in successors[lane] if contested[n]]
            inside = junction[lane] >= 0 and any(junction[n] == junction[lane] for n in before)
            if before and (inside or room < WAITING_ROOM_M):
                contested[lane] = changed = True
            elif room != room_m[lane]:
                room_m[lane], changed = room, True
    return contested


def _limit(posted_mps: float | None) -> float:
    posted_mps = posted_mps or CITY_SPEED_MPS
    return posted_mps if posted_mps > MOTORWAY_LIMIT_MPS else min(posted_mps, CITY_SPEED_MPS)


def _to_light_m(
    has_light: Bool[np.ndarray, "L"], length_m: Float64[np.ndarray, "L"], successors: list[list[int]]
) -> Float64[np.ndarray, "L"]:
    """Return the distance from the end of each lane to the next light, m; infinite beyond
    `BEFORE_LIGHT_M`."""
    to_light = np.full(len(length_m), np.inf)
    changed = True
    # Fixed point of shortest distances: each pass can extend a way by one lane
    while changed:
        changed = False
        for lane, onward in enumerate(successors):
            ways = [0.0 if has_light[n] else length_m[n] + to_light[n] for n in onward]
            nearest = min(ways, default=np.inf)
            if nearest < min(to_light[lane], BEFORE_LIGHT_M):
                to_light[lane], changed = nearest, True
    return to_light


def _limits(
    limit_mps: float, length_m: float, line: Float64[np.ndarray, "n 3"], to_light_m: float
) -> Float64[np.ndarray, "n"]:
    """Return the speed limit at each sample of a lane, m/s."""
    before_light = to_light_m + np.linspace(length_m, 0.0, len(line)) < BEFORE_LIGHT_M
    return np.where(before_light, min(limit_mps, CITY_SPEED_MPS), limit_mps)


def _lane_controls(town: TownMap, index: dict[str, int], lane_count: int) -> tuple[np.ndarray, np.ndarray]:
    control = np.full(lane_count, int(LaneControl.NONE))
    zone = np.full(lane_count, -1)
    for i, stop in enumerate(town.stop_zones):
        lanes = [index[name] for name in stop.lane_ids if name in index]
        control[lanes] = CONTROL_OF_ZONE.get(stop.kind, LaneControl.NONE)
        zone[lanes] = i
    return control, zone


def _sides(lines: list[np.ndarray], lane: np.ndarray, count: np.ndarray, step_m: np.ndarray) -> Neighbours:
    neighbour_s_m = np.zeros((2, count.sum()))
    first = np.cumsum(count) - count
    for side, a in np.argwhere(lane >= 0).tolist():
        b = lane[side, a]
        # For each sample of a, the nearest sample of b
        _, near = cKDTree(lines[b]).query(lines[a])
        # Direction of b there, by central difference
        near = np.clip(near, 1, len(lines[b]) - 2) if len(lines[b]) > 2 else np.zeros_like(near)
        ahead = lines[b][np.minimum(near + 1, len(lines[b]) - 1)] - lines[b][np.maximum(near - 1, 0)]
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True).clip(1e-9)
        # Arc length on b: that of the nearest sample, plus the offset along b
        along = near * step_m[b] + np.sum((lines[a] - lines[b][near]) * ahead, axis=1)
        neighbour_s_m[side, first[a] : first[a] + count[a]] = along
    return Neighbours(lane.astype(np.int64), neighbour_s_m, first, count, step_m)


def _crossable(lanes: list[Lane]) -> Bool[np.ndarray, "2 L"]:
    """Return whether each lane has a full lane to the left and to the right, with a line that may be
    crossed."""
    starts = {lane.lane_id: (lane.centreline_xyz[0], lane.centreline_xyz[-1]) for lane in lanes}

    def is_open(lane: Lane, beside: str | None, marking: MarkingKind) -> bool:
        ends = starts.get(beside or "")
        if ends is None or marking not in CROSSABLE:
            return False
        # The lanes must be apart at both ends; elsewhere one of them grows from zero width
        gaps = [np.linalg.norm(lane.centreline_xyz[i] - end) for i, end in zip((0, -1), ends, strict=True)]
        return bool(min(gaps) > MIN_OPEN_WIDTH_M)  # lanes that begin or end there grow from zero width

    return np.array(
        [
            [is_open(lane, lane.left_id, lane.left_marking) for lane in lanes],
            [is_open(lane, lane.right_id, lane.right_marking) for lane in lanes],
        ]
    )


def lanes_for(graph: LaneGraph, min_radius_m: float) -> Bool[np.ndarray, "L"]:
    """Return the lanes from which a vehicle can drive on without a curve tighter than a radius, for ever or
    to an end of the map."""
    kept, ends = graph.min_radius_m >= min_radius_m, graph.successor_count == 0
    # Remove lanes that lead to no kept lane until none is left
    while True:
        onward = ends | (kept[graph.successors] & (graph.successors >= 0)).any(axis=1)
        if not (kept & ~onward).any():
            return kept
        kept = kept & onward


def _padded(rows: list[list[int]]) -> Int[np.ndarray, "L _"]:
    out = np.full((len(rows), max(1, max(map(len, rows)))), -1)
    for row, values in zip(out, rows, strict=True):
        row[: len(values)] = values
    return out
