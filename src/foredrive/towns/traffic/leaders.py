"""Leaders: the vehicles on each lane, and the nearest vehicle ahead on each path."""

from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float64, Int

from foredrive.towns.traffic.lane_graph import LaneGraph
from foredrive.towns.traffic.vehicles import BEHIND, WINDOW, Vehicles

LOOKAHEAD_M = 150.0
PASSING_M = 2.0
STANDSTILL_M = 2.0


class Leaders(NamedTuple):
    """The vehicles ahead of N vehicles on their paths: indices (-1 for none) and gaps from bumper to
    bumper."""

    leader: Int[np.ndarray, "N"]
    """Nearest vehicle ahead."""
    leader_gap_m: Float64[np.ndarray, "N"]
    limiting: Int[np.ndarray, "N"]
    """Vehicle ahead that requires the hardest braking. During a lane change it may be further away than the
    nearest one."""
    limiting_gap_m: Float64[np.ndarray, "N"]


class MotionArrays(NamedTuple):
    """Positions of N vehicles on their paths, as arguments of compiled functions.

    Arc lengths are as in `Vehicles`.
    """

    active: Bool[np.ndarray, "N"]
    path: Int[np.ndarray, "N W"]
    starts_m: Float64[np.ndarray, "N W"]
    front_m: Float64[np.ndarray, "N"]
    rear_m: Float64[np.ndarray, "N"]
    speed_mps: Float64[np.ndarray, "N"]
    beside: Int[np.ndarray, "N"]
    to_clear_m: Float64[np.ndarray, "N"]


class Occupants(NamedTuple):
    """Linked lists of the vehicles on each lane: head[lane], then following[entry], until -1.

    An entry belongs to vehicle who[entry]. The lane is column where[entry] of its path or, while it changes
    lanes, the lane beside that column. The rear of the vehicle is at rear_m[entry] on the lane.
    """

    head: Int[np.ndarray, "L"]
    following: Int[np.ndarray, "E"]
    who: Int[np.ndarray, "E"]
    where: Int[np.ndarray, "E"]
    rear_m: Float64[np.ndarray, "E"]
    used: Int[np.ndarray, "1"]
    """Number of entries."""


def motion_arrays(vehicles: Vehicles, starts_m: Float64[np.ndarray, "N W"]) -> MotionArrays:
    """Return the motion of vehicles as arguments of compiled functions."""
    return MotionArrays(
        active=vehicles.active,
        path=vehicles.path,
        starts_m=starts_m,
        front_m=vehicles.front_m,
        rear_m=vehicles.rear_m,
        speed_mps=vehicles.speed_mps,
        beside=vehicles.beside,
        to_clear_m=vehicles.to_clear_m,
    )


def find_leaders(graph: LaneGraph, vehicles: Vehicles, starts_m: Float64[np.ndarray, "N W"]) -> Leaders:
    """Find the vehicle ahead on each path.

    Vehicles that have just turned off onto a sibling lane count as long as they block the path. A vehicle
    that changes lanes is on both lanes. It also keeps its distance to vehicles on the old lane that it would
    reach before it has left that lane.
    """
    # 2 √(a b), the denominator of IDM's desired gap
    driver = (vehicles.time_gap_s, 2 * np.sqrt(vehicles.accel_mps2 * vehicles.decel_mps2))
    motion = motion_arrays(vehicles, starts_m)
    return Leaders(*_find_leaders(motion, driver, graph.length_m, graph.sides, graph.siblings))


@numba.njit(cache=True)
@no_type_check
def link_occupants(motion, length, sides, granted):
    """Link the vehicles on each lane. Vehicle i also counts on the next granted[i] lanes of its path."""
    size = 3 * len(motion.active) * WINDOW  # each lane may count once more, by a grant or by a lane change
    # One pool of entries for all lanes: head[lane] is the last entry, following[] leads to the one before.
    following, who, where = np.empty((3, size), np.int64)
    head, used = np.full(len(length), -1), np.zeros(1, np.int64)
    occupants = Occupants(head, following, who, where, np.empty(size), used)
    for i in range(len(motion.active)):
        if not motion.active[i]:
            continue
        for k in range(WINDOW):
            lane, start = motion.path[i, k], motion.starts_m[i, k]
            if lane < 0:
                continue
            # A vehicle lies on every lane between its bumpers; a grant lets it count on lanes ahead too.
            on_it = start < motion.front_m[i] and start + length[lane] > motion.rear_m[i]
            if on_it or BEHIND < k <= BEHIND + granted[i]:
                add_occupant(occupants, lane, i, k, motion.rear_m[i] - start)
            # While it changes lanes, it is on the lane beside as well, at the same place along it.
            old = neighbour_lane(lane, motion.beside[i], sides)
            if on_it and old >= 0:
                rear = project_to_neighbour(lane, motion.rear_m[i] - start, motion.beside[i], sides)
                add_occupant(occupants, old, i, k, rear)
    return occupants


@numba.njit(cache=True)
@no_type_check
def neighbour_lane(lane, beside, sides):
    """Return the left (beside 1) or the right neighbour (-1) of a lane; -1 if there is none or beside is
    0."""
    return -1 if beside == 0 else sides.lane[0 if beside > 0 else 1, lane]


@numba.njit(cache=True)
@no_type_check
def project_to_neighbour(lane, s, beside, sides):
    """Return the arc length on the neighbour of the point beside `s`, continued straight beyond the ends."""
    side = 0 if beside > 0 else 1
    steps = s / sides.step_m[lane]
    i = min(max(int(steps), 0), sides.sample_count[lane] - 2)
    a, b = (
        sides.neighbour_s_m[side, sides.first[lane] + i],
        sides.neighbour_s_m[side, sides.first[lane] + i + 1],
    )
    # Linear interpolation between samples; i is clamped, so the ends continue straight
    return a + (steps - i) * (b - a)


@numba.njit(cache=True)
@no_type_check
def add_occupant(occupants, lane, vehicle, column, rear_m):
    """Add a vehicle to a lane, which is a column of the vehicle's path or beside it."""
    # Prepend to the linked list of the lane
    entry = occupants.used[0]
    occupants.who[entry], occupants.where[entry] = vehicle, column
    occupants.rear_m[entry] = rear_m
    occupants.following[entry], occupants.head[lane] = occupants.head[lane], entry
    occupants.used[0] += 1


@numba.njit(cache=True)
@no_type_check
def _find_leaders(motion, driver, length, sides, siblings):
    active, path, starts, front, rear = motion[:5]
    count = len(active)
    on = link_occupants(motion, length, sides, np.zeros(count, np.int64))
    leader, gap = np.full(count, -1), np.full(count, np.inf)
    limiting, limiting_gap = leader.copy(), gap.copy()
    for i in range(count):
        if not active[i]:
            continue
        # Who is ahead is decided by centres, so that of two overlapping vehicles one leads.
        centre, max_braking = 0.5 * (front[i] + rear[i]), 0.0
        for k in range(BEHIND, WINDOW):
            lane = path[i, k]
            # Lanes come in the order of the path: none behind the nearest leader can hold a nearer one.
            if lane < 0 or starts[i, k] - front[i] > min(gap[i], LOOKAHEAD_M):
                break
            first = siblings.first[lane]
            old = neighbour_lane(lane, motion.beside[i], sides)
            for m in range(first - 2, siblings.first[lane + 1]):  # before the siblings: the old lane, itself
                is_old, itself = m == first - 2, m == first - 1
                if is_old and old < 0:
                    continue
                entry = on.head[old if is_old else lane if itself else siblings.other[m]]
                while entry >= 0:
                    j, rear_j = on.who[entry], on.rear_m[entry]
                    entry = on.following[entry]
                    if is_old:  # arc lengths of the old lane, as arc lengths of this one
                        rear_j = project_to_neighbour(old, rear_j, -motion.beside[i], sides)
                    # On a sibling lane it counts until its rear has left the part that overlaps this lane.
                    if j == i or not (is_old or itself or rear_j < siblings.other_clear_m[m]):
                        continue
                    centre_j = starts[i, k] + rear_j + 0.5 * (front[j] - rear[j])
                    if centre_j < centre or (centre_j == centre and j < i):
                        continue
                    gap_j = starts[i, k] + rear_j - front[i]
                    # Whoever is farther than the way to clear the old lane will not be reached on it.
                    if is_old and gap_j > motion.to_clear_m[i] + PASSING_M:
                        continue
                    if gap_j < gap[i]:
                        leader[i], gap[i] = j, gap_j
                    # The nearest leads, but a farther and slower one may demand more braking.
                    braking = _desired_gap_m(i, j, motion.speed_mps, driver) / max(gap_j, 0.05)
                    if braking > max_braking:
                        limiting[i], limiting_gap[i], max_braking = j, gap_j, braking
    return leader, gap, limiting, limiting_gap


@numba.njit(cache=True)
@no_type_check
def _desired_gap_m(i, j, speed_mps, driver):
    """Return the gap that vehicle i wants to j, as in `car_following`.

    The smaller the present gap is in comparison, the harder i brakes.
    """
    time_gap_s, braking_mps2 = driver
    # IDM: s* = s0 + max(0, v T + v Δv / (2 √(a b)))
    closing = speed_mps[i] - speed_mps[j]
    return STANDSTILL_M + max(0.0, speed_mps[i] * (time_gap_s[i] + closing / braking_mps2[i]))
