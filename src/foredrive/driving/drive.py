"""One drive of one route: the agent plans, the controller follows and the simulator steps until the end."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from foredrive.data.batches import stack_records
from foredrive.debugging import profile_step
from foredrive.driving.bench2drive import EfficiencyMeter
from foredrive.driving.comfort import JERK_S, Comfort, comfort_of
from foredrive.driving.controller import ControllerState, follow
from foredrive.driving.dynamics import EGO, STEP_S
from foredrive.driving.observation import FRAME_DT_S
from foredrive.driving.plans import fixed_in_world, waypoints_of
from foredrive.driving.scores import Ending, RouteScore, infraction_of
from foredrive.driving.time_to_collision import MovingBoxes, time_to_collision_s
from foredrive.errors import InputError
from foredrive.scene import Agent, BicycleState, Clip, Event, Simulator, Step, Trajectory
from foredrive.scene.affordances import PathEstimate
from foredrive.scene.protocols import SeesPath


@dataclass(frozen=True)
class PlanningTiming:
    """Planning period and latency of an agent, in simulation time (not the computer's time).

    Raises:
        InputError: the period is no multiple of the key frame interval, or the latency is negative.
    """

    period_s: float = FRAME_DT_S
    latency_s: float = 0.1

    def __post_init__(self) -> None:
        frames = self.period_s / FRAME_DT_S
        if not (frames > 0.5 and abs(frames - round(frames)) < 1e-6):
            raise InputError(
                f"the planning period must be a multiple of {FRAME_DT_S} s, got {self.period_s} s"
            )
        if not 0 <= self.latency_s < math.inf:
            raise InputError(f"the latency must be at least 0 s, got {self.latency_s}")

    @property
    def steps(self) -> int:
        """Return the number of simulation steps between plans."""
        return round(self.period_s / STEP_S)


class DrivePlan(NamedTuple):
    """A plan of a drive."""

    step: int
    """The step at which it was made."""
    xy: Float64[np.ndarray, "_ 2"]
    """Its points in the ego frame then, m."""
    sight: PathEstimate | None
    """Estimate of its path by the agent then; None if it does not tell."""


@dataclass(frozen=True, eq=False)
class Drive:
    """Result of one drive."""

    score: RouteScore
    states: tuple[BicycleState, ...]
    """State at the start and after each step."""
    events: tuple[Event, ...]
    nearest_s: tuple[float, ...]
    """Minimum time to collision at each key frame, s, if all move at constant velocity. Infinite without a
    collision."""
    act_s: tuple[float, ...]
    """Wall-clock time of each plan, s."""
    comfort: Comfort | None
    """None if the drive is too short to tell."""
    error: str = ""
    """Error of the agent; empty if there was none."""
    plans: tuple[DrivePlan, ...] = ()
    efficiency_pct: float | None = None
    """Bench2Drive's driving efficiency; None if the drive is too short to tell."""


@runtime_checkable
class Pilot(Protocol):
    """Moves the vehicle of a simulator along an agent's plans."""

    def expect(self, trajectory: Trajectory, ego: BicycleState, t_s: float) -> None:
        """Take a plan that was made from an observation at `t_s`, where the vehicle was at `ego`.

        Raises:
            InputError: the plan cannot be followed.
        """
        ...

    def step(self, ego: BicycleState, t_s: float) -> Step:
        """Move on by one step of the simulation from `ego` at `t_s`."""
        ...


class FollowingPilot:
    """A `Pilot` by `driving.controller`: it follows smoothed plans once the latency has passed."""

    def __init__(self, simulator: Simulator, latency_s: float) -> None:
        self._simulator, self._latency_s = simulator, latency_s
        self._controller = ControllerState()

    def expect(self, trajectory: Trajectory, ego: BicycleState, t_s: float) -> None:
        """Take a plan. It takes effect after the latency."""
        plan = fixed_in_world(trajectory, ego, t_s)
        self._controller = self._controller.expecting(plan, t_s + self._latency_s)

    def step(self, ego: BicycleState, t_s: float) -> Step:
        """Move on by one step."""
        control, self._controller = follow(self._controller, ego, t_s)
        return self._simulator.step(control)


def drive_route(
    simulator: Simulator,
    scenario: object,
    agent: Agent,
    *,
    route: str,
    repetition: int = 0,
    pace: PlanningTiming | None = None,
    pilot: Pilot | None = None,
    on_frame: Callable[[], None] = lambda: None,
) -> Drive:
    """Drive until the route ends.

    The drive also ends, with `Ending.CRASHED`, if the agent raises an error or returns no plan.

    Args:
        scenario: scenario to which the simulator is reset.
        agent: agent that drives; it observes a batch of one clip.
        route: name of the route.
        pilot: moves the vehicle of this simulator along the plans; by default a `FollowingPilot`.
        on_frame: called at each key frame, including the first, before the agent observes it.

    Raises:
        InputError: the simulator cannot start the scenario.
    """
    pace = pace or PlanningTiming()
    clip = simulator.reset(scenario)
    on_frame()
    # Time to collision at the first key frame; then at each later one
    states, events, nearest, act_s = [simulator.ego()], list[Event](), [_nearest_s(clip)], list[float]()
    plans = list[DrivePlan]()
    pilot, ending, error = pilot or FollowingPilot(simulator, pace.latency_s), None, ""
    efficiency = EfficiencyMeter()
    while ending is None:
        index = len(states) - 1
        profile_step()
        # Plan at the multiples of the planning period
        if index % pace.steps == 0:
            began = time.perf_counter()
            try:
                plan = agent.act(stack_records([clip]))
                pilot.expect(plan, states[-1], index * STEP_S)
                sight = agent.sight if isinstance(agent, SeesPath) else None
                plans.append(DrivePlan(index, waypoints_of(plan), sight))
            except Exception as problem:  # any error of an agent ends the drive, but the route still counts
                ending, error = Ending.CRASHED, f"{type(problem).__name__}: {problem}"
                break
            act_s.append(time.perf_counter() - began)
        step = pilot.step(states[-1], index * STEP_S)
        states.append(simulator.ego())
        events += step.events
        # A new clip marks a new key frame
        if step.clip is not clip:
            clip = step.clip
            nearest.append(_nearest_s(clip))
            completion = simulator.progress().completion
            efficiency.see(float(clip.ego_speed_mps[clip.now]), clip.boxes[clip.now], completion)
            on_frame()
        # The first event that is an ending ends the drive
        ending = next((Ending(event.kind) for event in step.events if event.kind in set(Ending)), None)
    infractions = tuple(infraction for event in events if (infraction := infraction_of(event)) is not None)
    duration_s, progress = (len(states) - 1) * STEP_S, vars(simulator.progress())
    score = RouteScore(
        route, repetition, ending=ending, infractions=infractions, duration_s=duration_s, **progress
    )
    comfort = comfort_of(states) if len(states) * STEP_S > JERK_S + STEP_S else None
    return Drive(
        score,
        tuple(states),
        tuple(events),
        tuple(nearest),
        tuple(act_s),
        comfort,
        error,
        tuple(plans),
        efficiency.result(score.completion),
    )


def _nearest_s(clip: Clip) -> float:
    """Return the minimum time to collision at the clip's current frame, s."""
    boxes = clip.boxes[clip.now]
    valid = boxes.valid.numpy()
    if not valid.any():
        return math.inf
    others = MovingBoxes(
        boxes.centre[:, :2].double().numpy()[valid],
        boxes.size_lwh[:, :2].double().numpy()[valid],
        boxes.yaw.double().numpy()[valid],
        boxes.velocity.double().numpy()[valid],
    )
    ego = MovingBoxes(
        # The ego vehicle in its own frame: the origin is the rear axle
        np.array([[EGO.axle_to_centre_m, 0.0]]),
        np.array([[EGO.length_m, EGO.width_m]]),
        np.zeros(1),
        np.array([[float(clip.ego_speed_mps[clip.now]), 0.0]]),
    )
    return float(time_to_collision_s(ego, others).min())
