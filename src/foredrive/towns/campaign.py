"""What to record: drives over towns, conditions and densities that turn left and right alike."""

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from foredrive.errors import InputError
from foredrive.scene import Command
from foredrive.towns.conditions import CONDITIONS, find_conditions
from foredrive.towns.map.town_map import load_town_map
from foredrive.towns.recorder import FASTEST_HZ, Crowd
from foredrive.towns.traffic.expert import driven_m, plan_route
from foredrive.towns.traffic.fleet import find_starts
from foredrive.towns.traffic.lane_graph import build_lane_graph

ANY_CONDITIONS = "any"
SEEDS_PER_DRIVE = 8
"""How many routes are drawn for each one that is driven, where seeds may be chosen."""


@dataclass(frozen=True)
class DrivePlan:
    """One drive to be recorded."""

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
        """Town and seed, and whatever of conditions and crowd was asked for: Town01_seed3_night_45v10p."""
        conditions = "" if self.conditions is None else f"_{self.conditions}"
        usual = (self.vehicles, self.people) == (Crowd.vehicles, Crowd.people)
        return f"{self.town}_seed{self.seed}{conditions}" + (
            "" if usual else f"_{self.vehicles}v{self.people}p"
        )

    @property
    def frames(self) -> int:
        """Length of the log."""
        return max(1, round(self.seconds * self.rate_hz))


@dataclass(frozen=True)
class Campaign:
    """Ranges that drives are drawn from: every town is driven under all conditions, several times.

    Raises:
        InputError: an empty or impossible range.
    """

    towns: tuple[str, ...]
    seeds: tuple[int, ...] | int
    """Of each town under each of the conditions; or how many, then the seeds are chosen such that the route
    commands even out over all drives."""
    conditions: tuple[str, ...] = ()
    """Names of `CONDITIONS`. Alone, `ANY_CONDITIONS` deals them out evenly, one for each town and seed; none
    at all leaves bright daylight."""
    vehicles: tuple[int, int] = (Crowd.vehicles, Crowd.vehicles)
    """Fewest and most; drawn for each drive."""
    people: tuple[int, int] = (Crowd.people, Crowd.people)
    seconds: float = 20.0
    rate_hz: float = 10.0

    def __post_init__(self) -> None:
        if not self.towns or not self.seeds or (isinstance(self.seeds, int) and self.seeds < 0):
            raise InputError("there is nothing to record without a town and a seed")
        if not self.seconds > 0:
            raise InputError(f"a recording takes more than 0 s, got {self.seconds:g}")
        if not 0 < self.rate_hz <= FASTEST_HZ:
            raise InputError(f"the frame rate lies above 0 and up to {FASTEST_HZ:g} Hz, got {self.rate_hz:g}")
        if self.conditions != (ANY_CONDITIONS,):
            for name in self.conditions:
                find_conditions(name)
        for what, (fewest, most) in (("vehicles", self.vehicles), ("people", self.people)):
            if not 0 <= fewest <= most:
                raise InputError(f"{what} range from 0 or more upwards, got {fewest}..{most}")


def plan_drives(campaign: Campaign) -> list[DrivePlan]:
    """The drives of a campaign, always the same, by town, conditions and seed; log names are unique.

    Raises:
        InputError: there is no such town.
    """
    deck, driven = _deal_conditions(), Counter[Command]()
    plans = []
    for town in dict.fromkeys(campaign.towns):
        load_town_map(town)  # names the known towns if it is none of them
        for conditions, seed in _town_drives(campaign, town, deck, driven):
            rng = np.random.default_rng([seed, *f"{town} {conditions}".encode()])
            vehicles, people = (
                int(rng.integers(fewest, most + 1)) for fewest, most in (campaign.vehicles, campaign.people)
            )
            drive = (campaign.seconds, campaign.rate_hz)
            plans.append(DrivePlan(town, seed, conditions, vehicles, people, *drive))
    return plans


def _town_drives(
    campaign: Campaign, town: str, deck: Iterator[str], driven: Counter[Command]
) -> list[tuple[str | None, int]]:
    """Conditions and seed of each drive in one town; counts the commands into `driven` if it chose seeds."""
    dealt = campaign.conditions == (ANY_CONDITIONS,)
    groups: list[str | None] = [None]
    if campaign.conditions and not dealt:
        groups = list(dict.fromkeys(campaign.conditions))
    if isinstance(campaign.seeds, int):
        drives = campaign.seeds * len(groups)
        routes = route_commands(town, campaign.seconds, range(SEEDS_PER_DRIVE * drives))
        chosen = choose_balanced(routes, drives, driven)
        for seed in chosen:
            driven.update(routes[seed])
        found = [(groups[i % len(groups)], seed) for i, seed in enumerate(chosen)]
    else:
        found = [(group, seed) for group in groups for seed in dict.fromkeys(campaign.seeds)]
    if dealt:
        found = [(next(deck), seed) for _, seed in found]
    return sorted(found, key=lambda drive: (groups.index(drive[0]) if not dealt else 0, drive[1]))


def _deal_conditions() -> Iterator[str]:
    """All conditions in random order, again and again."""
    for round_ in itertools.count():
        order = np.random.default_rng(round_).permutation(len(CONDITIONS))
        yield from (list(CONDITIONS)[i] for i in order)


def route_commands(town: str, seconds: float, seeds: Sequence[int]) -> list[Counter[Command]]:
    """How often the route of a drive says what while it is recorded, for each of some seeds (1 ms each)."""
    lanes = build_lane_graph(load_town_map(town))
    starts = find_starts(lanes)
    routes = (plan_route(lanes, starts, seed, seconds) for seed in seeds)
    before_m, until_m = driven_m(0.0), driven_m(seconds)  # traffic settles before the first frame
    return [
        Counter(route.commands(lanes, until_m)) - Counter(route.commands(lanes, before_m)) for route in routes
    ]


def choose_balanced(routes: Sequence[Counter[Command]], count: int, so_far: Counter[Command]) -> list[int]:
    """Indices of `count` routes whose commands, with those so far, even out.

    Greedy: the next route is the one that does most for the rarest command and least for the commonest. A
    command that none of the routes has is left out of account.
    """
    kinds = sorted(set().union(*routes))
    times = np.array([[route[kind] for kind in kinds] for route in routes]).reshape(len(routes), len(kinds))
    total = np.array([so_far[kind] for kind in kinds], dtype=np.int64)
    left = np.ones(len(routes), dtype=bool)
    chosen: list[int] = []
    for _ in range(count):
        after = total + times
        gain = 2 * after.min(axis=1, initial=after.max(initial=0)) - after.max(axis=1, initial=0)
        best = int(np.where(left, gain, np.iinfo(np.int64).min).argmax())
        left[best] = False
        total = after[best]
        chosen.append(best)
    return chosen
