"""Drives over routes in the embedded towns."""

import contextlib
import dataclasses
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from foredrive.errors import InputError
from foredrive.runs.drive.agents import make_driver, needs_of
from foredrive.runs.drive.suite import DriveJob, DriveSuite, Stage
from foredrive.scene import Trajectory
from foredrive.simulation.drive_log import drive_log, key_frame
from foredrive.simulation.lessons import Alternating, Disturbed
from foredrive.simulation.route_sets import load_route_set
from foredrive.simulation.routes import DriveRoute, snap_route
from foredrive.simulation.scenarios.places import scenarios_on
from foredrive.simulation.scores import timeout_s
from foredrive.simulation.town import TownScenario, TownSimulator, grow
from foredrive.towns.campaign import ANY_CONDITIONS
from foredrive.towns.conditions import CONDITIONS, find_conditions
from foredrive.towns.recorder import Crowd
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.sensing.rig import camera_rig, roof_lidar


@dataclass(frozen=True)
class TownRoutes:
    """A `Source` of routes through towns, with the conditions and the traffic of the drives."""

    routes: str
    """Name of a route set of the package, or path of a CARLA route file."""
    repetitions: int = 1
    seed: int = 0
    """Seed of the town and its traffic in the first repetition; each repetition adds one."""
    conditions: str | None = None
    """Name of the conditions. `ANY_CONDITIONS` draws a name for each drive; None draws bright daylight from
    the seed.
    """
    image_hw: tuple[int, int] = (144, 256)
    vehicles: int = Crowd.vehicles
    people: int = Crowd.people
    scenarios: bool = True
    """Whether scenarios are on the route, chosen by the seed: actors brake, cut in, run lights and step out.
    """

    in_turn = False
    grows = ("repetitions",)

    def __post_init__(self) -> None:
        if self.repetitions < 1:
            raise InputError(f"routes are driven once or more, got {self.repetitions} repetitions")
        if self.conditions not in (None, ANY_CONDITIONS, *CONDITIONS):
            there_are = ", ".join((ANY_CONDITIONS, *CONDITIONS))
            raise InputError(f"no conditions are named {self.conditions}; there are {there_are}")

    def noted(self) -> Mapping[str, object]:
        """Return the fields."""
        return dataclasses.asdict(self)

    def jobs(self, driver: str) -> Sequence[DriveJob]:
        """Return one drive for each route and repetition."""
        needs_of(driver)
        routes = load_route_set(self.routes)
        return [job_of(route.id, n) for n in range(self.repetitions) for route in routes]

    @contextlib.contextmanager
    def stage(self, job: DriveJob, suite: DriveSuite, out: Path) -> Iterator[Stage]:
        """Set up a drive in its town."""
        route = self.route_of(job)
        simulator, scenario = TownSimulator(), self.scenario_of(route, job.repetition, suite)
        lot = _lot(scenario.seed, job.route)
        agent = make_driver(suite.driver, lambda: simulator.state.t_s, simulator, lot)

        def taught() -> Trajectory | None:
            return agent.teacher.plan() if isinstance(agent, Disturbed | Alternating) else None

        with drive_log(scenario, out, job.name) as log:
            yield Stage(
                simulator,
                scenario,
                agent,
                route.xyz,
                route.length_m,
                log,
                lambda: key_frame(simulator, taught()),
                route.town,
            )

    def route_of(self, job: DriveJob) -> DriveRoute:
        """Return the route of a drive, snapped to the lanes."""
        return snap_route(next(route for route in load_route_set(self.routes) if route.id == job.route))

    def scenario_of(self, route: DriveRoute, repetition: int, suite: DriveSuite) -> TownScenario:
        """Return the scenario of one drive: its seed, traffic, conditions and sensors."""
        needs = needs_of(suite.driver)
        seen = needs.lidar or suite.sensors
        seed = self.seed + repetition
        name = self.conditions
        if name == ANY_CONDITIONS:
            name = list(CONDITIONS)[_lot(seed, route.id) % len(CONDITIONS)]
        happens = scenarios_on(route, grow(route.town, seed), seed) if self.scenarios else ()
        return TownScenario(
            town=route.town,
            route_xyz=route.xyz,
            seed=seed,
            lanes=route.lanes,
            crowd=Crowd(self.vehicles, self.people),
            conditions=None if name is None else find_conditions(name),
            sensors=SensorSuite(camera_rig(self.image_hw), roof_lidar()) if seen else None,
            past_frames=needs.past_frames,
            limit_s=timeout_s(route.length_m),
            scenarios=happens,
        )


def job_of(route: str, repetition: int) -> DriveJob:
    """Return the job of driving a route in one repetition."""
    return DriveJob(f"route{route}_rep{repetition}", route, repetition)


def _lot(seed: int, route: str) -> int:
    """Return a pseudo-random number for a drive; the same arguments give the same number."""
    return zlib.crc32(f"{seed} {route}".encode())
