"""Options of `foredrive drive`, in groups: planning, routes through towns, a reconstructed log."""

from collections.abc import Collection
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from foredrive.cli.arguments import (
    ImageSize,
    OptionalPath,
    check_file,
    check_image_size,
    check_number,
    check_reconstruction,
    chosen_rig,
)
from foredrive.errors import InputError

if TYPE_CHECKING:
    from foredrive.driving.faults import Faults
    from foredrive.runs.drive.in_carla import CarlaRoutes
    from foredrive.runs.drive.in_reconstruction import ReconstructedRoutes
    from foredrive.runs.drive.in_towns import TownRoutes


@dataclass(frozen=True)
class Planning:
    """Planning of the agent.

    Args:
        sensors: Log cameras and lidar even if the agent does not need them; without them, drives are much
            faster.
        lidar: Log the lidar too, in towns. Without it a demonstration costs less.
        period: Time between two plans, s.
        latency: Time from an observation until the plan made from it takes effect, s.
    """

    sensors: bool = True
    lidar: bool = True
    period: Annotated[float, tyro.conf.arg(metavar="S")] = 0.5
    latency: Annotated[float, tyro.conf.arg(metavar="S")] = 0.1

    def check(self) -> None:
        """Raise `InputError` if a time is impossible."""
        check_number("--period", self.period, above=0)
        check_number("--latency", self.latency, low=0)


@dataclass(frozen=True)
class InputFaults:
    """Faults of the agent's inputs, to measure how much it depends on them.

    Args:
        camera_fault: Cameras that fail, KIND:CAMERA or KIND:CAMERA@SECONDS. lost: no image, and the agent is
            told; black: a black image; frozen: the last image before is repeated;
            halved: every second key frame has the image before it.
        speed_noise: Standard deviation of the speed that the agent is told, m/s.
        position_noise: Standard deviation of the position from which the target point of the route is
            computed, m.
    """

    camera_fault: Annotated[tuple[str, ...], tyro.conf.arg(metavar="KIND:CAMERA[@S] ...")] = ()
    speed_noise: Annotated[float, tyro.conf.arg(metavar="M/S")] = 0.0
    position_noise: Annotated[float, tyro.conf.arg(metavar="M")] = 0.0

    def check(self) -> None:
        """Raise `InputError` if a fault has another form, or a deviation is impossible."""
        from foredrive.driving.faults import read_camera_fault

        for text in self.camera_fault:
            read_camera_fault(text)
        check_number("--speed-noise", self.speed_noise, low=0)
        check_number("--position-noise", self.position_noise, low=0)

    def faults(self, cameras: Collection[str]) -> "Faults":
        """Return the faults.

        Args:
            cameras: names of the vehicle's cameras; none if they are not known.

        Raises:
            InputError: the vehicle has no such camera.
        """
        from foredrive.driving.faults import Faults, read_camera_fault

        camera_faults = tuple(map(read_camera_fault, self.camera_fault))
        faults = Faults(camera_faults, self.speed_noise, self.position_noise)
        if cameras:
            faults.check_cameras(tuple(cameras))
        return faults


@dataclass(frozen=True)
class InTowns:
    """Routes through towns.

    Args:
        carla: Drive on a CARLA server instead of in the embedded towns: one drive at a time, without
            scenarios.
        routes: town05-short, town05-short-10, town05-long, longest6, or a CARLA route file; for DAgger
            demonstrations in the other towns training-short and training-long.
        only: Ids of the routes to drive; by default all of the set.
        repetitions: Number of drives of each route, each with other traffic.
        seed: Seed of the town, the traffic and all noise in the first repetition; each repetition adds one.
        conditions: clear, morning, overcast, dusk, night, rain, night_rain, fog or night_fog; any: drawn for
            each drive; by default a bright day.
        rig: Cameras of the vehicle: surround (six in all directions), driving (the same and a narrow one for
            traffic lights), front_tele (two front cameras), navsim (eight, of nuPlan's size), or a YAML file
            of image_hw and cameras. By
            default that of the agent's training logs.
        other_rig: Drive with a rig that the agent was not trained with.
        raise_cameras: Height by which all cameras are higher than in the rig, m. Needs --other-rig.
        image_size: Size of the images (height, width), px; by default the rig's.
        vehicles: Number of vehicles on the road near the ego vehicle.
        people: Number of pedestrians near the ego vehicle.
        scenarios: Include scenarios like CARLA's: actors brake, cut in, run lights and step out.
        workers: Number of drives at a time; 0: one for each core.
        ray: Drive on Ray: on the cluster at RAY_ADDRESS, or on a cluster that is started here.
    """

    routes: Annotated[str, tyro.conf.arg(metavar="SET|FILE.xml")] = "town05-short"
    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ROUTE [ROUTE ...]")] = ()
    carla: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")] = None
    repetitions: int = 1
    seed: int = 0
    conditions: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    rig: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE.yaml")] = None
    other_rig: bool = False
    raise_cameras: Annotated[float, tyro.conf.arg(metavar="M")] = 0.0
    image_size: ImageSize | None = None
    vehicles: int = 30
    people: int = 20
    scenarios: bool = True
    workers: int = 0
    ray: bool = False

    def check(self) -> None:
        """Raise `InputError` if a number is impossible."""
        check_number("--repetitions", self.repetitions, low=1)
        check_number("--seed", self.seed, low=0)
        check_number("--raise-cameras", self.raise_cameras)
        if self.raise_cameras and not self.other_rig:
            raise InputError("--raise-cameras makes a rig that the agent does not know: add --other-rig")
        check_image_size(self.image_size)
        check_number("--vehicles", self.vehicles, low=0)
        check_number("--people", self.people, low=0)
        check_number("--workers", self.workers, low=0)

    def check_unchanged(self, usual: "InTowns", instead: str) -> None:
        """Raise `InputError` if an option of routes was given to a command that drives no routes.

        Args:
            usual: the options of a command without any.
            instead: the option that takes the place of routes.
        """
        names = [option.name for option in fields(self) if option.name not in ("workers", "ray")]
        given = [name for name in names if getattr(self, name) != getattr(usual, name)]
        if given:
            flags = ", ".join(
                f"--{'no-' if getattr(usual, name) is True else ''}{name.replace('_', '-')}" for name in given
            )
            raise InputError(f"{flags}: for routes through towns; with {instead} there are none")

    def source(self, agent: str) -> "TownRoutes | CarlaRoutes":
        """Return the source of the drives of an agent."""
        from foredrive.runs.drive.agent_inputs import rig_of

        rig = rig_of(agent) if self.rig is None else chosen_rig(self.rig, None)
        rig = rig.raised(self.raise_cameras) if self.raise_cameras else rig
        options: dict[str, Any] = {
            "routes": self.routes,
            "repetitions": self.repetitions,
            "seed": self.seed,
            "conditions": self.conditions,
            "rig": rig if self.image_size is None else rig.of_size(self.image_size),
            "other_rig": self.other_rig,
            "vehicles": self.vehicles,
            "people": self.people,
            "only": self.only,
        }
        if self.carla is not None:
            from foredrive.runs.drive.in_carla import CarlaRoutes

            return CarlaRoutes(**options, server=self.carla)
        from foredrive.runs.drive.in_towns import TownRoutes

        return TownRoutes(**options, scenarios=self.scenarios)


@dataclass(frozen=True)
class InReconstruction:
    """A reconstructed log; it replaces the options for towns.

    Args:
        reconstructed: Folder of a reconstruction to drive in. Its actors replay the log. The agent "log"
            replays the logged ego drive.
        start: Times of the log at which drives begin, s; by default as early as possible.
        threat: Put a car in the way: it stands, comes head-on or crosses.
        edits: File of edits to the reconstructed scene.
        stay_trusted: End a drive where the reconstruction no longer expects good images.
    """

    reconstructed: Annotated[OptionalPath, tyro.conf.arg(name="in", metavar="RUN")] = None
    start: Annotated[tuple[float, ...], tyro.conf.arg(metavar="S [S ...]")] = ()
    threat: tuple[Literal["stationary", "frontal", "side"], ...] = ()
    edits: OptionalPath = None
    stay_trusted: bool = False

    def check(self) -> None:
        """Raise `InputError` if a file does not exist or a time is impossible."""
        if self.reconstructed is not None:
            check_reconstruction(self.reconstructed)
        for start in self.start:
            check_number("--start", start)
        check_file(self.edits)

    def source(self) -> "ReconstructedRoutes | None":
        """Return the source of drives in a reconstructed log; None without --in.

        Raises:
            InputError: options for reconstructed logs are given without --in.
        """
        if self.reconstructed is None:
            if self.start or self.threat or self.edits is not None or self.stay_trusted:
                raise InputError(
                    "--start, --threat, --edits and --stay-trusted need a reconstructed log (--in RUN)"
                )
            return None
        from foredrive.driving.replay.threats import Threat
        from foredrive.runs.drive.in_reconstruction import ReconstructedRoutes

        return ReconstructedRoutes(
            run=str(Path(self.reconstructed).absolute()),
            starts_s=self.start,
            threats=tuple(map(Threat, self.threat)),
            edits=None if self.edits is None else str(self.edits.absolute()),
            stay_trusted=self.stay_trusted,
        )
