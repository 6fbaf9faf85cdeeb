"""Scenarios of safety tests: the actor in the way of the ego vehicle, and what changes from run to run.

After neuro-ncap's scenario files (public repository atonderski/neuro-ncap, `components/scenario.py`), whose
files `scenario_file` reads. Times count from the log's first moment, positions are in the log's world frame.
"""

import math
from dataclasses import dataclass, field
from typing import Literal

from foredrive.driving.observation import FRAME_DT_S
from foredrive.driving.replay.threats import Threat
from foredrive.errors import InputError

Point = tuple[float, float, float]
"""x, y, z, m, world frame."""


def check_finite(what: str, *numbers: float) -> None:
    """Check the numbers of a part of a scenario. Raise `InputError` if one is not finite."""
    if not all(map(math.isfinite, numbers)):
        raise InputError(f"{what} needs finite numbers, got {', '.join(f'{number:g}' for number in numbers)}")


@dataclass(frozen=True)
class Polyline:
    """A way through points, each at its time. It is continued straight before the first and after the last.

    Raises:
        InputError: there are fewer than two points, their number differs from that of the times, times do not
            ascend, or a number is not finite.
    """

    t_s: tuple[float, ...]
    xyz_m: tuple[Point, ...]
    """Middle of the actor's box on the ground."""
    kind: Literal["polyline"] = "polyline"

    def __post_init__(self) -> None:
        if len(self.t_s) < 2 or len(self.t_s) != len(self.xyz_m):
            raise InputError(
                f"a way needs two points or more, each with a time; "
                f"got {len(self.t_s)} times, {len(self.xyz_m)} points"
            )
        if any(not later > before for before, later in zip(self.t_s, self.t_s[1:], strict=False)):
            raise InputError(f"the times of a way must ascend, got {list(self.t_s)}")
        check_finite("a way", *self.t_s, *(number for point in self.xyz_m for number in point))


@dataclass(frozen=True)
class Rectilinear:
    """A straight way at constant speed.

    Raises:
        InputError: a number is not finite.
    """

    at_m: Point
    """Position at `at_s`: middle of the actor's box on the ground."""
    at_s: float
    yaw_rad: float
    """Direction of motion in the world frame, counter-clockwise from x."""
    speed_mps: float = 0.0
    kind: Literal["rectilinear"] = "rectilinear"

    def __post_init__(self) -> None:
        check_finite("a way", *self.at_m, self.at_s, self.yaw_rad, self.speed_mps)

    def polyline(self) -> Polyline:
        """Return the same way through two points, 1 s apart."""
        x_m, y_m, z_m = self.at_m
        step = self.speed_mps * math.cos(self.yaw_rad), self.speed_mps * math.sin(self.yaw_rad)
        # Two points determine a straight way, because ways are extrapolated
        return Polyline((self.at_s, self.at_s + 1.0), (self.at_m, (x_m + step[0], y_m + step[1], z_m)))


@dataclass(frozen=True)
class Jitter:
    """Half ranges of the random changes of an actor's way in each run.

    Draws are uniform between minus and plus the half range, or normal with it as the standard deviation.

    Raises:
        InputError: a number is not finite, or a half range is negative.
    """

    along_rad: float = 0.0
    """Direction in the world frame to which longitudinal and lateral refer."""
    longitudinal_m: float = 0.0
    lateral_m: float = 0.0
    """Positive draws move to the right."""
    yaw_rad: float = 0.0
    """Change of the heading of an actor that stands. A moving actor heads where it moves."""
    uniform: bool = True

    def __post_init__(self) -> None:
        half_ranges = (self.longitudinal_m, self.lateral_m, self.yaw_rad)
        check_finite("a jitter", self.along_rad, *half_ranges)
        if min(half_ranges) < 0:
            raise InputError(f"half ranges of a jitter must not be negative, got {min(half_ranges):g}")


@dataclass(frozen=True)
class ScenarioActor:
    """An actor of the scenario: a copy of one of the log's actors on a way of its own.

    Raises:
        InputError: no actor of the log is named, or the heading is not finite.
    """

    names: tuple[str, ...]
    """Tracks of the log to choose from, one per run: their tokens or numbers."""
    way: Polyline | Rectilinear
    yaw_rad: float = 0.0
    """Heading in the world frame while the actor stands."""
    flipped: tuple[str, ...] = ()
    """Those of `names` that are turned by π while they stand."""
    jitter: Jitter = field(default_factory=Jitter)
    group: str | None = None
    """Only one actor of each group is in a run."""

    def __post_init__(self) -> None:
        if not self.names:
            raise InputError("an actor needs the name of at least one of the log's tracks")
        check_finite("an actor", self.yaw_rad)


@dataclass(frozen=True)
class SafetyScenario:
    """A safety test in one log.

    Raises:
        InputError: there is no actor, or a number is impossible.
    """

    name: str
    """Name of the scenario, unique within its kind."""
    kind: Threat
    scene: str
    """Name of the log or of the folder of its reconstruction."""
    start_frame: int
    """Key frame (0.5 s apart) at which the test begins."""
    length_s: float
    """Length of the test, priming included, s."""
    actors: tuple[ScenarioActor, ...]
    priming_frames: int = 1
    """Number of key frames over which the ego vehicle is moved along the log. Its plans are not used."""
    start_jitter_frames: int = 0
    """Half range of the change of the first key frame."""
    target: int = 0
    """Index of the actor to which the reference speed refers."""

    def __post_init__(self) -> None:
        if not self.actors:
            raise InputError(f"{self.label}: a scenario needs an actor")
        if not 0 <= self.target < len(self.actors):
            raise InputError(f"{self.label}: there is no actor {self.target}, which should be the target")
        if min(self.start_frame, self.priming_frames, self.start_jitter_frames) < 0:
            raise InputError(f"{self.label}: numbers of frames must not be negative")
        if not (math.isfinite(self.length_s) and self.length_s > FRAME_DT_S * (self.priming_frames + 1)):
            raise InputError(
                f"{self.label}: {self.length_s:g} s are too short for {self.priming_frames} frames of "
                "priming and a plan"
            )

    @property
    def label(self) -> str:
        """Return the kind and the name: the name of the scenario in files and tables."""
        return f"{self.kind}-{self.name}"
