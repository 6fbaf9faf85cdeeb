"""Routes: random ways over the lane graph with balanced left turns, right turns and straight ways."""

import itertools
from collections import Counter
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int

from foredrive.errors import InputError
from foredrive.scene import Command
from foredrive.towns.traffic.fleet import StartPoints
from foredrive.towns.traffic.lane_changes import ChangeRanges, find_change_ranges
from foredrive.towns.traffic.lane_graph import LaneGraph
from foredrive.towns.traffic.leaders import project_to_neighbour

CANDIDATES = 48
ROUTE_SPACING_M = 1.0
PLANNED_CHANGE_S, MIN_CHANGE_M = 4.0, 45.0
"""Duration (s) and minimum length (m) of a lane change on a route. On a shorter way a shift of 3.5 m would
look like a turn."""
CHANGE_ROOM_M = 30.0
CHANGE_ROOM_S = 5.0
"""Minimum length of a lane in which a route may change lanes: this distance plus this driving time."""
TRAFFIC_FACTOR = 1.3
LIGHT_S, GIVE_WAY_S = 15.0, 6.0
"""Factor of other traffic on the driving time, and the additional time per light and per sign, s. These are
means over hours in all towns, which range from 30 % less (Town02) to 60 % more (Town05)."""
LONG_DRIVE_M = 600.0
"""Driven distance above which a drive is long, m. Routes of long drives have all commands, others two."""


@dataclass(frozen=True)
class Route:
    """Lanes that follow each other from a point on the first one, with lane changes on some of them."""

    lanes: Int[np.ndarray, "R"]
    """Lane at the end of each stretch."""
    start_m: float
    """Arc length on the first lane at which the route begins, m."""
    entered: Int[np.ndarray, "R"]
    """Lane at the start of each stretch: the same lane or a neighbour of it."""

    def polyline(self, graph: LaneGraph) -> Float64[np.ndarray, "M 3"]:
        """Return points along the centrelines, `ROUTE_SPACING_M` apart.

        Lane changes come early on their stretch.
        """
        # Distance at which each lane begins, from the start of the first lane
        length = graph.length_m[self.lanes]
        begins = np.cumsum(length) - length
        s = np.arange(self.start_m, begins[-1] + length[-1], ROUTE_SPACING_M)
        # Stretch of each point, and the arc length on its lane
        leg = np.searchsorted(begins, s, side="right") - 1
        lane, along = self.lanes[leg], s - begins[leg]
        points = graph.position(lane, along)
        # Points on stretches with a lane change are moved from the old lane to the new one
        for k in np.flatnonzero((self.lanes != self.entered)[leg]):
            old = int(self.entered[leg[k]])
            beside = 1 if graph.left[lane[k]] == old else -1
            before = graph.position(
                np.array([old]), np.array([project_to_neighbour(lane[k], along[k], beside, graph.sides)])
            )
            # The change takes some seconds at the limit, but ends within the stretch
            from_m = self.start_m if leg[k] == 0 else 0.0
            over_m = max(MIN_CHANGE_M, PLANNED_CHANGE_S * graph.limit_mps[old])
            over_m = min(over_m, graph.length_m[lane[k]] - from_m)
            x = np.clip((along[k] - from_m) / over_m, 0.0, 1.0)
            # Quintic blend from the point beside on the old lane: zero
            # lateral speed and acceleration at both ends
            points[k] += (1 - x**3 * (10 - 15 * x + 6 * x**2)) * (before[0] - points[k])
        return points

    def commands(self, graph: LaneGraph, until_m: float, from_m: float = 0.0) -> list[Command]:
        """Return the command at each fork between two distances (m) from the start."""
        length = graph.length_m[self.lanes]
        begins = np.cumsum(length) - length - self.start_m
        first, end = np.searchsorted(begins[1:], [from_m, until_m])
        return self.commands_on(graph, int(first), int(end))

    def commands_on(self, graph: LaneGraph, first: int, end: int) -> list[Command]:
        # A fork is where there is a choice, or where the lane turns
        """Return the command at each fork on the way from lane number `first` to number `end`."""
        return [
            graph.command(int(lane))
            for before, lane in itertools.pairwise(self.lanes[first : end + 1])
            if graph.successor_count[before] > 1 or graph.command(int(lane)) != Command.STRAIGHT
        ]

    def distance_m(self, graph: LaneGraph, seconds: float) -> float:
        """Return the approximate distance that is driven in a time, m, with delays by other traffic and
        lights."""
        at_s, at_m = self._progress(graph)
        return float(np.interp(seconds, at_s, at_m))

    def duration_s(self, graph: LaneGraph) -> float:
        """Return the approximate time to the end of the route, s."""
        return float(self._progress(graph)[0][-1])

    def _progress(self, graph: LaneGraph) -> tuple[Float64[np.ndarray, "P"], Float64[np.ndarray, "P"]]:
        """Return times, s, and distances at these times, m: between them the distance grows evenly."""
        # Mean time per metre on each lane: mean of 1 / speed over its samples
        pace_s = np.add.reduceat(1 / graph.speed_mps, graph.first) / graph.count
        length = graph.length_m[self.lanes].copy()
        length[0] -= self.start_m
        # Waiting time at the start of each lane: lights, stop signs and yield signs
        waits_s = np.array([0.0, LIGHT_S, GIVE_WAY_S, GIVE_WAY_S])[graph.control[self.lanes]]
        waits_s[0] = 0.0
        steps_s = np.stack([waits_s, TRAFFIC_FACTOR * pace_s[self.lanes] * length], axis=1)
        steps_m = np.stack([np.zeros(len(length)), length], axis=1)
        # Flat while waiting
        return np.append(0.0, np.cumsum(steps_s)), np.append(0.0, np.cumsum(steps_m))


def draw_route(
    graph: LaneGraph,
    starts: StartPoints,
    rng: np.random.Generator,
    length_m: float,
    from_s: float,
    until_s: float,
) -> Route:
    """Draw a random route of at least `length_m`.

    Routes from random starts are tried. The part that counts is driven from `from_s` to `until_s`. The first
    route is taken that has a turn and at least two different commands, or on long drives all commands. If
    there is none, the route with the most different commands is taken. Ties go to routes that contain a
    command drawn at random, then to routes with more turns. Routes that end at the edge of a tile come last,
    and of these those that end too early.

    Raises:
        InputError: all that were tried end too early, as on a small map.
    """
    best, best_key = None, (False, False, -1, False, -1)
    wanted = rng.choice(list(Command))
    change_ranges = find_change_ranges(graph)
    for start in rng.choice(len(starts.lane), CANDIDATES):
        route = _extend(
            graph, change_ranges, int(starts.lane[start]), float(starts.s_m[start]), rng, length_m
        )
        from_m, until_m = route.distance_m(graph, from_s), route.distance_m(graph, until_s)
        commands = route.commands(graph, until_m, from_m)
        turns, options = len(commands) - commands.count(Command.STRAIGHT), len(set(commands))
        goes_on = bool(graph.successor_count[route.lanes[-1]])
        # Good enough: a turn, and the wanted variety of commands
        if goes_on and turns and options >= (len(Command) if until_m - from_m > LONG_DRIVE_M else 2):
            return route
        key = (goes_on, route.duration_s(graph) >= until_s, options, wanted in commands, turns)
        if best is None or key > best_key:
            best, best_key = route, key
    assert best is not None
    if not any(best_key[:2]):
        raise InputError(
            f"the roads end after {best.duration_s(graph):.0f} s; a drive of {until_s - from_s:.0f} s needs "
            f"{until_s:.0f} s: record less, or take a larger map"
        )
    return best


def _extend(
    graph: LaneGraph,
    change_ranges: ChangeRanges,
    lane: int,
    start_m: float,
    rng: np.random.Generator,
    length_m: float,
) -> Route:
    """Extend a route: at each fork take the least used command, from a neighbouring lane if needed; ties at
    random."""
    lanes, entered, to_go = [lane], [lane], length_m + start_m - graph.length_m[lane]
    taken: Counter[Command] = Counter()
    while to_go > 0:
        # On the first lane there is no room for a lane change
        options = _options(graph, change_ranges, lanes[-1], may_change=len(lanes) > 1)
        if not options:
            break
        commands = [graph.command(onward) for _, onward in options]
        # The commands used least so far; among them prefer the ones without a lane change
        min_count = min(taken[command] for command in commands)
        least_taken = [i for i, command in enumerate(commands) if taken[command] == min_count]
        straight_on = [i for i in least_taken if options[i][0] == lanes[-1]]
        choice = int(rng.choice(straight_on or least_taken))
        # A way without choice is no fork and does not count
        if len(options) > 1:
            taken[commands[choice]] += 1
        # The last lane is replaced: the route changes lanes on its stretch
        lanes[-1], onward = options[choice]
        lanes.append(onward)
        entered.append(onward)
        to_go -= graph.length_m[onward]
    return Route(np.array(lanes), start_m, np.array(entered))


def _options(
    graph: LaneGraph, change_ranges: ChangeRanges, lane: int, may_change: bool
) -> list[tuple[int, int]]:
    """Return pairs of a lane at the end of the stretch and a successor of it.

    Before junctions the neighbouring lanes count as well.
    """
    ends = [lane]
    onward = graph.successors[lane, : graph.successor_count[lane]]
    # A change needs room, and only pays where the junction offers other ways from the neighbour
    enough_m = CHANGE_ROOM_M + CHANGE_ROOM_S * graph.limit_mps[lane]
    if may_change and len(onward) and (graph.junction[onward] >= 0).all() and graph.length_m[lane] > enough_m:
        ends += change_ranges.target[change_ranges.target[:, lane] >= 0, lane].tolist()
    return [(end, int(n)) for end in ends for n in graph.successors[end, : graph.successor_count[end]]]
