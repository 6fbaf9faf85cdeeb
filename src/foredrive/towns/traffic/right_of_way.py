"""Right of way: which vehicles may enter a junction, and which go first inside.

Some lanes are crossed by others. A vehicle may enter them only after it has been granted its whole path
through the junction. Requests are served in the order of arrival. A grant needs a green light (or a completed
stop at a stop sign) and room beyond the junction. Vehicles with earlier grants must also be out of the way
when this one arrives. If one of them is delayed after all, the later one waits inside the junction, before
their paths meet. So the vehicle with the first grant is never delayed by others in the junction, which rules
out deadlock. A request that has to wait blocks later requests that conflict with it, but only for a limited
time: where junctions touch, it may be waiting for those.
"""

from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float64, Int

from foredrive.towns.traffic.lane_graph import TURN_RAD, LaneControl, LaneGraph
from foredrive.towns.traffic.leaders import STANDSTILL_M, Leaders, add_occupant, link_occupants, motion_arrays
from foredrive.towns.traffic.vehicles import BEHIND, WINDOW, Vehicles

EARLY_M = 12.0
PLANNED_BRAKING_MPS2 = 1.5
"""Vehicles request right of way `EARLY_M` before they would have to brake this hard for the line."""
LIGHT_BRAKING_MPS2 = 3.0
"""Maximum deceleration for a yellow light, m/s². A vehicle that would have to brake harder drives on."""
REACTION_S = 0.5
YIELD_BRAKING_MPS2 = 3.0
"""Maximum deceleration for priority inside a junction, m/s². If the vehicle that has to yield would have to
brake harder, the other one waits."""
LEFT_WAITS_S = 2.0
RIGHT_WAITS_S = 0.5
"""Delays of turning vehicles in the order of requests, s: they are served as if they had arrived this much
later."""
MOVING_ON_S = 1.5
"""Time after which the positions of vehicles decide whether there is room beyond a junction, s."""
ENOUGH_ROOM_M = 60.0
BRISK_MPS2 = 2.0
SLOW_MPS = 2.0
"""Assumptions about timing: others leave at least at `SLOW_MPS`, and the vehicle itself arrives with
acceleration `BRISK_MPS2`."""
INSIDE_M = 0.2
PATIENCE_S = 15.0
"""Time after which a request no longer yields to older ones, s."""


@dataclass(frozen=True)
class RightOfWay:
    """The new `granted`, `requested_s` and `rank` of N vehicles, and the points where they have to wait."""

    granted: Int[np.ndarray, "N"]
    requested_s: Float64[np.ndarray, "N"]
    rank: Float64[np.ndarray, "N"]
    line_gap_m: Float64[np.ndarray, "N"]
    """Gap from the front bumper to the line of the next junction, m; infinite if it may be passed."""
    inside_gap_m: Float64[np.ndarray, "N"]
    """Gap from the front bumper to the point where a vehicle with priority crosses, m; infinite without
    one."""


def claim_junctions(
    graph: LaneGraph,
    vehicles: Vehicles,
    starts_m: Float64[np.ndarray, "N W"],
    leaders: Leaders,
    green: Bool[np.ndarray, "L"],
    time_s: float,
    may_request: Bool[np.ndarray, "N"] | None = None,
    runs: Bool[np.ndarray, "N"] | None = None,
) -> RightOfWay:
    """Serve the requests for right of way.

    Args:
        green: lanes that no light forbids to enter.
        may_request: vehicles whose requests count. None: all.
        runs: vehicles that ignore lights. None: none.
    """
    runs = np.zeros(len(vehicles.active), dtype=np.bool_) if runs is None else runs
    # Grants that a light has taken back do not count. Who runs lights keeps them
    kept = np.where(runs, vehicles.granted, _withdraw(graph, vehicles, starts_m, green))
    # The next lane that may not be entered, and the gap to its line
    column, line_gap = _next_line(graph, vehicles.path, kept, starts_m, vehicles.front_m)
    lane = vehicles.path[np.arange(len(kept)), column]
    inside = graph.contested[vehicles.lane]
    # Vehicles inside whose grant ended before the exit: most go
    # on, some stop at a light within the junction
    cut_off = inside & _is_cut_off(graph, vehicles, kept, column)
    at_light = cut_off & (graph.control[lane] == LaneControl.LIGHT)
    goes_on = cut_off & ~at_light
    leader = leaders.leader
    # A vehicle queues if its leader stands before the same line without a grant
    queued = (leader >= 0) & (leaders.leader_gap_m < line_gap) & (kept[leader] == 0) & ~inside[leader]
    # Requests come early enough that a granted vehicle need not brake
    reach = vehicles.speed_mps**2 / (2 * PLANNED_BRAKING_MPS2) + EARLY_M
    near = vehicles.active & (line_gap < reach) & ((~queued & (~inside | at_light)) | goes_on)
    if may_request is not None:
        near &= may_request
    # A request needs a completed stop at a stop sign and an open light
    stop_made = (graph.control[lane] != LaneControl.STOP) | vehicles.has_stopped
    let_go = runs | _is_green(graph, vehicles.path, column, green)
    requests = near & ((let_go & stop_made) | goes_on)
    # The time of the first request is kept while the vehicle stays near
    requested_s = np.where(near, np.minimum(vehicles.requested_s, time_s), np.inf)
    # Serve in order of arrival. Turns count as later; vehicles inside come first, or they would block it
    turn = graph.turn_rad[lane]
    waits = np.where(turn > TURN_RAD, LEFT_WAITS_S, np.where(turn < -TURN_RAD, RIGHT_WAITS_S, 0.0))
    order = np.argsort(np.where(goes_on, -np.inf, requested_s + waits), kind="stable")
    order = order[requests[order]]
    impatient = requests & (time_s - requested_s > PATIENCE_S)
    motion = motion_arrays(vehicles, starts_m)
    lanes = (graph.length_m, graph.sides, graph.contested, graph.conflicts)
    # Grants of this step, beside those kept
    granted = _serve(motion, lanes, kept, order, column, goes_on, impatient)
    served = granted > kept
    rank = vehicles.rank.copy()
    enters = order[(served & ~goes_on)[order]]
    # Equal times are told apart by the order of service
    rank[enters] = time_s + 1e-6 * np.arange(len(enters))
    return RightOfWay(
        granted=granted,
        requested_s=np.where(served, np.inf, requested_s),
        rank=rank,
        line_gap_m=np.where(served, np.inf, line_gap),
        inside_gap_m=_inside_gap(motion, lanes, granted, rank),
    )


def _is_cut_off(
    graph: LaneGraph, vehicles: Vehicles, granted: Int[np.ndarray, "N"], line_column: Int[np.ndarray, "N"]
) -> Bool[np.ndarray, "N"]:
    """Return which vehicles have been granted only a part of their path through a junction.

    The path was longer than the part known at the time of the grant, or there is a light within it. All other
    vehicles request one junction at a time.
    """
    # The lane before the line is no place to wait: it is contested or shorter than the vehicle
    before_line = vehicles.path[np.arange(len(granted)), line_column - 1]
    need_m = vehicles.size_lwh[:, 0] + STANDSTILL_M
    no_room = graph.contested[before_line] | (graph.length_m[before_line] < need_m)
    # Only the first lane beyond the grant counts: otherwise the line belongs to another junction
    return no_room & (line_column == BEHIND + granted + 1)


def _next_line(
    graph: LaneGraph, path: np.ndarray, granted: np.ndarray, starts_m: np.ndarray, front_m: np.ndarray
) -> tuple[Int[np.ndarray, "N"], Float64[np.ndarray, "N"]]:
    """Return the column of the next lane that may not be entered yet (0: none in sight), and the gap to its
    start."""
    # Columns beyond the grant; argmax gives the first closed one
    ahead = (np.arange(WINDOW) > BEHIND + granted[:, None]) & (path >= 0)
    closed = ahead & graph.contested[path]
    first = np.argmax(closed, axis=1)
    gap = np.where(closed.any(axis=1), starts_m[np.arange(len(first)), first] - front_m, np.inf)
    return first, gap


def _is_green(
    graph: LaneGraph, path: np.ndarray, column: np.ndarray, green: np.ndarray
) -> Bool[np.ndarray, "N"]:
    """Return whether all lights of a path through a junction are open.

    Some lights stand within the junction.
    """
    # Contested lanes from the line on, as long as they follow each other: the way through this junction
    before = np.arange(WINDOW) < column[:, None]
    on_the_way = np.logical_and.accumulate(before | (graph.contested[path] & (path >= 0)), axis=1) & ~before
    return ~(on_the_way & ~green[path]).any(axis=1)


def _withdraw(
    graph: LaneGraph, vehicles: Vehicles, starts_m: np.ndarray, green: np.ndarray
) -> Int[np.ndarray, "N"]:
    """Return the grants, without those of vehicles that can still stop for a light that has changed.

    These vehicles wait before the junction or, if they are in it already, before the light itself.
    """
    nothing = np.zeros_like(vehicles.granted)
    # As if nothing were granted: the line of the next junction
    column, gap = _next_line(graph, vehicles.path, nothing, starts_m, vehicles.front_m)
    outside = (column > 0) & ~graph.contested[vehicles.lane]
    forbidden = outside & ~_is_green(graph, vehicles.path, column, green)
    kept = np.where(forbidden & _can_stop(vehicles, gap), 0, vehicles.granted)
    # Inside: the first light on the granted lanes that is not green
    to_come = (np.arange(WINDOW) > BEHIND) & (np.arange(WINDOW) <= BEHIND + vehicles.granted[:, None])
    light = to_come & (vehicles.path >= 0) & ~green[vehicles.path]
    first = np.argmax(light, axis=1)
    to_light = starts_m[np.arange(len(first)), first] - vehicles.front_m
    stops = ~outside & light.any(axis=1) & _can_stop(vehicles, to_light)
    # Keep the grant up to the lane before that light
    return np.where(stops, first - 1 - BEHIND, kept)


def _can_stop(vehicles: Vehicles, gap_m: Float64[np.ndarray, "N"]) -> Bool[np.ndarray, "N"]:
    # Braking distance plus the way during the reaction time
    needed = vehicles.speed_mps**2 / (2 * LIGHT_BRAKING_MPS2) + REACTION_S * vehicles.speed_mps
    return (gap_m >= 0) & (gap_m >= needed)


@numba.njit(cache=True)
@no_type_check
def _serve(motion, lanes, granted, order, line_column, goes_on, impatient):
    path, starts, front, rear = motion.path, motion.starts_m, motion.front_m, motion.rear_m
    length, sides, contested, _ = lanes
    granted = granted.copy()
    # Granted vehicles count on all lanes of their grant from now on
    on = link_occupants(motion, length, sides, granted)
    promised, waited_for = np.zeros(len(length)), np.zeros(len(length), np.bool_)
    for j in range(len(granted)):  # room beyond the junction that is already promised
        k = BEHIND + granted[j] + 1
        on_its_way = motion.active[j] and k < WINDOW and (granted[j] > 0 or contested[path[j, BEHIND]])
        if on_its_way and path[j, k] >= 0 and front[j] < starts[j, k]:
            promised[path[j, k]] += front[j] - rear[j] + STANDSTILL_M
    for i in order:
        # Whole way through: contested lanes, and lanes too short to wait on
        need = front[i] - rear[i] + STANDSTILL_M
        begin = end = line_column[i]
        while end < WINDOW and path[i, end] >= 0 and (contested[path[i, end]] or length[path[i, end]] < need):
            end += 1
        exit_lane = path[i, end] if end < WINDOW else -1
        # Vehicles that go on inside are let through: they cannot wait where they are
        if not goes_on[i]:
            # No entry without room for the whole vehicle beyond the junction
            if exit_lane >= 0 and _room(i, end, motion, lanes, on) - promised[exit_lane] < need:
                continue
            # No entry while others are in the way. Later requests that conflict have to wait for this one
            if not _is_clear(i, begin, end, motion, lanes, on, waited_for & ~impatient[i]):
                for k in range(begin, end):
                    waited_for[path[i, k]] = True
                continue
        # Grant up to the exit; its room is promised, and the lanes count as occupied at once
        granted[i] = end - 1 - BEHIND
        if exit_lane >= 0:
            promised[exit_lane] += need
        for k in range(begin, end):
            add_occupant(on, path[i, k], i, k, rear[i] - starts[i, k])
    return granted


@numba.njit(cache=True)
@no_type_check
def _room(i, begin, motion, lanes, on):
    """Return the free length beyond a junction after `MOVING_ON_S`, m, up to the next vehicle or junction."""
    length, _, contested, _ = lanes
    room = 0.0
    for k in range(begin, WINDOW):
        lane = motion.path[i, k]
        if lane < 0 or contested[lane]:
            return room
        ahead = length[lane]
        entry = on.head[lane]
        while entry >= 0:
            j, rear = on.who[entry], on.rear_m[entry]
            # The rear of each vehicle on the lane, where it will be after `MOVING_ON_S`
            if j != i and rear + motion.front_m[j] - motion.rear_m[j] > 0:
                ahead = min(ahead, rear + MOVING_ON_S * motion.speed_mps[j])
            entry = on.following[entry]
        room += ahead
        # The room ends behind the last vehicle, or is enough
        if ahead < length[lane] or room > ENOUGH_ROOM_M:
            return room
    return room


@numba.njit(cache=True)
@no_type_check
def _is_clear(i, begin, end, motion, lanes, on, waited_for):
    """Return whether all vehicles with grants on conflicting lanes are out of the way when vehicle i
    arrives."""
    length, _, _, conflicts = lanes
    speed = motion.speed_mps
    for k in range(begin, end):
        # Every lane that conflicts with a lane of the way
        lane = motion.path[i, k]
        for m in range(conflicts.first[lane], conflicts.first[lane + 1]):
            other = conflicts.other[m]
            if waited_for[other]:
                return False
            # Earliest arrival at the place: accelerate briskly from the present speed
            to_go = max(0.0, motion.starts_m[i, k] + conflicts.enter_m[m] - motion.front_m[i])
            arrival_s = (np.sqrt(speed[i] ** 2 + 2 * BRISK_MPS2 * to_go) - speed[i]) / BRISK_MPS2
            # Others leave the place when their rear has passed this arc length
            clear = min(conflicts.other_clear_m[m], length[other])
            entry = on.head[other]
            while entry >= 0:
                j = on.who[entry]
                to_clear = clear - on.rear_m[entry]
                if j != i and to_clear > 0 and to_clear / max(speed[j], SLOW_MPS) > arrival_s:
                    return False
                entry = on.following[entry]
    return True


@numba.njit(cache=True)
@no_type_check
def _inside_gap(motion, lanes, granted, rank):
    path, starts, front, rear = motion.path, motion.starts_m, motion.front_m, motion.rear_m
    length, sides, _, conflicts = lanes
    on = link_occupants(motion, length, sides, granted)
    gap = np.full(len(granted), np.inf)
    to_stop = motion.speed_mps**2 / (2 * YIELD_BRAKING_MPS2) + REACTION_S * motion.speed_mps
    for i in range(len(granted)):
        if not motion.active[i]:
            continue
        # Vehicles that wait for i cannot have priority over it: both would wait for ever
        goes_before = _goes_before(i, granted[i], to_stop[i], motion, conflicts, on)
        # Every conflict on the granted lanes that is still ahead and nearer than the present gap
        for k in range(BEHIND, BEHIND + granted[i] + 1):
            lane = path[i, k]
            for m in range(conflicts.first[lane], conflicts.first[lane + 1]):
                to_go = starts[i, k] + conflicts.enter_m[m] - front[i]
                entry = on.head[conflicts.other[m]] if -INSIDE_M < to_go < gap[i] else -1
                while entry >= 0:
                    j, place, rear_j = on.who[entry], on.where[entry], on.rear_m[entry]
                    entry = on.following[entry]
                    # Way of the other to the place; negative if it is there already
                    to_go_j = conflicts.other_enter_m[m] + INSIDE_M - (rear_j + front[j] - rear[j])
                    in_the_way = j != i and rear_j < conflicts.other_clear_m[m]
                    # It goes first if it cannot stop, or if its rank is lower and i can still stop
                    yields = rank[j] < rank[i] and to_go >= to_stop[i] and not goes_before[j]
                    goes_first = in_the_way and (to_go_j < to_stop[j] or yields)
                    # A vehicle behind i on the same lanes is no reason to wait
                    if goes_first and not _is_behind(j, place, i, path, starts, rear):
                        gap[i] = to_go
    return gap


@numba.njit(cache=True)
@no_type_check
def _goes_before(i, granted, to_stop, motion, conflicts, on):
    """Return which vehicles have vehicle i in their way, now or soon.

    A vehicle that waits for i there has no priority over i elsewhere.
    """
    goes_before = np.zeros(len(motion.active), np.bool_)
    # Places that i blocks already or cannot stop before
    for k in range(BEHIND, BEHIND + granted + 1):
        lane, start = motion.path[i, k], motion.starts_m[i, k]
        for m in range(conflicts.first[lane], conflicts.first[lane + 1]):
            if start + conflicts.enter_m[m] + INSIDE_M - motion.front_m[i] >= to_stop:
                continue
            # Find where i's lane leaves the other one, from that lane's list
            other, clear = conflicts.other[m], np.inf
            for n in range(conflicts.first[other], conflicts.first[other + 1]):
                if conflicts.other[n] == lane:
                    clear = conflicts.other_clear_m[n]
            entry = on.head[other] if motion.rear_m[i] - start < clear else -1
            while entry >= 0:
                j = on.who[entry]
                goes_before[j] |= j != i and on.rear_m[entry] < conflicts.other_clear_m[m]
                entry = on.following[entry]
    return goes_before


@numba.njit(cache=True)
@no_type_check
def _is_behind(j, place, i, path, starts, rear):
    """Return whether vehicle j passes the present position of vehicle i before its column `place`."""
    for k in range(BEHIND, place + 1):
        if path[j, k] == path[i, BEHIND] and starts[j, k] + rear[i] > rear[j]:
            return True
    return False
