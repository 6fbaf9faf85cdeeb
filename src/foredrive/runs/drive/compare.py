"""Comparison of agents over the same routes: paired differences, and the routes that separate them."""

import dataclasses
import os
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from foredrive.driving.drive_record import DriveRecord
from foredrive.driving.item_response import Ratings, rate
from foredrive.driving.route_sets import OF, SHORT_10
from foredrive.driving.scores import Ending, InfractionKind
from foredrive.engine.folder import DRIVES
from foredrive.errors import InputError
from foredrive.runs.drive.records import read_drive, read_suite
from foredrive.runs.drive.suite import ROUTES_SHA256
from foredrive.tasks.bootstrap import LEAST_ROUTES, BootstrapMean, bootstrap_mean

COLLISIONS = (
    InfractionKind.COLLISION_PEDESTRIAN,
    InfractionKind.COLLISION_VEHICLE,
    InfractionKind.COLLISION_STATIC,
)
METRICS = (
    "driving_score_1_0",
    "driving_score_2_1",
    "completion",
    "red_lights",
    "collisions",
    "stop_signs",
    "speed_mps",
)
"""Values of a drive. The first three are in %, infractions are counts."""
SAME_WORLD = ("routes", "seed", "conditions", "vehicles", "people", "scenarios")
"""Settings of a suite in which two drives must agree to have met the same traffic."""
Key = tuple[str, int, int]
"""Name of the route (`_route_name`), place of the folder among those of its agent, repetition."""


@dataclass(frozen=True)
class ComparedAgent:
    """An agent and its drives."""

    name: str
    folders: tuple[Path, ...]
    suites: tuple[Mapping[str, object], ...]
    """The description of each folder."""
    drives: Mapping[Key, DriveRecord]

    @property
    def failed(self) -> int:
        """Return the number of drives in which the agent raised an error or gave no plan.

        What failed says nothing about driving, so it is left out of all figures.
        """
        return sum(drive.score.failed for drive in self.drives.values())

    def driven(self) -> set[Key]:
        """Return the drives that did not fail."""
        return {key for key, drive in self.drives.items() if not drive.score.failed}

    def values(self, metric: str, keys: Sequence[Key]) -> list[float]:
        """Return the values of a metric for some drives."""
        return [values_of(self.drives[key])[metric] for key in keys]


@dataclass(frozen=True)
class RouteRow:
    """One route: the mean driving score of each agent, and what happened."""

    route: str
    scores: tuple[float, ...]
    happened: tuple[str, ...]
    """Infractions and endings of each agent, in words."""

    @property
    def spread(self) -> float:
        """Return the difference of the best and the worst score."""
        return max(self.scores) - min(self.scores)


@dataclass(frozen=True)
class Comparison:
    """Agents over the drives that all of them have."""

    agents: tuple[ComparedAgent, ...]
    keys: tuple[Key, ...]
    """The drives that are compared."""
    left_out: int
    """Drives that not all agents have."""
    differences: Mapping[str, Mapping[str, BootstrapMean]]
    """By metric and by agent but the first: the value minus that of the first agent."""
    routes: tuple[RouteRow, ...]
    """Those that separate the agents most come first."""
    unlike: tuple[str, ...]
    """Settings in which the folders differ, so that drives of a pair did not meet the same traffic."""
    ratings: Ratings
    """Abilities of the agents and difficulties of the routes, from all drives that did not fail."""
    rated_routes: tuple[str, ...]
    """The routes of the difficulties."""

    @property
    def differences_over(self) -> str:
        """Return in words what the intervals of differences are over."""
        return _over(self.keys)

    @property
    def ratings_over(self) -> str:
        """Return in words what the intervals of abilities and ranks are over."""
        return _over(key for agent in self.agents for key in agent.driven())


def _over(keys: Iterable[Key]) -> str:
    """Return "routes", and "trainings" where drives are of several folders of an agent."""
    return "routes and trainings" if len({place for _, place, _ in keys}) > 1 else "routes"


def values_of(drive: DriveRecord) -> dict[str, float]:
    """Return the values of a drive that are compared, see `METRICS`."""
    kinds = [infraction.kind for infraction in drive.score.infractions]
    return {
        "driving_score_1_0": drive.driving_score_1_0,
        "driving_score_2_1": drive.driving_score_2_1,
        "completion": 100.0 * drive.score.completion,
        "red_lights": float(kinds.count(InfractionKind.RED_LIGHT)),
        "collisions": float(sum(kind in COLLISIONS for kind in kinds)),
        "stop_signs": float(kinds.count(InfractionKind.STOP_SIGN)),
        "speed_mps": drive.score.driven_m / max(drive.score.duration_s, 1e-9),
    }


def read_agents(given: Sequence[str]) -> list[ComparedAgent]:
    """Read the drives of agents, each as `read_agent` does.

    An agent without a name is called by its folder, with as many folders above it as tell it from the others:
    a and b of runs/a/short and runs/b/short.

    Raises:
        InputError: as `read_agent`.
    """
    agents = [read_agent(one) for one in given]
    unnamed = [number for number, one in enumerate(given) if "=" not in one]
    paths = [Path(os.path.abspath(agents[number].folders[0])).parts for number in unnamed]
    while len(paths) > 1 and len({path[-1:] for path in paths}) == 1 and min(map(len, paths)) > 1:
        paths = [path[:-1] for path in paths]  # the end that all share names none
    for number, path in zip(unnamed, paths, strict=True):
        count = next(
            (n for n in range(1, len(path)) if [other[-n:] for other in paths].count(path[-n:]) == 1), 1
        )
        agents[number] = dataclasses.replace(agents[number], name="/".join(path[-count:]))
    return agents


def read_agent(given: str) -> ComparedAgent:
    """Read the drives of an agent.

    Args:
        given: FOLDER, FOLDER,FOLDER for suites that count as one agent, such as those of several training
            seeds, or NAME=FOLDER,…

    Raises:
        InputError: a folder holds no drives.
    """
    name, equals, rest = given.partition("=")
    folders = tuple(Path(part) for part in (rest if equals else given).split(","))
    drives: dict[Key, DriveRecord] = {}
    suites = list[Mapping[str, object]]()
    for place, folder in enumerate(folders):
        files = sorted((folder / DRIVES).glob("*.json"))
        if not files:
            raise InputError(f"{folder}: no drives to compare (no {DRIVES}/*.json)")
        suites.append(read_suite(folder))
        for file in files:
            drive = read_drive(file)
            drives[_route_name(suites[-1], drive), place, drive.score.repetition] = drive
    return ComparedAgent(name if equals else folders[0].absolute().name, folders, tuple(suites), drives)


def _route_name(suite: Mapping[str, object], drive: DriveRecord) -> str:
    """Return the id of a drive's route; in towns with the town and the set, since sets share their ids."""
    if drive.town is None:
        return drive.score.route
    of = str(suite.get("routes"))
    if digest := suite.get(ROUTES_SHA256):  # a file may lie in several places
        of = f"{Path(of).name} {str(digest)[:8]}"
    return f"{drive.score.route} ({drive.town}, {OF if of == SHORT_10 else of})"


def _without_set(agents: Sequence[ComparedAgent]) -> list[ComparedAgent]:
    """Return the agents with bare ids of routes, unless there are several towns or sets."""
    if len({route.partition(" ")[2] for agent in agents for route, *_ in agent.drives}) > 1:
        return list(agents)
    return [
        dataclasses.replace(
            agent,
            drives={(key[0].partition(" ")[0], *key[1:]): drive for key, drive in agent.drives.items()},
        )
        for agent in agents
    ]


def compare(agents: Sequence[ComparedAgent], seed: int = 0, resamples: int = 10_000) -> Comparison:
    """Compare agents with the first one, on the drives that all have.

    Intervals are those of a bootstrap over routes: repetitions of one route resemble each other. Where an
    agent has several folders, as of training seeds, what these differ by is part of the interval. There are
    none of fewer than `LEAST_ROUTES` routes.

    Args:
        agents: at least two, of different names.
        seed: seed of the bootstrap.
        resamples: number of resampled sets of routes.

    Raises:
        InputError: there are fewer than two agents, two have one name, or no drive is common to all.
    """
    if len(agents) < 2:
        raise InputError("a comparison needs at least two folders of drives")
    names = [agent.name for agent in agents]
    if len(set(names)) < len(names):
        raise InputError(f"two agents have the same name ({', '.join(names)}): write NAME=FOLDER")
    agents = _without_set(agents)
    common = set.intersection(*(agent.driven() for agent in agents))
    if not common:
        failed = ", ".join(f"{agent.name} {agent.failed}" for agent in agents if agent.failed)
        reason = f" (failed drives: {failed})" if failed else ""
        raise InputError(f"the folders have no route and repetition in common{reason}: nothing to compare")
    keys = tuple(sorted(common, key=_order))
    differences = {
        metric: {
            agent.name: _difference(agent, agents[0], metric, keys, np.random.default_rng(seed), resamples)
            for agent in agents[1:]
        }
        for metric in METRICS
    }
    everything = set.union(*(set(agent.drives) for agent in agents))
    return Comparison(
        tuple(agents),
        keys,
        len(everything) - len(keys),
        differences,
        _rows(agents, keys),
        _unlike(agents),
        *_rated(agents, seed),
    )


def _difference(
    agent: ComparedAgent,
    first: ComparedAgent,
    metric: str,
    keys: Sequence[Key],
    rng: np.random.Generator,
    resamples: int,
) -> BootstrapMean:
    """Return the mean difference of a metric between two agents with its interval."""
    from scipy.stats import t as student  # takes 0.5 s

    values = [np.array(one.values(metric, keys)) for one in (agent, first)]
    routes, places = [route for route, *_ in keys], [place for _, place, _ in keys]
    mean = bootstrap_mean(
        values[0] - values[1], routes, rng, resamples=resamples, least=LEAST_ROUTES
    )  # of one training each
    if len(set(places)) == 1:
        return mean
    # The variance over routes, and for each agent that of the mean of its trainings. A bootstrap of two or
    # three trainings would be too narrow, so their degrees of freedom count (Satterthwaite 1946)
    of_routes = _means(values[0] - values[1], routes)
    parts = [(float(np.var(of_routes, ddof=1)) / len(of_routes), len(of_routes) - 1)]
    for of_agent in values:
        of_places = _means(of_agent, places)
        parts.append((float(np.var(of_places, ddof=1)) / len(of_places), len(of_places) - 1))
    variance = sum(part for part, _ in parts)
    if variance == 0.0 or np.isnan(mean.low):
        return mean
    freedom = variance**2 / sum(part**2 / count for part, count in parts)
    reach = float(student.ppf(0.975, freedom)) * variance**0.5
    p_value = float(2 * student.sf(abs(mean.mean) / variance**0.5, freedom))
    return BootstrapMean(mean.mean, mean.mean - reach, mean.mean + reach, p_value)


def _means(values: Float64[np.ndarray, "n"], groups: Sequence[str | int]) -> Float64[np.ndarray, "G"]:
    """Return the mean of each group."""
    _, which = np.unique(np.asarray(groups), return_inverse=True)
    return np.asarray(np.bincount(which, values) / np.bincount(which))


def _rated(agents: Sequence[ComparedAgent], seed: int) -> tuple[Ratings, tuple[str, ...]]:
    """Rate agents and routes by the driving score of leaderboard 1.0 in all drives that did not fail."""
    rows = [
        (number, key) for number, agent in enumerate(agents) for key in sorted(agent.driven(), key=_order)
    ]
    routes = list(dict.fromkeys(route for _, (route, *_) in sorted(rows, key=lambda row: _order(row[1]))))
    ratings = rate(
        np.array([agents[number].drives[key].driving_score_1_0 / 100 for number, key in rows]),
        np.array([number for number, _ in rows]),
        np.array([routes.index(route) for _, (route, *_) in rows]),
        np.random.default_rng(seed),
        np.array([place for _, (_, place, _) in rows]),
    )
    return ratings, tuple(routes)


def figures_of(comparison: Comparison) -> dict[str, float | int | str | None]:
    """Return a comparison as flat dotted keys."""
    first = comparison.agents[0].name
    out: dict[str, float | int | str | None] = {
        "first": first,
        "drives": len(comparison.keys),
        "routes": len(comparison.routes),
        "left_out": comparison.left_out,
        "differences_over": comparison.differences_over,
        "ratings_over": comparison.ratings_over,
        "unlike": ", ".join(comparison.unlike) or None,
    }
    for agent in comparison.agents:
        for metric in METRICS:
            out[f"{agent.name}.{metric}"] = statistics.fmean(agent.values(metric, comparison.keys))
    for number, agent in enumerate(comparison.agents):
        out[f"{agent.name}.failed"] = agent.failed
        for name, estimate in (
            ("ability", comparison.ratings.ability[number]),
            ("rank", comparison.ratings.rank[number]),
        ):
            for part, end in (("value", ""), ("low", ".low"), ("high", ".high")):
                out[f"{agent.name}.{name}{end}"] = _finite(getattr(estimate, part))
    for metric, of_agents in comparison.differences.items():
        for name, metrics in of_agents.items():
            for part, value in dataclasses.asdict(metrics).items():
                out[f"{name}.{metric}.difference.{part}"] = _finite(value)
    return out


def _finite(value: float) -> float | None:
    return None if np.isnan(value) else value


def _rows(agents: Sequence[ComparedAgent], keys: Sequence[Key]) -> tuple[RouteRow, ...]:
    rows = []
    for route in dict.fromkeys(route for route, *_ in keys):
        mine = [key for key in keys if key[0] == route]
        scores = tuple(statistics.fmean(agent.values("driving_score_1_0", mine)) for agent in agents)
        rows.append(RouteRow(route, scores, tuple(_happened(agent, mine) for agent in agents)))
    return tuple(sorted(rows, key=lambda row: -row.spread))


def _happened(agent: ComparedAgent, keys: Sequence[Key]) -> str:
    """Return infractions and early ends of some drives of one route, with their counts."""
    kinds: list[str] = []
    for key in keys:
        score = agent.drives[key].score
        kinds += [str(infraction.kind) for infraction in score.infractions]
        if score.ending is not Ending.COMPLETED:
            kinds.append(str(score.ending))
    counts = {name: kinds.count(name) for name in dict.fromkeys(kinds)}
    return ", ".join(
        name.replace("_", " ") + (f" ({count})" if count > 1 else "") for name, count in counts.items()
    )


def _unlike(agents: Sequence[ComparedAgent]) -> tuple[str, ...]:
    """Return the settings in which folders at the same place among those of their agents differ."""
    unlike = []
    for setting in SAME_WORLD:
        for of_place in zip(*(agent.suites for agent in agents), strict=False):
            values = {str(suite.get(setting)) for suite in of_place}
            if len(values) > 1:
                unlike.append(f"{setting} ({' or '.join(sorted(values))})")
                break
    return tuple(unlike)


def _order(key: Key) -> tuple[int, str, int, int]:
    """Sort numbered routes by their numbers."""
    route, place, repetition = key
    number = route.partition(" ")[0]
    return (int(number) if number.isdigit() else 0, route, place, repetition)
