"""Routes to follow: random ways over the lane graph that turn left, right and go straight alike."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int

from foredrive.scene import Command
from foredrive.towns.traffic.fleet import Starts
from foredrive.towns.traffic.lane_changes import Stretches, find_stretches
from foredrive.towns.traffic.lane_graph import LaneGraph
from foredrive.towns.traffic.leaders import abreast

CANDIDATES = 48
ROUTE_SPACING_M = 1.0
PLANNED_CHANGE_S = 4.0
CHANGE_ROOM_M = 30.0
CHANGE_ROOM_S = 5.0
"""Routes change lanes where a lane is this long and takes this much longer to drive."""


@dataclass(frozen=True)
class Route:
    """Lanes that follow each other, from a point on the first one; some are to be changed on the way."""

    lanes: Int[np.ndarray, "R"]
    """Where to be at the end of each stretch."""
    start_m: float
    """Arc length on the first lane at which the route begins."""
    entered: Int[np.ndarray, "R"]
    """Where to be at its start: the same lane, or a neighbour of it."""

    def polyline(self, graph: LaneGraph) -> Float64[np.ndarray, "M 3"]:
        """Points along the centrelines, `ROUTE_SPACING_M` apart; lanes are changed early on their stretch."""
        length = graph.length_m[self.lanes]
        begins = np.cumsum(length) - length
        s = np.arange(self.start_m, begins[-1] + length[-1], ROUTE_SPACING_M)
        at = np.searchsorted(begins, s, side="right") - 1
        lane, along = self.lanes[at], s - begins[at]
        points = graph.position(lane, along)
        for k in np.flatnonzero((self.lanes != self.entered)[at]):
            old = int(self.entered[at[k]])
            beside = 1 if graph.left[lane[k]] == old else -1
            before = graph.position(
                np.array([old]), np.array([abreast(lane[k], along[k], beside, graph.sides)])
            )
            over_m = PLANNED_CHANGE_S * graph.limit_mps[old]
            x = np.clip((along[k] - (self.start_m if at[k] == 0 else 0.0)) / over_m, 0.0, 1.0)
            points[k] += (1 - x**3 * (10 - 15 * x + 6 * x**2)) * (before[0] - points[k])
        return points

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
    stretches = find_stretches(graph)
    for start in rng.choice(len(starts.lane), CANDIDATES):
        route = _roll_out(graph, stretches, int(starts.lane[start]), float(starts.s_m[start]), rng, length_m)
        commands = route.commands(graph, driven_m)
        turns = len(commands) - commands.count(Command.STRAIGHT)
        if turns and len(set(commands)) > 1:
            return route
        if turns > most_turns:
            best, most_turns = route, turns
    assert best is not None
    return best


def _roll_out(
    graph: LaneGraph,
    stretches: Stretches,
    lane: int,
    start_m: float,
    rng: np.random.Generator,
    length_m: float,
) -> Route:
    """At each fork take the command taken least often, from the next lane if need be; ties at random."""
    lanes, entered, to_go = [lane], [lane], length_m + start_m - graph.length_m[lane]
    taken: Counter[Command] = Counter()
    while to_go > 0:
        ways = _ways_on(graph, stretches, lanes[-1], may_change=len(lanes) > 1)
        if not ways:
            break
        commands = [graph.command(onward) for _, onward in ways]
        fewest = min(taken[command] for command in commands)
        least = [i for i, command in enumerate(commands) if taken[command] == fewest]
        straight_on = [i for i in least if ways[i][0] == lanes[-1]]
        choice = int(rng.choice(straight_on or least))
        if len(ways) > 1:
            taken[commands[choice]] += 1
        lanes[-1], onward = ways[choice]
        lanes.append(onward)
        entered.append(onward)
        to_go -= graph.length_m[onward]
    return Route(np.array(lanes), start_m, np.array(entered))


def _ways_on(graph: LaneGraph, stretches: Stretches, lane: int, may_change: bool) -> list[tuple[int, int]]:
    """The lanes to be in at the end of a stretch, each with one that follows it: before junctions also those
    of the neighbours."""
    ends = [lane]
    onward = graph.successors[lane, : graph.successor_count[lane]]
    enough_m = CHANGE_ROOM_M + CHANGE_ROOM_S * graph.limit_mps[lane]
    if may_change and len(onward) and (graph.junction[onward] >= 0).all() and graph.length_m[lane] > enough_m:
        ends += stretches.target[stretches.target[:, lane] >= 0, lane].tolist()
    return [(end, int(n)) for end in ends for n in graph.successors[end, : graph.successor_count[end]]]
