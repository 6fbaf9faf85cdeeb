"""Who is ahead: the vehicles on each lane, and the nearest one on a vehicle's path."""

from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float64, Int

from foredrive.towns.traffic.lane_graph import LaneGraph
from foredrive.towns.traffic.vehicles import BEHIND, WINDOW, Vehicles

LOOK_M = 150.0


class Motion(NamedTuple):
    """Where N vehicles are on their paths, as kernels take it; arc lengths as in `Vehicles`."""

    active: Bool[np.ndarray, "N"]
    path: Int[np.ndarray, "N W"]
    starts_m: Float64[np.ndarray, "N W"]
    front_m: Float64[np.ndarray, "N"]
    rear_m: Float64[np.ndarray, "N"]
    speed_mps: Float64[np.ndarray, "N"]


class Occupants(NamedTuple):
    """Linked lists of the vehicles on each lane: head[lane], then following[entry], until -1.

    An entry is of vehicle who[entry], on column where[entry] of its path.
    """

    head: Int[np.ndarray, "L"]
    following: Int[np.ndarray, "E"]
    who: Int[np.ndarray, "E"]
    where: Int[np.ndarray, "E"]
    used: Int[np.ndarray, "1"]
    """Number of entries."""


def motion_of(vehicles: Vehicles, starts_m: Float64[np.ndarray, "N W"]) -> Motion:
    """What kernels need to know of vehicles."""
    return Motion(
        vehicles.active, vehicles.path, starts_m, vehicles.front_m, vehicles.rear_m, vehicles.speed_mps
    )


def find_leaders(
    graph: LaneGraph, vehicles: Vehicles, starts_m: Float64[np.ndarray, "N W"]
) -> tuple[Int[np.ndarray, "N"], Float64[np.ndarray, "N"]]:
    """Index of the vehicle ahead on each path (-1: none) and the gap to it, m, bumper to bumper.

    Vehicles that have just turned off onto a sibling lane count for as long as they are in the way.
    """
    return _find_leaders(motion_of(vehicles, starts_m), graph.length_m, graph.siblings)


@numba.njit(cache=True)
@no_type_check
def link_occupants(motion, length, granted):
    """Who is on which lane; vehicle i also counts on the next granted[i] lanes of its path."""
    size = 2 * len(motion.active) * WINDOW  # every lane may be granted once more
    following, who, where = np.empty((3, size), np.int64)
    occupants = Occupants(np.full(len(length), -1), following, who, where, np.zeros(1, np.int64))
    for i in range(len(motion.active)):
        if not motion.active[i]:
            continue
        for k in range(WINDOW):
            lane, start = motion.path[i, k], motion.starts_m[i, k]
            if lane < 0:
                continue
            on_it = start < motion.front_m[i] and start + length[lane] > motion.rear_m[i]
            if on_it or BEHIND < k <= BEHIND + granted[i]:
                add_occupant(occupants, lane, i, k)
    return occupants


@numba.njit(cache=True)
@no_type_check
def add_occupant(occupants, lane, vehicle, column):
    """Note that a lane is on one column of a vehicle's path."""
    entry = occupants.used[0]
    occupants.who[entry], occupants.where[entry] = vehicle, column
    occupants.following[entry], occupants.head[lane] = occupants.head[lane], entry
    occupants.used[0] += 1


@numba.njit(cache=True)
@no_type_check
def _find_leaders(motion, length, siblings):
    active, path, starts, front, rear, _ = motion
    count = len(active)
    on = link_occupants(motion, length, np.zeros(count, np.int64))
    leader, gap = np.full(count, -1), np.full(count, np.inf)
    for i in range(count):
        if not active[i]:
            continue
        centre = 0.5 * (front[i] + rear[i])
        for k in range(BEHIND, WINDOW):
            lane = path[i, k]
            if lane < 0 or starts[i, k] - front[i] > min(gap[i], LOOK_M):
                break
            first = siblings.first[lane]
            for m in range(first - 1, siblings.first[lane + 1]):  # one before: the lane itself
                itself = m < first
                entry = on.head[lane if itself else siblings.other[m]]
                while entry >= 0:
                    j, rear_j = on.who[entry], rear[on.who[entry]] - starts[on.who[entry], on.where[entry]]
                    entry = on.following[entry]
                    if j == i or not (itself or rear_j < siblings.other_clear_m[m]):
                        continue
                    centre_j = starts[i, k] + rear_j + 0.5 * (front[j] - rear[j])
                    if centre_j < centre or (centre_j == centre and j < i):
                        continue
                    if starts[i, k] + rear_j - front[i] < gap[i]:
                        leader[i], gap[i] = j, starts[i, k] + rear_j - front[i]
    return leader, gap
