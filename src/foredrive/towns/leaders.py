"""Who is ahead: the vehicles on each lane, and the nearest one on a vehicle's path."""

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float64, Int

from foredrive.towns.lane_graph import LaneGraph
from foredrive.towns.vehicles import BEHIND, WINDOW, Vehicles

LOOK_M = 150.0


def find_leaders(
    graph: LaneGraph, vehicles: Vehicles, starts_m: Float64[np.ndarray, "N W"]
) -> tuple[Int[np.ndarray, "N"], Float64[np.ndarray, "N"]]:
    """Index of the vehicle ahead on each path (-1: none) and the gap to it, m, bumper to bumper.

    Vehicles that have just turned off onto a sibling lane count for as long as they are in the way.
    """
    siblings = graph.siblings
    return _find_leaders(
        vehicles.active,
        vehicles.path,
        starts_m,
        graph.length_m,
        vehicles.front_m,
        vehicles.rear_m,
        siblings.first,
        siblings.other,
        siblings.other_clear_m,
    )


@numba.njit(cache=True)
@no_type_check
def link_occupants(active, path, starts, length, front, rear, last, head, following, who, where):
    """Linked lists of the vehicles on each lane: head[lane], then following[entry] until -1.

    The entry is of vehicle who[entry], on column where[entry] of its path. The next last[i] columns of
    vehicle i count as occupied, too. Returns the number of entries.
    """
    used = 0
    for i in range(len(active)):
        if not active[i]:
            continue
        for k in range(WINDOW):
            lane = path[i, k]
            if lane < 0:
                continue
            on_it = starts[i, k] < front[i] and starts[i, k] + length[lane] > rear[i]
            if on_it or BEHIND < k <= BEHIND + last[i]:
                who[used], where[used] = i, k
                following[used], head[lane] = head[lane], used
                used += 1
    return used


@numba.njit(cache=True)
@no_type_check
def _find_leaders(active, path, starts, length, front, rear, sib_first, sib_other, sib_clear):
    count = len(active)
    head = np.full(len(length), -1)
    following, who, where = np.empty((3, count * WINDOW), np.int64)
    link_occupants(
        active, path, starts, length, front, rear, np.zeros(count, np.int64), head, following, who, where
    )
    leader, gap = np.full(count, -1), np.full(count, np.inf)
    for i in range(count):
        if not active[i]:
            continue
        centre = 0.5 * (front[i] + rear[i])
        for k in range(BEHIND, WINDOW):
            lane = path[i, k]
            if lane < 0 or starts[i, k] - front[i] > min(gap[i], LOOK_M):
                break
            for m in range(sib_first[lane] - 1, sib_first[lane + 1]):  # one before: the lane itself
                itself = m < sib_first[lane]
                entry = head[lane if itself else sib_other[m]]
                while entry >= 0:
                    j, rear_j = who[entry], rear[who[entry]] - starts[who[entry], where[entry]]
                    entry = following[entry]
                    if j == i or not (itself or rear_j < sib_clear[m]):
                        continue
                    centre_j = starts[i, k] + rear_j + 0.5 * (front[j] - rear[j])
                    if centre_j < centre or (centre_j == centre and j < i):
                        continue
                    if starts[i, k] + rear_j - front[i] < gap[i]:
                        leader[i], gap[i] = j, starts[i, k] + rear_j - front[i]
    return leader, gap
