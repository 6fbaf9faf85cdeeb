"""Recording campaigns: drives over towns, conditions and traffic densities, with balanced commands."""

import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from foredrive.errors import InputError
from foredrive.scene import Command
from foredrive.scene.conditions import ANY_CONDITIONS, CONDITIONS, BackgroundTraffic, find_conditions
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.map.names import map_name
from foredrive.towns.recorder import MAX_RATE_HZ
from foredrive.towns.traffic.expert import SETTLE_S, ExpertDrive, plan_route
from foredrive.towns.traffic.fleet import find_start_points
from foredrive.towns.traffic.lane_graph import build_lane_graph
from foredrive.towns.traffic.traffic import Traffic

CANDIDATES_PER_DRIVE = 8
MAX_TRIES_PER_DRIVE = 4
"""Number of routes that are drawn, and maximum number of routes that are driven, for each recorded drive, if
the campaign chooses the seeds."""


@dataclass(frozen=True)
class DrivePlan:
    """The parameters of one recorded drive."""

    town: str
    seed: int
    conditions: str | None
    """One of `CONDITIONS`; None for bright daylight drawn from the seed."""
    vehicles: int
    people: int
    seconds: float
    rate_hz: float

    @property
    def log_name(self) -> str:
        """Return the log's name from town, seed, and explicit conditions and crowd:
        Town01_seed3_night_45v10p."""
        conditions = "" if self.conditions is None else f"_{self.conditions}"
        usual = (self.vehicles, self.people) == (BackgroundTraffic.vehicles, BackgroundTraffic.pedestrians)
        return f"{map_name(self.town)}_seed{self.seed}{conditions}" + (
            "" if usual else f"_{self.vehicles}v{self.people}p"
        )

    @property
    def frames(self) -> int:
        """Return the number of frames of the log."""
        return max(1, round(self.seconds * self.rate_hz))


@dataclass(frozen=True)
class Campaign:
    """Ranges from which drives are drawn. Every town is driven under all conditions, several times.

    Raises:
        InputError: a range is empty or impossible.
    """

    towns: tuple[str, ...]
    seeds: tuple[int, ...] | int
    """Seeds of each town under each of the conditions. If this is a number, that many seeds are chosen such
    that the commands at the passed forks are balanced over all drives."""
    conditions: tuple[str, ...] = ()
    """Names of `CONDITIONS`. `ANY_CONDITIONS` alone distributes all conditions evenly, one for each town and
    seed. Empty: bright daylight."""
    vehicles: tuple[int, int] = (BackgroundTraffic.vehicles, BackgroundTraffic.vehicles)
    """Minimum and maximum, drawn for each town and seed."""
    people: tuple[int, int] = (BackgroundTraffic.pedestrians, BackgroundTraffic.pedestrians)
    seconds: float = 20.0
    rate_hz: float = 10.0

    def __post_init__(self) -> None:
        if not self.towns or not self.seeds or (isinstance(self.seeds, int) and self.seeds < 0):
            raise InputError("a recording needs at least one town and one seed")
        if not self.seconds > 0:
            raise InputError(f"the length of a recording must be more than 0 s, got {self.seconds:g}")
        if not 0 < self.rate_hz <= MAX_RATE_HZ:
            raise InputError(
                f"the frame rate must be above 0 and at most {MAX_RATE_HZ:g} Hz, got {self.rate_hz:g}"
            )
        if self.conditions != (ANY_CONDITIONS,):
            for name in self.conditions:
                find_conditions(name)
        for what, (minimum, maximum) in (("vehicles", self.vehicles), ("people", self.people)):
            if not 0 <= minimum <= maximum:
                raise InputError(
                    f"the range of {what} must be 0 or more and in order, got {minimum}..{maximum}"
                )


def plan_drives(campaign: Campaign) -> list[DrivePlan]:
    """Plan the drives of a campaign, sorted by town, conditions and seed.

    The result is always the same, and log names are unique. Where the campaign chooses seeds, some of them
    are driven without sensors, which takes a second or two for each.

    Raises:
        InputError: there is no such town.
    """
    conditions_cycle, counts = _cycle_conditions(), Counter[Command]()
    plans = []
    for town in dict.fromkeys(campaign.towns):
        load_town_map(town)  # Raises an error that lists the known towns
        for conditions, seed in _town_drives(campaign, town, conditions_cycle, counts):
            plans.append(_plan_drive(campaign, town, seed, conditions))
    return plans


def _plan_drive(campaign: Campaign, town: str, seed: int, conditions: str | None) -> DrivePlan:
    """Plan one drive. Its traffic is the same under all conditions."""
    rng = np.random.default_rng([seed, *map_name(town).encode()])
    vehicles, people = (
        int(rng.integers(minimum, maximum + 1)) for minimum, maximum in (campaign.vehicles, campaign.people)
    )
    return DrivePlan(town, seed, conditions, vehicles, people, campaign.seconds, campaign.rate_hz)


def _town_drives(
    campaign: Campaign, town: str, conditions_cycle: Iterator[str], counts: Counter[Command]
) -> list[tuple[str | None, int]]:
    """Return the conditions and the seed of each drive in one town.

    If the campaign chooses the seeds, the commands are counted into `counts`.
    """
    any_conditions = campaign.conditions == (ANY_CONDITIONS,)
    groups: list[str | None] = [None]
    if campaign.conditions and not any_conditions:
        groups = list(dict.fromkeys(campaign.conditions))
    if isinstance(campaign.seeds, int):
        # Candidate routes of all seeds; the balance chooses among them by their commands
        drives = campaign.seeds * len(groups)
        routes = count_route_commands(town, campaign.seconds, range(CANDIDATES_PER_DRIVE * drives))
        chosen = select_balanced(
            routes, drives, counts, lambda seed: driven_commands(_plan_drive(campaign, town, seed, None))
        )
        for commands in chosen.values():
            counts.update(commands)
        # Distribute the chosen seeds over the conditions in turn
        planned = [(groups[i % len(groups)], seed) for i, seed in enumerate(chosen)]
    else:
        planned = [(group, seed) for group in groups for seed in dict.fromkeys(campaign.seeds)]
    if any_conditions:
        # Every drive takes the next of all conditions
        planned = [(next(conditions_cycle), seed) for _, seed in planned]
    return sorted(planned, key=lambda drive: (groups.index(drive[0]) if not any_conditions else 0, drive[1]))


def _cycle_conditions() -> Iterator[str]:
    """Yield all conditions in random order, again and again."""
    # Each round has all conditions in another order
    for round_ in itertools.count():
        order = np.random.default_rng(round_).permutation(len(CONDITIONS))
        yield from (list(CONDITIONS)[i] for i in order)


def count_route_commands(town: str, seconds: float, seeds: Sequence[int]) -> list[Counter[Command]]:
    """Return the approximate counts of the commands on the recorded part of a route, for each seed.

    Takes some milliseconds for each seed.
    """
    lanes = build_lane_graph(load_town_map(town))
    starts = find_start_points(lanes)
    routes = (plan_route(lanes, starts, seed, seconds) for seed in seeds)
    window_s = SETTLE_S, SETTLE_S + seconds
    return [
        # Commands between the end of the settling time and the end of the drive, by expected pace
        Counter(route.commands(lanes, until_m, from_m))
        for route in routes
        for from_m, until_m in [(route.distance_m(lanes, s) for s in window_s)]
    ]


def driven_commands(plan: DrivePlan) -> Counter[Command]:
    """Return the counts of the expert's commands at the forks that it passes during a recorded drive."""
    drive = ExpertDrive(
        Traffic(load_town_map(plan.town), plan.seed, plan.vehicles + 1, plan.people), plan.seconds
    )
    for _ in drive.snapshots(plan.frames, 1 / plan.rate_hz):
        pass
    return Counter(drive.driven_commands())


def select_balanced(
    routes: Sequence[Counter[Command]],
    count: int,
    counts: Counter[Command],
    drive_route: Callable[[int], Counter[Command]],
) -> dict[int, Counter[Command]]:
    """Choose `count` routes whose commands, together with those so far, are balanced.

    Returns the indices of the routes, each with the commands that were met on it. The choice is greedy: the
    next route maximises the number of commands minus the sum of their squared differences from their mean.
    The commands that are met on a route are requested only when the route would be chosen, for at most
    `MAX_TRIES_PER_DRIVE` routes per drive. Then its commands are known, and another route may be better. A
    command that no route has is ignored.
    """
    commands = list(Command)
    # Commands of each route, one row per route; at first those that are expected
    times = np.array([[route[kind] for kind in commands] for route in routes])
    total = np.array([counts[kind] for kind in commands], dtype=np.int64)
    available, tries, counts_of = np.ones(len(routes), dtype=bool), 0, dict[int, Counter[Command]]()
    chosen: dict[int, Counter[Command]] = {}
    while len(chosen) < count:
        # Totals after each possible choice, over the commands that occur at all
        after = (total + times)[:, times.any(axis=0)]
        number, mean = after.sum(axis=1), after.mean(axis=1, keepdims=True) if after.size else 0.0
        # Many commands are good, uneven ones bad
        gain = np.where(available, number - np.sum((after - mean) ** 2, axis=1), -np.inf)
        # Enough routes driven for this choice: only those whose commands are known remain
        if tries == MAX_TRIES_PER_DRIVE:
            gain[[i for i in range(len(routes)) if i not in counts_of]] = -np.inf
        best = int(gain.argmax())
        # Drive a route before it is chosen, because traffic may change what it meets
        if best not in counts_of:
            counts_of[best], tries = drive_route(best), tries + 1
            times[best] = [counts_of[best][kind] for kind in commands]
        else:
            chosen[best], available[best], tries = counts_of[best], False, 0
            total = total + times[best]
    return chosen
