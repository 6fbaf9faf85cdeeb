"""Routes to follow: random ways over the lane graph that turn left, right and go straight alike."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int

from foredrive.scene import Command
from foredrive.towns.traffic.fleet import Starts
from foredrive.towns.traffic.lane_graph import LaneGraph

CANDIDATES = 48
ROUTE_SPACING_M = 1.0


@dataclass(frozen=True)
class Route:
    """Lanes that follow each other, from a point on the first one."""

    lanes: Int[np.ndarray, "R"]
    start_m: float
    """Arc length on the first lane at which the route begins."""

    def polyline(self, graph: LaneGraph) -> Float64[np.ndarray, "M 3"]:
        """Points along the centrelines, `ROUTE_SPACING_M` apart."""
        length = graph.length_m[self.lanes]
        begins = np.cumsum(length) - length
        s = np.arange(self.start_m, begins[-1] + length[-1], ROUTE_SPACING_M)
        at = np.searchsorted(begins, s, side="right") - 1
        return graph.position(self.lanes[at], s - begins[at])

    def commands(self, graph: LaneGraph, within_m: float) -> list[Command]:
        """What to do at each fork that is met within a distance from the start."""
        length = graph.length_m[self.lanes]
        begins = np.cumsum(length) - length - self.start_m
        return [
            graph.command(int(lane))
            for lane, before, begin in zip(self.lanes[1:], self.lanes[:-1], begins[1:], strict=True)
            if begin < within_m
            and (graph.successor_count[before] > 1 or graph.command(int(lane)) != Command.STRAIGHT)
        ]


def draw_route(
    graph: LaneGraph, starts: Starts, rng: np.random.Generator, length_m: float, driven_m: float
) -> Route:
    """A random route of at least `length_m`.

    Of some random starts the first is taken whose route turns and also goes on in another way within the
    `driven_m` that will be driven of it; if there is none, the one that turns most often.
    """
    best, most_turns = None, -1
    for start in rng.choice(len(starts.lane), CANDIDATES):
        route = _roll_out(graph, int(starts.lane[start]), float(starts.s_m[start]), rng, length_m)
        commands = route.commands(graph, driven_m)
        turns = len(commands) - commands.count(Command.STRAIGHT)
        if turns and len(set(commands)) > 1:
            return route
        if turns > most_turns:
            best, most_turns = route, turns
    assert best is not None
    return best


def _roll_out(
    graph: LaneGraph, lane: int, start_m: float, rng: np.random.Generator, length_m: float
) -> Route:
    """At each fork take the command taken least often so far, ties at random."""
    lanes, to_go = [lane], length_m + start_m - graph.length_m[lane]
    taken: Counter[Command] = Counter()
    while to_go > 0:
        options = graph.successors[lanes[-1], : graph.successor_count[lanes[-1]]]
        if not len(options):
            break
        commands = [graph.command(int(option)) for option in options]
        fewest = min(taken[command] for command in commands)
        choice = int(rng.choice([i for i, command in enumerate(commands) if taken[command] == fewest]))
        if len(options) > 1:
            taken[commands[choice]] += 1
        lanes.append(int(options[choice]))
        to_go -= graph.length_m[lanes[-1]]
    return Route(np.array(lanes), start_m)
