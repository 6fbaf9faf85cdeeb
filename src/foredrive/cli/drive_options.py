"""What `foredrive drive` drives on, in groups of options: routes through towns, or a rebuilt log."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from foredrive.cli.arguments import (
    ImageSize,
    OptionalPath,
    check_file,
    check_image_size,
    check_number,
    check_rebuilt,
)
from foredrive.errors import InputError

if TYPE_CHECKING:
    from foredrive.runs.drive.in_carla import CarlaRoutes
    from foredrive.runs.drive.in_rebuilt import RebuiltRoutes
    from foredrive.runs.drive.in_towns import TownRoutes


@dataclass(frozen=True)
class Planning:
    """How the agent plans.

    Args:
        sensors: Log cameras and lidar of agents that need none, too; without, drives are much faster.
        period: Time between plans.
        latency: How much later than what it saw a plan takes effect.
    """

    sensors: bool = True
    period: Annotated[float, tyro.conf.arg(metavar="S")] = 0.5
    latency: Annotated[float, tyro.conf.arg(metavar="S")] = 0.1

    def check(self) -> None:
        """Raises `InputError` for times that there cannot be."""
        check_number("--period", self.period, above=0)
        check_number("--latency", self.latency, low=0)


@dataclass(frozen=True)
class InTowns:
    """Routes through towns.

    Args:
        carla: Drive on a CARLA server instead of the embedded towns, one drive at a time, without scenarios.
        routes: town05-short, town05-short-10, town05-long, longest6, or a CARLA route file; for lessons in
            the other towns training-short and training-long.
        repetitions: How often each route is driven, every time among other traffic.
        seed: Decides the place, the traffic and all noise of the first repetition; the next has the next.
        conditions: clear, morning, overcast, dusk, night, rain, night_rain, fog or night_fog;
            any: drawn for each drive; a bright day if left out.
        image_size: Size of the six cameras' images, px.
        vehicles: How many vehicles share the road near the ego vehicle.
        people: How many pedestrians do.
        scenarios: Let others brake, cut in, run lights and step out on the way, in CARLA's manner.
        workers: How many drives run at a time; 0 is one for each core.
        ray: Drive on Ray: on the cluster at RAY_ADDRESS, or on one started here.
    """

    routes: Annotated[str, tyro.conf.arg(metavar="SET|FILE.xml")] = "town05-short"
    carla: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")] = None
    repetitions: int = 1
    seed: int = 0
    conditions: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    image_size: ImageSize = (144, 256)
    vehicles: int = 30
    people: int = 20
    scenarios: bool = True
    workers: int = 0
    ray: bool = False

    def check(self) -> None:
        """Raises `InputError` for numbers that there cannot be."""
        check_number("--repetitions", self.repetitions, low=1)
        check_number("--seed", self.seed, low=0)
        check_image_size(self.image_size)
        check_number("--vehicles", self.vehicles, low=0)
        check_number("--people", self.people, low=0)
        check_number("--workers", self.workers, low=0)

    def source(self) -> "TownRoutes | CarlaRoutes":
        """What is to be driven."""
        from foredrive.runs.drive.in_towns import TownRoutes

        routes = TownRoutes(
            routes=self.routes,
            repetitions=self.repetitions,
            seed=self.seed,
            conditions=self.conditions,
            image_hw=self.image_size,
            vehicles=self.vehicles,
            people=self.people,
            scenarios=self.scenarios and self.carla is None,
        )
        if self.carla is None:
            return routes
        from foredrive.runs.drive.in_carla import CarlaRoutes

        return CarlaRoutes(self.carla, routes)


@dataclass(frozen=True)
class InRebuilt:
    """A log that was rebuilt; then the options for towns do not count.

    Args:
        rebuilt: Folder of a reconstruction to drive in. Its actors replay; agent "log" goes on as the log was
            driven.
        start: Times of the log at which drives begin; as early as possible if left out.
        threat: Put a car in the way: one that stands, comes head-on or crosses.
        edits: File of edits to the rebuilt scene.
    """

    rebuilt: Annotated[OptionalPath, tyro.conf.arg(name="in", metavar="RUN")] = None
    start: Annotated[tuple[float, ...], tyro.conf.arg(metavar="S [S ...]")] = ()
    threat: tuple[Literal["stationary", "frontal", "side"], ...] = ()
    edits: OptionalPath = None

    def check(self) -> None:
        """Raises `InputError` for files that are not there, and times that there cannot be."""
        if self.rebuilt is not None:
            check_rebuilt(self.rebuilt)
        for start in self.start:
            check_number("--start", start)
        check_file(self.edits)

    def source(self) -> "RebuiltRoutes | None":
        """What is to be driven, if it is in a rebuilt log.

        Raises:
            InputError: what is for rebuilt logs is asked for without one.
        """
        if self.rebuilt is None:
            if self.start or self.threat or self.edits is not None:
                raise InputError("--start, --threat and --edits are for drives in rebuilt logs (--in RUN)")
            return None
        from foredrive.runs.drive.in_rebuilt import RebuiltRoutes
        from foredrive.simulation.threats import Threat

        return RebuiltRoutes(
            run=str(Path(self.rebuilt).absolute()),
            starts_s=self.start,
            threats=tuple(map(Threat, self.threat)),
            edits=None if self.edits is None else str(self.edits.absolute()),
        )
