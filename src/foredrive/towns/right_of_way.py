"""Who may enter a junction, and who goes first inside.

A vehicle may enter lanes that others cross only once it has been granted its whole way through the
junction. Requests are served in the order of arrival. A grant needs a green light (or a stop made at a stop
sign), room beyond the junction, and that vehicles granted before will be out of the way when this one gets
there. Should one of them be held up after all, the later one waits inside the junction, before their paths
meet. The one granted first is thus never held up by others in the junction, which rules out deadlock. A
request that has to wait holds back later ones that conflict with it, but not for long: where junctions touch,
those may be what it waits for.
"""

from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float64, Int

from foredrive.towns.lane_graph import TURN_RAD, Control, LaneGraph
from foredrive.towns.leaders import link_occupants
from foredrive.towns.vehicles import BEHIND, WINDOW, Vehicles

STANDSTILL_M = 2.0
EARLY_M = 12.0
PLANNED_BRAKING_MPS2 = 1.5
"""Right of way is asked for `EARLY_M` before one would have to brake this hard for the line."""
LIGHT_BRAKING_MPS2 = 2.5
"""Whoever would have to brake harder than this for a yellow light drives on."""
LEFT_WAITS_S = 2.0
RIGHT_WAITS_S = 0.5
"""Turning vehicles are served as if they had arrived this much later."""
MOVING_ON_S = 1.5
"""Room beyond a junction is judged by where the vehicles in it will be after this time."""
ENOUGH_ROOM_M = 60.0
BRISK_MPS2 = 2.0
SLOW_MPS = 2.0
"""Others are taken to leave at this speed at least, oneself to arrive with this acceleration."""
INSIDE_M = 0.2
PATIENCE_S = 15.0
"""After this time a request no longer stands back for older ones."""


@dataclass(frozen=True)
class RightOfWay:
    """The outcome for N vehicles: their new `granted`, `asked_s` and `rank`, and where they have to wait."""

    granted: Int[np.ndarray, "N"]
    asked_s: Float64[np.ndarray, "N"]
    rank: Float64[np.ndarray, "N"]
    line_gap_m: Float64[np.ndarray, "N"]
    """From the front bumper to the line of the next junction, infinite if it may be passed."""
    inside_gap_m: Float64[np.ndarray, "N"]
    """From the front bumper to where somebody with priority crosses, infinite if nobody does."""


def claim_junctions(
    graph: LaneGraph,
    vehicles: Vehicles,
    starts_m: Float64[np.ndarray, "N W"],
    leader: Int[np.ndarray, "N"],
    leader_gap_m: Float64[np.ndarray, "N"],
    green: Bool[np.ndarray, "L"],
    time_s: float,
) -> RightOfWay:
    """Serve the requests for right of way; `green` are the lanes that no light forbids to enter."""
    kept = _withdraw(graph, vehicles, starts_m, green)
    line_column, line_gap = _next_line(graph, vehicles.path, kept, starts_m, vehicles.front_m)
    rows = np.arange(len(kept))
    lane = vehicles.path[rows, line_column]
    # Whose way through was longer than the path known at the time goes on; others ask one junction at a time.
    inside = graph.contested[vehicles.lane]
    before_line = vehicles.path[rows, line_column - 1]
    no_room = graph.contested[before_line] | (
        graph.length_m[before_line] < vehicles.size_lwh[:, 0] + STANDSTILL_M
    )
    goes_on = inside & no_room & (line_column == BEHIND + kept + 1)
    stop_made = (graph.control[lane] != Control.STOP) | vehicles.has_stopped
    queued = (leader >= 0) & (leader_gap_m < line_gap) & (kept[leader] == 0) & ~inside[leader]
    reach = vehicles.speed_mps**2 / (2 * PLANNED_BRAKING_MPS2) + EARLY_M
    near = vehicles.active & (line_gap < reach) & ((~queued & ~inside) | goes_on)
    asks = near & ((green[lane] & stop_made) | goes_on)
    asked_s = np.where(near, np.minimum(vehicles.asked_s, time_s), np.inf)
    turn = graph.turn_rad[lane]
    waits = np.where(turn > TURN_RAD, LEFT_WAITS_S, np.where(turn < -TURN_RAD, RIGHT_WAITS_S, 0.0))
    order = np.argsort(np.where(goes_on, -np.inf, asked_s + waits), kind="stable")
    order = order[asks[order]]
    conflicts = graph.conflicts
    motion = (vehicles.active, vehicles.path, starts_m, vehicles.front_m, vehicles.rear_m, vehicles.speed_mps)
    granted = _serve(
        order,
        line_column,
        motion,
        kept,
        goes_on,
        asks & (time_s - asked_s > PATIENCE_S),
        graph.length_m,
        graph.contested,
        (conflicts.first, conflicts.other, conflicts.enter_m, conflicts.other_clear_m),
    )
    entered = (granted > kept) & ~goes_on
    rank = vehicles.rank.copy()
    rank[order] = np.where(entered[order], time_s + 1e-6 * np.arange(len(order)), rank[order])
    inside_gap = _inside_gap(
        motion,
        granted,
        rank,
        graph.length_m,
        (
            conflicts.first,
            conflicts.other,
            conflicts.enter_m,
            conflicts.other_enter_m,
            conflicts.other_clear_m,
        ),
    )
    served = granted > kept
    return RightOfWay(
        granted, np.where(served, np.inf, asked_s), rank, np.where(served, np.inf, line_gap), inside_gap
    )


def _next_line(
    graph: LaneGraph, path: np.ndarray, granted: np.ndarray, starts_m: np.ndarray, front_m: np.ndarray
) -> tuple[Int[np.ndarray, "N"], Float64[np.ndarray, "N"]]:
    """Column of the next lane that may not be entered yet (0: none in sight), and the gap to its start."""
    ahead = (np.arange(WINDOW) > BEHIND + granted[:, None]) & (path >= 0)
    closed = ahead & graph.contested[path]
    first = np.argmax(closed, axis=1)
    gap = np.where(closed.any(axis=1), starts_m[np.arange(len(first)), first] - front_m, np.inf)
    return first, gap


def _withdraw(
    graph: LaneGraph, vehicles: Vehicles, starts_m: np.ndarray, green: np.ndarray
) -> Int[np.ndarray, "N"]:
    """Grants, but for those of vehicles that can still stop for a light which has turned."""
    nothing = np.zeros_like(vehicles.granted)
    column, gap = _next_line(graph, vehicles.path, nothing, starts_m, vehicles.front_m)
    lane = vehicles.path[np.arange(len(gap)), column]
    can_stop = gap > vehicles.speed_mps**2 / (2 * LIGHT_BRAKING_MPS2) + STANDSTILL_M
    withdrawn = (column > 0) & ~graph.contested[vehicles.lane] & ~green[lane] & can_stop
    return np.where(withdrawn, 0, vehicles.granted)


@numba.njit(cache=True)
@no_type_check
def _serve(order, line_column, motion, granted, goes_on, impatient, length, contested, conflicts):
    active, path, starts, front, rear, _ = motion
    count = len(active)
    granted = granted.copy()
    head = np.full(len(length), -1)
    following, who, where = np.empty((3, 2 * count * WINDOW), np.int64)
    used = link_occupants(active, path, starts, length, front, rear, granted, head, following, who, where)
    promised, waited_for = np.zeros(len(length)), np.zeros(len(length), np.bool_)
    for j in range(count):  # room beyond the junction that is spoken for
        k = BEHIND + granted[j] + 1
        on_its_way = active[j] and k < WINDOW and (granted[j] > 0 or contested[path[j, BEHIND]])
        if on_its_way and path[j, k] >= 0 and front[j] < starts[j, k]:
            promised[path[j, k]] += front[j] - rear[j] + STANDSTILL_M
    for i in order:
        need = front[i] - rear[i] + STANDSTILL_M
        begin = end = line_column[i]
        while end < WINDOW and path[i, end] >= 0 and (contested[path[i, end]] or length[path[i, end]] < need):
            end += 1
        exit_lane = path[i, end] if end < WINDOW else -1
        if not goes_on[i]:
            entries = (head, following, who, where)
            if exit_lane >= 0:
                room = _room(i, end, motion, contested, length, entries)
                if room - promised[exit_lane] < need:
                    continue
            if not _is_clear(i, begin, end, motion, length, conflicts, entries, waited_for & ~impatient[i]):
                for k in range(begin, end):
                    waited_for[path[i, k]] = True
                continue
        granted[i] = end - 1 - BEHIND
        if exit_lane >= 0:
            promised[exit_lane] += need
        for k in range(begin, end):
            who[used], where[used] = i, k
            following[used], head[path[i, k]] = head[path[i, k]], used
            used += 1
    return granted


@numba.njit(cache=True)
@no_type_check
def _room(i, begin, motion, contested, length, entries):
    """Free length beyond a junction in a moment, up to the next vehicle or junction."""
    _, path, starts, front, rear, speed = motion
    head, following, who, where = entries
    room = 0.0
    for k in range(begin, WINDOW):
        lane = path[i, k]
        if lane < 0 or contested[lane]:
            return room
        ahead = length[lane]
        entry = head[lane]
        while entry >= 0:
            j, at = who[entry], where[entry]
            if j != i and front[j] > starts[j, at]:
                ahead = min(ahead, rear[j] - starts[j, at] + MOVING_ON_S * speed[j])
            entry = following[entry]
        room += ahead
        if ahead < length[lane] or room > ENOUGH_ROOM_M:
            return room
    return room


@numba.njit(cache=True)
@no_type_check
def _is_clear(i, begin, end, motion, length, conflicts, entries, waited_for):
    """Whether all who have been granted conflicting lanes are out of the way when vehicle i gets there."""
    _, path, starts, front, rear, speed = motion
    first, other, enter, other_clear = conflicts
    head, following, who, where = entries
    for k in range(begin, end):
        for m in range(first[path[i, k]], first[path[i, k] + 1]):
            if waited_for[other[m]]:
                return False
            to_go = max(0.0, starts[i, k] + enter[m] - front[i])
            arrival_s = (np.sqrt(speed[i] ** 2 + 2 * BRISK_MPS2 * to_go) - speed[i]) / BRISK_MPS2
            entry = head[other[m]]
            while entry >= 0:
                j = who[entry]
                to_clear = min(other_clear[m], length[other[m]]) - (rear[j] - starts[j, where[entry]])
                if j != i and to_clear > 0 and to_clear / max(speed[j], SLOW_MPS) > arrival_s:
                    return False
                entry = following[entry]
    return True


@numba.njit(cache=True)
@no_type_check
def _is_behind(j, at, i, path, starts, rear):
    """Whether vehicle j will pass where vehicle i is now before it comes to its column `at`."""
    for k in range(BEHIND, at + 1):
        if path[j, k] == path[i, BEHIND] and starts[j, k] + rear[i] > rear[j]:
            return True
    return False


@numba.njit(cache=True)
@no_type_check
def _inside_gap(motion, granted, rank, length, conflicts):
    active, path, starts, front, rear, _ = motion
    first, other, enter, other_enter, other_clear = conflicts
    count = len(active)
    head = np.full(len(length), -1)
    following, who, where = np.empty((3, 2 * count * WINDOW), np.int64)
    link_occupants(active, path, starts, length, front, rear, granted, head, following, who, where)
    gap = np.full(count, np.inf)
    for i in range(count):
        if not active[i]:
            continue
        for k in range(BEHIND, BEHIND + granted[i] + 1):
            lane = path[i, k]
            for m in range(first[lane], first[lane + 1]):
                to_go = starts[i, k] + enter[m] - front[i]
                entry = head[other[m]] if -INSIDE_M < to_go < gap[i] else -1
                while entry >= 0:
                    j, at = who[entry], where[entry]
                    entry = following[entry]
                    is_there = front[j] - starts[j, at] > other_enter[m] + INSIDE_M
                    in_the_way = j != i and rear[j] - starts[j, at] < other_clear[m]
                    if (
                        in_the_way
                        and (is_there or rank[j] < rank[i])
                        and not _is_behind(j, at, i, path, starts, rear)
                    ):
                        gap[i] = to_go
    return gap
