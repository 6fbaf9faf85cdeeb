"""Vehicles that a scenario adds to the traffic, and the right of way that it grants them."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from foredrive.scene import Category
from foredrive.towns.traffic.fleet import draw_fleet, place_vehicles
from foredrive.towns.traffic.lane_graph import LaneGraph
from foredrive.towns.traffic.paths import extend_paths
from foredrive.towns.traffic.state import TrafficState
from foredrive.towns.traffic.traffic import Traffic
from foredrive.towns.traffic.vehicles import AHEAD, BEHIND

CANDIDATES = 16
ACCELERATION_MPS2, TIME_GAP_S, SPEED_FACTOR = 3.0, 1.0, 1.1
"""Values of an added vehicle's driver, so that it reaches a wanted place in time."""
CLEAR_M = 7.0


def point_along(graph: LaneGraph, lanes: Sequence[int], along_m: float) -> tuple[int, float]:
    """Return the index of the lane at a distance along a row of lanes, and the arc length on it, m."""
    starts_m = np.append(0.0, np.cumsum(graph.length_m[list(lanes)]))
    place = min(max(int(np.searchsorted(starts_m, along_m, side="right")) - 1, 0), len(lanes) - 1)
    return place, along_m - float(starts_m[place])


def points_along(
    graph: LaneGraph, lanes: Sequence[int], along_m: Float64[np.ndarray, "n"]
) -> Float64[np.ndarray, "n 3"]:
    """Return points at distances along a row of lanes."""
    places = [point_along(graph, lanes, m) for m in along_m.tolist()]
    return graph.position(np.array([lanes[k] for k, _ in places]), np.array([s for _, s in places]))


def add_vehicle(
    traffic: Traffic, state: TrafficState, slot: int, lanes: Sequence[int], along_m: float, speed_mps: float
) -> TrafficState:
    """Return the state with a car in a slot, at a distance along a row of lanes that it will follow."""
    graph = traffic.lanes
    rng = np.random.default_rng((traffic.seed, 3, state.step_index, slot))
    no = np.zeros(CANDIDATES, dtype=np.bool_)
    # Draw until one is a short car: other kinds are not wanted here
    drawn = draw_fleet(rng, np.full(CANDIDATES, state.next_track_id), no, no)
    car = int(np.argmax((drawn.category == Category.CAR) & (drawn.size_lwh[:, 0] < 5.0)))
    one = drawn.rows(np.array([car]))
    place, s_m = point_along(graph, lanes, along_m)
    one = place_vehicles(graph, one, np.array([lanes[place]]), np.array([s_m]))
    path = one.path.copy()
    onward = list(lanes[place + 1 : place + 1 + AHEAD])
    # The path ahead is given; what lies beyond it is drawn at random
    path[0, BEHIND + 1 : BEHIND + 1 + len(onward)] = onward
    one = dataclasses.replace(
        one,
        path=path,
        speed_mps=np.array([speed_mps]),
        accel_mps2=np.array([ACCELERATION_MPS2]),
        time_gap_s=np.array([TIME_GAP_S]),
        speed_factor=np.array([SPEED_FACTOR]),
    )
    vehicles = state.vehicles.replace_rows(np.array([slot]), one)
    everywhere, nowhere = np.ones(len(graph.ids), dtype=np.bool_), np.zeros(0, dtype=np.int64)
    vehicles = extend_paths(graph, everywhere, vehicles, nowhere, rng)
    return dataclasses.replace(state, vehicles=vehicles, next_track_id=state.next_track_id + 1)


def clear_area(
    traffic: Traffic, state: TrafficState, xyz: Float64[np.ndarray, "n 3"], seen_within_m: float
) -> TrafficState | None:
    """Return the state without the vehicles near some points; None if one of them could be seen to vanish.

    Args:
        seen_within_m: the distance from vehicle 0 within which things are visible, m.
    """
    v, centre = state.vehicles, traffic.poses(state).centre_m
    # None may vanish in sight of vehicle 0, and vehicle 0 never does
    near = (np.linalg.norm(centre[:, None] - xyz, axis=2) < CLEAR_M).any(axis=1) & v.active
    if near[0] or (near & (np.linalg.norm(centre - centre[0], axis=1) < seen_within_m)).any():
        return None
    return dataclasses.replace(state, vehicles=dataclasses.replace(v, active=v.active & ~near))


def grant_junction(traffic: Traffic, state: TrafficState, slot: int, lane: int) -> TrafficState:
    """Grant a vehicle right of way before all others, up to a lane of its path and out of that junction."""
    v, graph = state.vehicles, traffic.lanes
    ahead = v.path[slot, BEHIND:]
    if lane not in ahead:
        return state
    # Extend the grant to the end of the junction
    last = int(np.argmax(ahead == lane))
    while last + 1 < len(ahead) and ahead[last + 1] >= 0 and graph.contested[ahead[last + 1]]:
        last += 1
    granted, rank = v.granted.copy(), v.rank.copy()
    # A negative rank goes before all ranks, which are times
    granted[slot], rank[slot] = last, -1.0
    return dataclasses.replace(state, vehicles=dataclasses.replace(v, granted=granted, rank=rank))
