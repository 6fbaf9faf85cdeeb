"""Paths of vehicles: the lanes they take at forks."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Int

from foredrive.towns.traffic.fleet import is_large
from foredrive.towns.traffic.lane_graph import LaneGraph
from foredrive.towns.traffic.vehicles import BEHIND, Vehicles


def extend_paths(
    graph: LaneGraph,
    for_large: Bool[np.ndarray, "L"],
    vehicles: Vehicles,
    route: Int[np.ndarray, "R"],
    rng: np.random.Generator,
) -> Vehicles:
    """Fill in the unknown lanes ahead, from the route or by random turns.

    Args:
        for_large: lanes that large vehicles keep to.
        route: the lane in which vehicle 0 has to be at the end of each stretch, from its current stretch on.
    """
    v, path = vehicles, vehicles.path.copy()
    # Large vehicles only take lanes that they can drive
    fits = for_large | ~is_large(v)[:, None]
    for column in range(BEHIND + 1, path.shape[1]):
        # Rows whose next lane is unknown
        rows = np.flatnonzero(v.active & (path[:, column] < 0))
        if not len(rows):
            continue
        # Uniform draw among the allowed successors
        options = graph.successors[path[rows, column - 1]]
        weight = (options >= 0) * fits[rows[:, None], options]
        cumulated = np.cumsum(weight, axis=1)
        u = rng.random((len(rows), 1)) * cumulated[:, -1:]
        path[rows, column] = options[np.arange(len(rows)), np.argmax(cumulated > u, axis=1)]
        stretch = column - BEHIND
        # Vehicle 0 follows its route as far as that is known
        if rows[0] == 0 and stretch < len(route):
            before, drawn = int(path[0, column - 1]), int(path[0, column])
            path[0, column] = towards(graph, before, int(route[stretch]), drawn)
    return dataclasses.replace(v, path=path)


def towards(graph: LaneGraph, lane: int, wanted: int, otherwise: int) -> int:
    """Return the successor of `lane` that is `wanted` or a lane beside it, or `otherwise` if there is
    none."""
    options = graph.successors[lane, : graph.successor_count[lane]].tolist()
    # Look to the left of the wanted lane, then to the right
    for side in graph.sides.lane:
        beside = wanted
        while beside >= 0 and beside not in options:
            beside = int(side[beside])
        if beside >= 0:
            return beside
    return otherwise
