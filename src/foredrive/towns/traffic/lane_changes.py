"""Lane changes: incentive and safety by MOBIL (Kesting, Treiber & Helbing 2007), and their start."""

import dataclasses
from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float64, Int

from foredrive.driving.car_following import free_acceleration
from foredrive.towns.traffic.drivers import DrivingContext, following_acceleration
from foredrive.towns.traffic.lane_graph import MOTORWAY_LIMIT_MPS, LaneGraph
from foredrive.towns.traffic.leaders import (
    LOOKAHEAD_M,
    Leaders,
    link_occupants,
    motion_arrays,
    neighbour_lane,
    project_to_neighbour,
)
from foredrive.towns.traffic.vehicles import BEHIND, CLEAR_OF_LANE, WINDOW, Vehicles, path_starts

LEFT, RIGHT = 0, 1
POLITENESS = 0.3
THRESHOLD_MPS2 = 0.2
SAFE_BRAKING_MPS2 = 3.0
KEEP_RIGHT_MPS2 = 0.3
"""Bias on motorways for the right lane and against the left lane, m/s²."""
CHANGE_S = 3.5
MIN_CHANGE_M = 16.0
STOPPING_MPS2 = 2.5
"""Deceleration of a gentle stop, m/s². A vehicle that need not change lanes does so only where there is room
for such a stop afterwards."""
MIN_GAP_M = 2.0
COURTEOUS_MPS2, COURTEOUS_TO_STANDING_MPS2 = 1.5, 3.0
"""Maximum deceleration, m/s², to let in a vehicle that has to change lanes: if that vehicle moves, and if it
stands. A standing vehicle would otherwise have to wait for ever."""
STANDSTILL_MPS = 0.5
COURTEOUS_GAP_M = 1.0
"""Additional gap to the vehicle that is let in, m, compared with the gap to a leader in the driver's own
lane."""
CHANGE_SPACING_M = 60.0
"""Minimum distance between two lane changes, m, unless a vehicle has to change."""
MAX_ROOM_M = 600.0
URGENT_S = 12.0
"""Time before the end of a lane, in addition to `CHANGE_SPACING_M`, at which a mandatory change begins, s."""
MANDATORY_MPS2 = 4.0
DISCRETIONARY_MPS2 = 0.5
"""Bonus of the lane of the route, m/s²: towards the lane's end, and far from it."""
FLAT_M = 0.3
"""Height difference above which lanes are not side by side, m."""
MIN_RADIUS_M = 30.0
"""Smallest radius of the two lanes of a lane change, m. In tighter curves neighbouring lanes differ in
length."""


class ChangeRanges(NamedTuple):
    """For the left and the right side of L lanes, the distance in which a lane change is possible."""

    target: Int[np.ndarray, "2 L"]
    """Neighbour; -1 if a change is not possible."""
    room_m: Float64[np.ndarray, "2 L"]
    """Distance from the start of the lane to the last possible change, m, across the ends of lanes; 0 if none
    is possible."""
    continues: Bool[np.ndarray, "2 L"]
    """Whether the two lanes continue two other lanes that lie side by side."""


class LaneGaps(NamedTuple):
    """The vehicles ahead and behind that N vehicles would have in another lane (-1 for none), and the gaps,
    m."""

    leader: Int[np.ndarray, "N"]
    leader_gap_m: Float64[np.ndarray, "N"]
    follower: Int[np.ndarray, "N"]
    follower_gap_m: Float64[np.ndarray, "N"]


def find_change_ranges(graph: LaneGraph) -> ChangeRanges:
    """Find where lane changes are possible.

    They are possible outside of junctions and tight curves, over lines that may be crossed, with room to
    wait.
    """
    sides = graph.sides.lane
    # Side by side means the same height: one may lead onto a bridge
    level = np.abs(graph.xyz[graph.first, 2] - graph.xyz[graph.first[sides], 2]) < FLAT_M
    possible = ~graph.contested & (graph.min_radius_m >= MIN_RADIUS_M)
    # Both lanes must be straight enough and outside of contested stretches
    open_to = graph.may_cross & (sides >= 0) & possible & possible[sides] & level
    target = np.where(open_to, sides, -1)
    room = np.where(open_to, graph.length_m, 0.0)
    continues = np.zeros(room.shape, dtype=np.bool_)
    # Pairs of lanes one after the other whose neighbours also follow each other: a change may go on there.
    pairs = [
        (side, lane, after)
        for side, lane in np.argwhere(open_to).tolist()
        for after in graph.successors[lane, : graph.successor_count[lane]].tolist()
        if open_to[side, after] and target[side, after] in graph.successors[target[side, lane]]
    ]
    for side, _, after in pairs:
        continues[side, after] = True
    # The room of a lane grows by that of the next one until nothing changes: rings of lanes end at the bound.
    changed = True
    while changed:
        changed = False
        for side, lane, after in pairs:
            longer = min(graph.length_m[lane] + room[side, after], MAX_ROOM_M)
            if longer > room[side, lane] + 1e-6:
                room[side, lane], changed = longer, True
    return ChangeRanges(target, room, continues)


def change_length_m(vehicles: Vehicles) -> Float64[np.ndarray, "N"]:
    """Return the length of a lane change, m: `CHANGE_S` at the present speed, but at least
    `MIN_CHANGE_M` so that steering stays gentle."""
    return np.maximum(CHANGE_S * vehicles.speed_mps, MIN_CHANGE_M)


def lane_change_allowed(
    graph: LaneGraph,
    change_ranges: ChangeRanges,
    vehicles: Vehicles,
    fits: Bool[np.ndarray, "N L"],
    mandatory: Bool[np.ndarray, "2 N"],
) -> Bool[np.ndarray, "2 N"]:
    """Return which vehicles may change to the left and to the right, judged by the road alone.

    `fits` states which lanes each vehicle can use.
    """
    v, lane = vehicles, vehicles.lane
    # A change needs its own length, and room for the rear axle to complete it
    need = change_length_m(v) + v.wheelbase_m + v.axle_to_centre_m
    stops = v.speed_mps**2 / (2 * STOPPING_MPS2)
    # After a change, a vehicle drives on for a while before it changes again, unless it has to.
    settled = v.changed_m > v.change_length_m + np.where(mandatory, 0.0, CHANGE_SPACING_M)
    target = change_ranges.target[:, lane]
    # The whole vehicle must be on lanes that lie side by side
    begun = (v.rear_m > 0) | change_ranges.continues[:, lane]
    # Room along the vehicle's own path, which may leave the lanes that go on side by side.
    ahead = v.path[:, BEHIND:]
    onward = (ahead >= 0) & (change_ranges.target[:, ahead] >= 0)
    onward[:, :, 1:] &= change_ranges.continues[:, ahead[:, 1:]]
    # Add up the lanes of the path from the current one as long as a change stays possible
    room_m = np.sum(np.logical_and.accumulate(onward, axis=2) * graph.length_m[ahead], axis=2)
    goes_on = room_m > v.s_m + need + np.where(mandatory, MIN_GAP_M, stops)
    fitting = (target >= 0) & fits[np.arange(len(lane)), target]
    return v.active & begun & goes_on & fitting & ((v.shift_m == 0) | settled)


def find_gaps(
    graph: LaneGraph,
    vehicles: Vehicles,
    starts_m: Float64[np.ndarray, "N W"],
    target: Int[np.ndarray, "N"],
    side: int,
) -> LaneGaps:
    """Find the vehicles ahead and behind in the lanes `target` (-1: not requested).

    Overlapping vehicles have a negative gap.
    """
    lanes = (graph.length_m, graph.sides, graph.successors)
    return LaneGaps(*_find_gaps(motion_arrays(vehicles, starts_m), lanes, target, side))


@numba.njit(cache=True)
@no_type_check
def _find_gaps(motion, lanes, target, side):
    """Return leader, gap to it, follower and gap to it of each vehicle in its target lane.

    Args:
        motion: `MotionArrays` of N vehicles.
        lanes: lengths, sides and successors of all lanes.
        target: [N] the lane, or -1 for a vehicle that does not consider a change.
        side: side on which the lane is.
    """
    length, sides, _ = lanes
    front, rear, path = motion.front_m, motion.rear_m, motion.path
    count = len(front)
    leader, follower = np.full(count, -1), np.full(count, -1)
    leader_gap, follower_gap = np.full(count, np.inf), np.full(count, np.inf)
    if not (target >= 0).any():
        return leader, leader_gap, follower, follower_gap
    on = link_occupants(motion, length, sides, np.zeros(count, np.int64))
    for i in range(count):
        if target[i] < 0:
            continue
        # The vehicle is thought into the target lane, beside its present place
        centre = project_to_neighbour(
            path[i, BEHIND], 0.5 * (front[i] + rear[i]), 1 if side == LEFT else -1, sides
        )
        leader[i], leader_gap[i] = _leader_beside(i, centre, motion, on, lanes, target[i], side)
        follower[i], follower_gap[i] = _follower_beside(i, centre, motion, sides, target[i])
    return leader, leader_gap, follower, follower_gap


@numba.njit(cache=True)
@no_type_check
def _leader_beside(i, centre, motion, on, lanes, target, side):
    """Return the next vehicle ahead of vehicle i in the lane beside it, and the gap to it; -1 for none.

    Args:
        centre: distance of the vehicle's middle along the target lane.
        on: `Occupants` of all lanes.
    """
    length, sides, successors = lanes
    front, rear, path = motion.front_m, motion.rear_m, motion.path
    half, leader, gap = 0.5 * (front[i] - rear[i]), -1, np.inf
    # Along the lanes beside the path, until the nearest leader or the end of such lanes
    lane, start = target, 0.0
    for k in range(BEHIND + 1, WINDOW):
        entry = on.head[lane]
        while entry >= 0:
            j, rear_j = on.who[entry], start + on.rear_m[entry]
            entry = on.following[entry]
            is_ahead = rear_j + 0.5 * (front[j] - rear[j]) >= centre
            if j != i and is_ahead and rear_j - centre - half < gap:
                leader, gap = j, rear_j - centre - half
        start += length[lane]
        if path[i, k] < 0 or start - centre - half > min(gap, LOOKAHEAD_M):
            break
        # The next lane is that beside the path, if the present one leads into it
        beside, ahead = sides.lane[side, path[i, k]], successors[lane]
        lane = beside if beside >= 0 and (ahead == beside).any() else ahead[0]
        if lane < 0:
            break
    return leader, gap


@numba.njit(cache=True)
@no_type_check
def _follower_beside(i, centre, motion, sides, target):
    """Return the next vehicle behind vehicle i in the lane beside it, and the gap to it; -1 for none.

    It is searched among all vehicles whose own path leads into the target lane, however they get there.
    """
    front, rear, path, starts = motion.front_m, motion.rear_m, motion.path, motion.starts_m
    half, follower, gap = 0.5 * (front[i] - rear[i]), -1, np.inf
    for j in range(len(front)):
        if not motion.active[j] or j == i:
            continue
        for k in range(BEHIND, WINDOW):
            lane_j = path[j, k]
            if lane_j < 0 or starts[j, k] - front[j] > LOOKAHEAD_M:
                break
            front_j = front[j] - starts[j, k]
            if lane_j != target:
                # It counts too if it is leaving the target lane and not yet clear of it
                is_clear = k > BEHIND and -front_j > motion.to_clear_m[j]
                if is_clear or neighbour_lane(lane_j, motion.beside[j], sides) != target:
                    continue
                # Measured from its rear, as above. Otherwise in a curve no vehicle would be ahead of it or
                # behind it
                length_j = front[j] - rear[j]
                front_j = project_to_neighbour(lane_j, front_j - length_j, motion.beside[j], sides) + length_j
            is_behind = front_j - 0.5 * (front[j] - rear[j]) < centre
            if is_behind and centre - half - front_j < gap:
                follower, gap = j, centre - half - front_j
            break
    return follower, gap


def incentive(
    vehicles: Vehicles, context: DrivingContext, gaps: LaneGaps, free_mps2: Float64[np.ndarray, "N"]
) -> Float64[np.ndarray, "N"]:
    """Return the MOBIL gain, m/s², of N vehicles and, weighted by politeness, of their followers; -inf where
    unsafe.

    ã_c - a_c + p (ã_n - a_n + ã_o - a_o), Kesting et al. (2007), eq. 2 and 3. Vehicle c changes lanes; n and
    o follow in the new and the old lane.

    Args:
        free_mps2: acceleration on an open road in the new lane.
    """
    v, every, length = vehicles, np.arange(len(free_mps2)), vehicles.size_lwh[:, 0]
    leaders, n, o = context.leaders, gaps.follower, _followers(context.leaders)
    # Accelerations of the three after the change; before the change they are `desired`
    desired, halt, free = context.desired_mps2(v), context.halt_mps2, context.free_mps2
    own = following_acceleration(v, every, free_mps2, gaps.leader, gaps.leader_gap_m)
    new = following_acceleration(v, n, free[n], np.where(n >= 0, every, -1), gaps.follower_gap_m)
    # When c leaves, o follows c's leader: both gaps and c's length become its gap
    old = following_acceleration(
        v, o, free[o], leaders.leader, leaders.leader_gap_m[o] + length + leaders.leader_gap_m
    )
    # Nobody gains by an acceleration that a red light or a stop takes away again.
    gain_n = np.where(n >= 0, np.minimum(new, halt[n]) - desired[n], 0.0)
    gain_o = np.where(o >= 0, np.minimum(old, halt[o]) - desired[o], 0.0)
    gain = np.minimum(own, halt) - desired + POLITENESS * (gain_n + gain_o)
    # MOBIL's safety criterion, and a least gap in the new lane.
    near = (gaps.leader_gap_m < MIN_GAP_M) | (gaps.follower_gap_m < MIN_GAP_M)
    unsafe = (own < -SAFE_BRAKING_MPS2) | ((n >= 0) & (new < -SAFE_BRAKING_MPS2))
    return np.where(near | unsafe, -np.inf, gain)


def _followers(leaders: Leaders) -> Int[np.ndarray, "N"]:
    """Return the nearest follower of each vehicle, -1 for none."""
    follower = np.full(len(leaders.leader), -1)
    led = np.flatnonzero(leaders.leader >= 0)
    led = led[np.argsort(-leaders.leader_gap_m[led], kind="stable")]  # the nearest is written last
    follower[leaders.leader[led]] = led
    return follower


def room_to_change_m(
    graph: LaneGraph, change_ranges: ChangeRanges, vehicles: Vehicles, lane: int
) -> tuple[int, float] | None:
    """Return the side to which vehicle 0 has to go to reach `lane`, and the distance in which it has to
    begin, m.

    Return None if it is in that lane already or cannot reach it.
    """
    here = int(vehicles.lane[0])
    # Walk to the side over all neighbouring lanes until the wanted one is found
    for side in (LEFT, RIGHT):
        beside = here
        while beside >= 0 and beside != lane:
            beside = int(graph.sides.lane[side, beside])
        if beside == lane and beside != here:
            # Distance that the change itself takes
            need = MIN_CHANGE_M + vehicles.wheelbase_m[0] + vehicles.axle_to_centre_m[0] + MIN_GAP_M
            return side, float(change_ranges.room_m[side, here] - vehicles.s_m[0] - need)
    return None


def choose_change(
    graph: LaneGraph,
    change_ranges: ChangeRanges,
    vehicles: Vehicles,
    context: DrivingContext,
    may: Bool[np.ndarray, "2 N"],
    bonus_mps2: Float64[np.ndarray, "2 N"],
) -> tuple[int, int] | None:
    """Return the vehicle that gains most from a lane change, and the side; None if no gain is large enough.

    Only one vehicle changes at a time, so that no two vehicles take the same gap.

    Args:
        may: which vehicles may change to the left and to the right.
        bonus_mps2: the value of the change to them, in addition to acceleration.
    """
    if not may.any():
        return None
    v = vehicles
    starts_m = path_starts(graph, v.path)
    # Room to pull out: the leader moves on by `moves_on` while the vehicle leaves its lane.
    reach = CLEAR_OF_LANE * change_length_m(v) + v.wheelbase_m
    leader = context.leaders.leader
    moves_on = np.where(leader >= 0, v.speed_mps[leader], 0.0) * reach / np.maximum(v.speed_mps, 1.0)
    can_pull_out = context.leaders.leader_gap_m + moves_on > reach
    best, threshold = None, THRESHOLD_MPS2
    for side in (LEFT, RIGHT):
        target = np.where(may[side] & can_pull_out, change_ranges.target[side, v.lane], -1)
        if not (target >= 0).any():
            continue
        gaps = find_gaps(graph, v, starts_m, target, side)
        # The open-road acceleration is the smaller of the old lane's and the new lane's
        desired = v.speed_factor * np.minimum(v.top_speed_mps, graph.speed(target, v.s_m))
        free = np.minimum(
            context.free_mps2, free_acceleration(v.speed_mps, desired, v.accel_mps2, v.decel_mps2)
        )
        # On motorways the right lane is preferred.
        motorway = graph.limit_mps[v.lane] > MOTORWAY_LIMIT_MPS
        bias = np.where(motorway, KEEP_RIGHT_MPS2 if side == RIGHT else -KEEP_RIGHT_MPS2, 0.0)
        gain = np.where(target >= 0, incentive(v, context, gaps, free) + bias + bonus_mps2[side], -np.inf)
        if gain.max() > threshold:
            best, threshold = (int(np.argmax(gain)), side), float(gain.max())
    return best


def courtesy_limits(
    graph: LaneGraph,
    vehicles: Vehicles,
    starts_m: Float64[np.ndarray, "N W"],
    context: DrivingContext,
    target: Int[np.ndarray, "N"],
    side: int,
) -> Float64[np.ndarray, "N"]:
    """Return upper limits of N accelerations that open gaps for vehicles that have to change to the lanes
    `target`.

    A `target` of -1 means that the vehicle need not change. The limit is infinite for all vehicles except
    those behind the gaps.
    """
    limit = np.full(len(target), np.inf)
    gaps = find_gaps(graph, vehicles, starts_m, target, side)
    # Only followers that are still behind can open a gap
    who = np.flatnonzero((gaps.follower >= 0) & (gaps.follower_gap_m >= MIN_GAP_M))
    n = gaps.follower[who]
    desired = following_acceleration(
        vehicles, n, context.free_mps2[n], who, gaps.follower_gap_m[who] - COURTEOUS_GAP_M
    )
    # Followers brake harder for a standing vehicle, which cannot create a gap by itself
    max_braking = np.where(
        vehicles.speed_mps[who] < STANDSTILL_MPS, COURTEOUS_TO_STANDING_MPS2, COURTEOUS_MPS2
    )
    # One follower may let in several: its strictest limit holds
    np.minimum.at(limit, n, np.maximum(desired, -max_braking))
    return limit


def begin_change(graph: LaneGraph, vehicles: Vehicles, who: int, side: int) -> Vehicles:
    """Begin a lane change: move the path to the neighbour at once; the vehicle follows gradually.

    The new path stays beside the old one as long as there are such lanes. The lanes beyond are not known yet.
    """
    v, row = vehicles, np.array([who])
    old, path = v.path[who], np.full(WINDOW, -1)
    path[BEHIND] = graph.sides.lane[side, old[BEHIND]]
    # Lanes behind: beside the old ones where those lead here, else any that does.
    for column in range(BEHIND - 1, -1, -1):
        before = graph.predecessors[path[column + 1]] if path[column + 1] >= 0 else np.array([-1])
        beside = graph.sides.lane[side, old[column]] if old[column] >= 0 else -1
        path[column] = beside if beside >= 0 and beside in before else before[0]
    # Lanes ahead: beside the old ones, as long as they follow each other.
    for column in range(BEHIND + 1, WINDOW):
        beside = graph.sides.lane[side, old[column]] if old[column] >= 0 else -1
        if beside < 0 or beside not in graph.successors[path[column - 1]]:
            break
        path[column] = beside
    # The offset from the new lane starts at the distance between the lanes and is steered to 0.
    s_m = project_to_neighbour(old[BEHIND], v.s_m[who], 1 if side == LEFT else -1, graph.sides)
    here = graph.position(old[BEHIND : BEHIND + 1], v.s_m[row])[0]
    change_xy = graph.position(path[BEHIND : BEHIND + 1], np.array([s_m]))[0]
    apart_m = float(np.hypot(*(here - change_xy)[:2]))
    changed = {
        "path": path,
        "s_m": s_m,
        "granted": 0,
        "requested_s": np.inf,
        "has_stopped": False,
        "shift_m": apart_m if side == RIGHT else -apart_m,
        "change_length_m": change_length_m(v)[who],
        # The change is measured at the rear axle, so it begins with the front axle now
        "changed_m": -v.wheelbase_m[who],
    }
    values = {}
    for name, value in changed.items():
        values[name] = getattr(v, name).copy()
        values[name][who] = value
    return dataclasses.replace(v, **values)
