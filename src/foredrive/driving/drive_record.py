"""Record of a drive, passed from the simulation to the report."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from foredrive.driving.bench2drive import smoothness_of
from foredrive.driving.comfort import Comfort
from foredrive.driving.drive import Drive, DrivePlan
from foredrive.driving.dynamics import STEP_S
from foredrive.driving.ncap.outcome import SafetyResult
from foredrive.driving.scores import RouteScore
from foredrive.scene import BicycleState, Event
from foredrive.scene.traffic_light import LightState

TRACK_EVERY = 5
"""One in this many states of a drive is kept: four per second."""
Point = tuple[float, float]
"""x and y, m, world frame."""


@dataclass(frozen=True)
class DrivenTrack:
    """Track that was driven, sampled at S times."""

    t_s: tuple[float, ...]
    xy: tuple[Point, ...]
    yaw_rad: tuple[float, ...]
    speed_mps: tuple[float, ...]


@dataclass(frozen=True)
class PlanRecord:
    """A plan, and what the agent saw of its path."""

    t_s: float
    xy: tuple[Point, ...]
    """Its points, from the place of the vehicle on."""
    light: LightState | None = None
    """The most probable state of the next light; None if the agent does not tell."""
    light_m: float = 0.0
    """Distance of its stop line along the route from the front bumper, m."""
    occupied: tuple[float, ...] = ()
    """Probability that a road user is now in each cell of the path, of `affordances.CELL_M`, from the bumper
    on."""


@dataclass(frozen=True)
class DriveRecord:
    """Everything that is kept of a drive except its log."""

    town: str | None
    """Town whose lanes the report draws below the drive. None without a map."""
    length_m: float
    """Length of the route, m."""
    score: RouteScore
    driving_score_1_0: float
    driving_score_2_1: float
    error: str
    """Error of the agent; empty if there was none."""
    events: tuple[Event, ...]
    comfort: Comfort | None
    """None if the drive is too short to tell."""
    nearest_s: tuple[float | None, ...]
    """Minimum time to collision at each key frame, s. None without a collision."""
    act_s: tuple[float, ...]
    """Wall-clock time of each plan, s."""
    route_xy: tuple[Point, ...]
    track: DrivenTrack
    wall_s: float
    log: str
    """Path of the drive's log inside the suite's folder."""
    threat: SafetyResult | None = None
    lanes_known: bool = True
    """False if departures from the lanes cannot be detected."""
    trusted_share: float | None = None
    """Share of the key frames that the reconstruction trusts; None where it was not asked, and in towns."""
    plans: tuple[PlanRecord, ...] = ()
    """Plans in the order of time; none in records of another program."""
    efficiency_pct: float | None = None
    smoothness_pct: float | None = None
    """Bench2Drive's driving efficiency and smoothness; None if the drive is too short to tell."""

    @property
    def scenario_events(self) -> tuple[Event, ...]:
        """Return the events that start scenarios, in the order of their start. This order numbers them."""
        return tuple(event for event in self.events if event.kind == "scenario")


def record_of(
    drive: Drive,
    route_xyz: Float64[np.ndarray, "N 3"],
    length_m: float,
    *,
    town: str | None,
    log: str,
    wall_s: float,
    threat: SafetyResult | None = None,
    lanes_known: bool = True,
    trusted_share: float | None = None,
) -> DriveRecord:
    """Build the record of a drive. The arguments are fields of `DriveRecord`."""
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
        track=DrivenTrack(
            t_s=tuple(round(STEP_S * TRACK_EVERY * k, 2) for k in range(len(states))),
            xy=tuple((round(s.x_m, 2), round(s.y_m, 2)) for s in states),
            yaw_rad=tuple(round(s.yaw_rad, 4) for s in states),
            speed_mps=tuple(round(s.speed_mps, 3) for s in states),
        ),
        wall_s=wall_s,
        log=log,
        threat=threat,
        lanes_known=lanes_known,
        trusted_share=trusted_share,
        plans=tuple(_plan_record(made, drive.states[made.step]) for made in drive.plans),
        efficiency_pct=drive.efficiency_pct,
        smoothness_pct=smoothness_of(drive.states),
    )


def _plan_record(made: DrivePlan, state: BicycleState) -> PlanRecord:
    # From the ego frame at the time of the plan to the world
    cos, sin = np.cos(state.yaw_rad), np.sin(state.yaw_rad)
    points = np.vstack([np.zeros(2), made.xy]) @ np.array([[cos, sin], [-sin, cos]]) + [state.x_m, state.y_m]
    t_s, xy = round(STEP_S * made.step, 2), tuple((x, y) for x, y in points.round(2).tolist())
    if made.sight is None:
        return PlanRecord(t_s, xy)
    return PlanRecord(
        t_s,
        xy,
        LightState(int(made.sight.light[0].argmax())),
        round(float(made.sight.light_m[0]), 2),
        tuple(round(p, 2) for p in made.sight.occupied[0, 0].tolist()),
    )
