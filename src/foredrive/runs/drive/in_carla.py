"""Drives over routes in the towns of a CARLA server."""

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from foredrive.driving.route_scenario import RouteScenario
from foredrive.driving.scores import timeout_s
from foredrive.errors import InputError
from foredrive.integrations.carla.client import connect
from foredrive.integrations.carla.simulator import CarlaSimulator
from foredrive.runs.drive.agent_inputs import inputs_of
from foredrive.runs.drive.agents import make_agent
from foredrive.runs.drive.drive_setup import DriveSetup
from foredrive.runs.drive.route_source import RouteSource
from foredrive.runs.drive.suite import DriveJob, DriveSuite
from foredrive.scene.conditions import BackgroundTraffic
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import VehicleSensors, roof_lidar
from foredrive.towns.driving.drive_log import drive_log, log_frame

PORT = 2000


@dataclass(frozen=True)
class CarlaRoutes(RouteSource):
    """A `DriveSource` of routes that are driven on a CARLA server, without scenarios."""

    server: str = dataclasses.field(kw_only=True)
    """Address: HOST or HOST:PORT."""

    in_turn = True
    grows = ("repetitions", "carla")
    """The server's address may change later."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.address()

    def address(self) -> tuple[str, int]:
        """Return host and port of the server."""
        host, _, port = self.server.partition(":")
        if not host or not (port or str(PORT)).isdecimal():
            raise InputError(f"a CARLA server is named HOST:PORT, got {self.server!r}")
        return host, int(port or PORT)

    def noted(self) -> Mapping[str, object]:
        """Return the fields of the routes and the server."""
        fields = dict(super().noted())
        return {**fields, "scenarios": False, "carla": fields.pop("server")}

    @contextlib.contextmanager
    def set_up(self, job: DriveJob, suite: DriveSuite, out: Path) -> Iterator[DriveSetup]:
        """Set up a drive on the server; restore the server's state afterwards."""
        route, inputs = self.route_of(job), inputs_of(suite.agent)
        seed = self.seed + job.repetition
        sensed = inputs.cameras or inputs.lidar or suite.sensors
        rig = camera_rig(plan=self.rig) if sensed else None
        scenario = RouteScenario(
            town=route.town,
            route_xyz=route.xyz,
            seed=seed,
            background_traffic=BackgroundTraffic(self.vehicles, self.people),
            conditions=self.conditions_of(route.id, seed),
            sensors=None if rig is None else VehicleSensors(rig, roof_lidar()),
            past_frames=inputs.past_frames,
            limit_s=timeout_s(route.length_m),
        )
        with CarlaSimulator(connect(*self.address())) as simulator:
            agent = make_agent(suite.agent, lambda: simulator.state.t_s)
            with drive_log(out, job.name, route.xyz, rig, route.town) as log:
                yield DriveSetup(
                    simulator,
                    scenario,
                    agent,
                    route.xyz,
                    route.length_m,
                    log,
                    lambda: log_frame(simulator.state.frames[-1], simulator.state.ego, rig),
                    route.town,
                )
