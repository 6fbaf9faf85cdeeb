"""Drives over routes through towns: what every simulator with towns has in common."""

import dataclasses
import functools
import logging
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from foredrive.driving.route_sets import ROUTE_FILE, RouteWaypoints, load_route_set
from foredrive.errors import InputError
from foredrive.files import digest_of
from foredrive.runs.drive.agent_inputs import check_rig_of, inputs_of
from foredrive.runs.drive.agents import check_without_log
from foredrive.runs.drive.suite import ROUTES_SHA256, DriveJob
from foredrive.scene.conditions import (
    ANY_CONDITIONS,
    CONDITIONS,
    DRAWN,
    BackgroundTraffic,
    Conditions,
    find_conditions,
)
from foredrive.sensors.rigs import SURROUND, RigPlan
from foredrive.towns.driving.routes import DriveRoute, snap_route
from foredrive.towns.map.names import LARGE_TOWNS, TOWNS, town_of

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RouteSource:
    """Routes through towns, with the conditions and the traffic of their drives."""

    routes: str
    """Name of a route set of the package, or path of a CARLA route file."""
    repetitions: int = 1
    seed: int = 0
    """Seed of the town and its traffic in the first repetition; each repetition adds one."""
    conditions: str | None = None
    """Name of the conditions. `ANY_CONDITIONS` draws a name for each drive; None takes the weather of the
    route's file, or draws bright daylight from the seed.
    """
    rig: RigPlan = SURROUND
    """Cameras of the vehicle."""
    other_rig: bool = False
    """Whether a run may drive with a rig that it was not trained with."""
    vehicles: int = BackgroundTraffic.vehicles
    people: int = BackgroundTraffic.pedestrians
    only: tuple[str, ...] = ()
    """Ids of the routes to drive; empty: all."""

    def __post_init__(self) -> None:
        if self.repetitions < 1:
            raise InputError(f"the number of repetitions must be at least 1, got {self.repetitions}")
        if self.conditions not in (None, ANY_CONDITIONS, *CONDITIONS):
            there_are = ", ".join((ANY_CONDITIONS, *CONDITIONS))
            raise InputError(f"unknown conditions {self.conditions}; the conditions are {there_are}")

    def noted(self) -> Mapping[str, object]:
        """Return the fields. Those of the cameras are left out for the usual rig, `only` if it is empty."""
        fields = dataclasses.asdict(self)
        rig = fields.pop("rig")
        if not self.only:
            del fields["only"]
        if not self.other_rig:
            del fields["other_rig"]
        other = {} if self.rig.cameras == SURROUND.cameras else {"cameras": rig["cameras"]}
        if self.routes.endswith(ROUTE_FILE):
            load_route_set(self.routes)  # a file that cannot be read is one line
            other[ROUTES_SHA256] = digest_of([Path(self.routes)])
        return {**fields, "image_hw": self.rig.image_hw, **other}

    def jobs(self, agent: str) -> Sequence[DriveJob]:
        """Return one drive for each route and repetition.

        Raises:
            InputError: there is no such route, a route is in a town that is not here, or the agent has
                another rig.
        """
        check_without_log(agent)
        inputs_of(agent)
        if not self.other_rig:
            check_rig_of(agent, self.rig)
        routes = {route.id: route for route in load_route_set(self.routes)}
        for name in self.only:
            if name not in routes:
                raise InputError(f"{self.routes} has no route {name}; it has {', '.join(routes)}")
        chosen = [routes[name] for name in self.only or routes]
        _check_towns(self.routes, chosen)
        _tell_scenarios(self.routes, tuple(kind for route in chosen for kind in route.scenarios))
        if self.conditions is None:
            _tell_weather(self.routes, sum(len(set(route.weathers)) > 1 for route in chosen))
        return [job_of(route.id, n) for n in range(self.repetitions) for route in chosen]

    def route_of(self, job: DriveJob) -> DriveRoute:
        """Return the route of a drive, snapped to the lanes."""
        return snap_route(next(route for route in load_route_set(self.routes) if route.id == job.route))

    def conditions_of(self, route: str, seed: int) -> Conditions | None:
        """Return the conditions of the drive of a route with a seed."""
        if self.conditions is None:
            of_file = (one.weathers for one in load_route_set(self.routes) if one.id == route)
            return next(iter(next(of_file, ())), None)
        if self.conditions != ANY_CONDITIONS:
            return find_conditions(self.conditions)
        return CONDITIONS[DRAWN[drive_hash(seed, route) % len(DRAWN)]]


def _check_towns(name: str, routes: Sequence[RouteWaypoints]) -> None:
    towns = (*TOWNS, *LARGE_TOWNS)
    elsewhere = Counter(route.town for route in routes if town_of(route.town) not in towns)
    if elsewhere:
        counted = ", ".join(f"{town} ({count} of {len(routes)})" for town, count in sorted(elsewhere.items()))
        raise InputError(
            f"{name}: routes in towns that are not here: {counted}; the towns are {', '.join(towns)}. "
            "--only ROUTE … drives some routes"
        )


@functools.cache
def _tell_scenarios(name: str, types: tuple[str, ...]) -> None:
    """Say once in a process that the scenarios of a route file are not played."""
    if types:
        counted = ", ".join(f"{count} {kind}" for kind, count in sorted(Counter(types).items()))
        text = "%s: scenarios left out: %s; --scenarios has scenarios of its own"
        _log.warning(text, name, counted)


@functools.cache
def _tell_weather(name: str, changing: int) -> None:
    """Say once in a process that the weather of a route stays as it begins."""
    if changing:
        _log.warning("%s: the weather of %d routes changes on the way; it stays as it begins", name, changing)


def job_of(route: str, repetition: int) -> DriveJob:
    """Return the job of driving a route in one repetition."""
    return DriveJob(f"route{route}_rep{repetition}", route, repetition)


def drive_hash(seed: int, route: str) -> int:
    """Return a pseudo-random number for a drive; the same arguments give the same number."""
    return zlib.crc32(f"{seed} {route}".encode())
