"""What is kept of a drive, from the simulation to the report."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from foredrive.scene import Event
from foredrive.simulation.comfort import Comfort
from foredrive.simulation.drive import Drive
from foredrive.simulation.dynamics import STEP_S
from foredrive.simulation.scores import RouteScore
from foredrive.simulation.threats import Threat

TRACK_EVERY = 5
"""Of the states of a drive one in this many is kept: four a second."""
Point = tuple[float, float]
"""World frame, m."""


@dataclass(frozen=True)
class Track:
    """The way that was driven, S moments."""

    t_s: tuple[float, ...]
    xy: tuple[Point, ...]
    yaw_rad: tuple[float, ...]
    speed_mps: tuple[float, ...]


@dataclass(frozen=True)
class ThreatMet:
    """How a drive through a threat went."""

    kind: Threat
    impact_mps: float | None
    """Speed at which the vehicle was hit; None: it was not."""
    reference_mps: float
    """Speed at which a vehicle would be hit that goes on as the log did."""
    score: float


@dataclass(frozen=True)
class DriveRecord:
    """All that is kept of a drive but its log."""

    town: str | None
    """Whose lanes are drawn below it; None: there is no map."""
    length_m: float
    """Of the route."""
    score: RouteScore
    driving_score_1_0: float
    driving_score_2_1: float
    error: str
    """What the agent failed of; empty if it did not."""
    events: tuple[Event, ...]
    comfort: Comfort | None
    """None of a drive too short to tell."""
    nearest_s: tuple[float | None, ...]
    """Least time to collision at each key frame; None: nobody is on the way."""
    act_s: tuple[float, ...]
    """What the computer took for each plan."""
    route_xy: tuple[Point, ...]
    track: Track
    wall_s: float
    log: str
    """Where the drive's log lies in the suite's folder."""
    threat: ThreatMet | None = None
    lanes_known: bool = True
    """False: nothing can be said of leaving lanes."""

    @property
    def scenario_events(self) -> tuple[Event, ...]:
        """Where scenarios began, in the order in which they did: they are numbered by it."""
        return tuple(event for event in self.events if event.kind == "scenario")


def record_of(
    drive: Drive,
    route_xyz: Float64[np.ndarray, "N 3"],
    length_m: float,
    *,
    town: str | None,
    log: str,
    wall_s: float,
    threat: ThreatMet | None = None,
    lanes_known: bool = True,
) -> DriveRecord:
    """Return what is kept of a drive; arguments as the fields of `DriveRecord`."""
    states = drive.states[::TRACK_EVERY]
    return DriveRecord(
        town=town,
        length_m=length_m,
        score=drive.score,
        driving_score_1_0=drive.score.driving_score_1_0,
        driving_score_2_1=drive.score.driving_score_2_1,
        error=drive.error,
        events=drive.events,
        comfort=drive.comfort,
        nearest_s=tuple(seconds if np.isfinite(seconds) else None for seconds in drive.nearest_s),
        act_s=drive.act_s,
        route_xy=tuple((x, y) for x, y in route_xyz[:, :2].round(2).tolist()),
        track=Track(
            t_s=tuple(round(STEP_S * TRACK_EVERY * k, 2) for k in range(len(states))),
            xy=tuple((round(s.x_m, 2), round(s.y_m, 2)) for s in states),
            yaw_rad=tuple(round(s.yaw_rad, 4) for s in states),
            speed_mps=tuple(round(s.speed_mps, 3) for s in states),
        ),
        wall_s=wall_s,
        log=log,
        threat=threat,
        lanes_known=lanes_known,
    )
