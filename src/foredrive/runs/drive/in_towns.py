"""Drives over routes in the embedded towns."""

import contextlib
import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from foredrive.driving.scores import timeout_s
from foredrive.runs.drive.agent_inputs import inputs_of
from foredrive.runs.drive.agents import make_agent
from foredrive.runs.drive.drive_setup import DriveSetup
from foredrive.runs.drive.route_source import RouteSource, drive_hash
from foredrive.runs.drive.suite import DriveJob, DriveSuite
from foredrive.scene import Trajectory
from foredrive.scene.conditions import BackgroundTraffic
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import roof_lidar
from foredrive.towns.driving.demonstrations import AlternatingStudent, DisturbedExpert
from foredrive.towns.driving.drive_log import drive_log, town_log_frame
from foredrive.towns.driving.routes import DriveRoute
from foredrive.towns.driving.town import TownScenario, TownSimulator, grow
from foredrive.towns.scenarios.places import scenarios_on
from foredrive.towns.sensing.capture import SensorSuite


@dataclass(frozen=True)
class TownRoutes(RouteSource):
    """A `DriveSource` of routes that are driven in the embedded towns."""

    scenarios: bool = True
    """Whether scenarios are on the route, chosen by the seed: actors brake, cut in, run lights and step out.
    """

    in_turn = False
    grows = ("repetitions",)

    @contextlib.contextmanager
    def set_up(self, job: DriveJob, suite: DriveSuite, out: Path) -> Iterator[DriveSetup]:
        """Set up a drive in its town."""
        route = self.route_of(job)
        simulator, scenario = TownSimulator(), self.scenario_of(route, job.repetition, suite)
        disturbance_seed = drive_hash(scenario.seed, job.route)
        agent = make_agent(suite.agent, lambda: simulator.state.t_s, simulator, disturbance_seed)

        def expert_plan() -> Trajectory | None:
            if isinstance(agent, DisturbedExpert | AlternatingStudent):
                return agent.expert.plan()
            return None

        rig = None if scenario.sensors is None else scenario.sensors.rig
        with drive_log(out, job.name, route.xyz, rig, route.town) as log:
            yield DriveSetup(
                simulator,
                scenario,
                agent,
                route.xyz,
                route.length_m,
                log,
                lambda: town_log_frame(simulator, expert_plan()),
                route.town,
            )

    def anew(self, routes: Sequence[str], count: int, seed: int) -> "TownRoutes":
        """Return some of the routes, each `count` times, with other traffic."""
        return dataclasses.replace(self, only=tuple(routes), repetitions=count, seed=self.seed + seed)

    def scenario_of(self, route: DriveRoute, repetition: int, suite: DriveSuite) -> TownScenario:
        """Return the set-up of one drive."""
        inputs, seed = inputs_of(suite.agent), self.seed + repetition
        sensed = inputs.cameras or inputs.lidar or suite.sensors
        lidar = roof_lidar() if inputs.lidar or (suite.sensors and suite.lidar) else None
        return TownScenario(
            town=route.town,
            route_xyz=route.xyz,
            seed=seed,
            background_traffic=BackgroundTraffic(self.vehicles, self.people),
            conditions=self.conditions_of(route.id, seed),
            sensors=SensorSuite(camera_rig(plan=self.rig), lidar) if sensed else None,
            past_frames=inputs.past_frames,
            limit_s=timeout_s(route.length_m),
            lanes=route.lanes,
            scenarios=scenarios_on(route, grow(route.town, seed), seed) if self.scenarios else (),
        )
