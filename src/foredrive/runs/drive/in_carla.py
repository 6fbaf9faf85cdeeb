"""Drives over routes in the towns of a CARLA server."""

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from foredrive.errors import InputError
from foredrive.runs.drive.agents import make_driver
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.suite import DriveJob, DriveSuite, Stage
from foredrive.simulation.carla.client import connect
from foredrive.simulation.carla.simulator import CarlaSimulator
from foredrive.simulation.drive_log import carla_key_frame, drive_log

PORT = 2000


@dataclass(frozen=True)
class CarlaRoutes:
    """A `Source` of routes that are driven on a CARLA server, without scenarios."""

    server: str
    """Address: HOST or HOST:PORT."""
    towns: TownRoutes
    in_turn = True

    def __post_init__(self) -> None:
        if self.towns.scenarios:
            raise InputError("CARLA plays no scenarios of ours: leave them out (--no-scenarios)")
        self.address()

    @property
    def grows(self) -> tuple[str, ...]:
        """Return the fields that towns allow to grow, and the server, whose address may change later."""
        return (*self.towns.grows, "carla")

    def address(self) -> tuple[str, int]:
        """Return host and port of the server."""
        host, _, port = self.server.partition(":")
        if not host or not (port or str(PORT)).isdecimal():
            raise InputError(f"a CARLA server is named HOST:PORT, got {self.server!r}")
        return host, int(port or PORT)

    def noted(self) -> Mapping[str, object]:
        """Return the fields of the routes and the server."""
        return {**dataclasses.asdict(self.towns), "carla": self.server}

    def jobs(self, driver: str) -> Sequence[DriveJob]:
        """Return one drive for each route and repetition."""
        return self.towns.jobs(driver)

    @contextlib.contextmanager
    def stage(self, job: DriveJob, suite: DriveSuite, out: Path) -> Iterator[Stage]:
        """Set up a drive on the server; restore the server's state afterwards."""
        route = self.towns.route_of(job)
        scenario = self.towns.scenario_of(route, job.repetition, suite)
        with CarlaSimulator(connect(*self.address())) as simulator:
            agent = make_driver(suite.driver, lambda: simulator.state.t_s)
            with drive_log(scenario, out, job.name) as log:
                yield Stage(
                    simulator,
                    scenario,
                    agent,
                    route.xyz,
                    route.length_m,
                    log,
                    lambda: carla_key_frame(simulator, scenario),
                    route.town,
                )
