"""One run of a safety test: its scene, its simulator, its pilot and its reference speed."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import shapely
import torch

from foredrive.driving.drive import FollowingPilot, Pilot, drive_route
from foredrive.driving.dynamics import STEP_S
from foredrive.driving.ncap.drawing import DrawnRun, draw_run
from foredrive.driving.ncap.nuplan_lqr import LqrPlan, lqr_step
from foredrive.driving.ncap.outcome import first_collision
from foredrive.driving.ncap.placing import place_actors, way_velocity
from foredrive.driving.ncap.rules import Reference, Rules
from foredrive.driving.ncap.scenario import SafetyScenario
from foredrive.driving.observation import FRAME_DT_S, HORIZON_STEPS
from foredrive.driving.plans import waypoints_of
from foredrive.driving.replay.logged_drive import LoggedDrive
from foredrive.driving.replay.logged_lanes import LoggedLanes
from foredrive.driving.replay.reconstructed import ReconstructedScenario, ReconstructedSimulator
from foredrive.driving.simple_agents import plan_of
from foredrive.errors import InputError
from foredrive.methods.reconstruction.scene_graph import SceneGraph
from foredrive.methods.reconstruction.vehicle import LoggedVehicle
from foredrive.scene import BicycleState, Clip, Renderer, Step, Trajectory

REFERENCE_S = 4.0
"""Time after the first key frame at which the paper takes the speeds, s."""


@dataclass(frozen=True, eq=False)
class Place:
    """A reconstructed log in which tests are driven."""

    graph: SceneGraph
    """The scene without the actors of a test."""
    vehicle: LoggedVehicle
    renderer: Callable[[SceneGraph], Renderer]
    """Returns the renderer of a changed scene."""
    track_ids: Mapping[str, int]
    """Id of each track of the log by its token."""
    lanes: LoggedLanes | None = None


@dataclass(frozen=True, eq=False)
class SafetyRun:
    """One run, ready to be driven."""

    simulator: ReconstructedSimulator
    scenario: ReconstructedScenario
    drawn: DrawnRun
    pilot: Pilot


def set_up_run(
    place: Place,
    scenario: SafetyScenario,
    number: int,
    rules: Rules,
    *,
    sensors: bool,
    past_frames: int,
    stay_trusted: bool = False,
) -> SafetyRun:
    """Set up run `number` of a scenario. The ego vehicle drives itself from the end of the priming on.

    Raises:
        InputError: the log does not cover the run, or has no actor of a name.
    """
    drawn = draw_run(scenario, number)
    # The vehicle drives itself after the priming
    start_s = FRAME_DT_S * (drawn.start_frame + scenario.priming_frames)
    length_s = scenario.length_s - FRAME_DT_S * scenario.priming_frames - rules.unchecked_end_s
    T_world_scene = place.vehicle.T_world_scene
    drive = LoggedDrive(place.vehicle, torch.eye(4))
    if start_s + length_s > drive.end_s + STEP_S:
        raise InputError(
            f"{scenario.label}: run {number} lasts to {start_s + length_s:g} s, but the log ends at "
            f"{drive.end_s:.1f} s"
        )
    # The agent's past frames must lie in the log
    first_s = drive.first_s + FRAME_DT_S * past_frames
    if start_s < first_s - STEP_S:
        raise InputError(
            f"{scenario.label}: run {number} begins to drive at {start_s:g} s, but the agent sees "
            f"{past_frames} earlier key frames, which this log has from {first_s:.1f} s on"
        )
    graph = place_actors(place.graph, drawn, T_world_scene, place.track_ids, moving_stay=rules.moving_stay)
    simulator = ReconstructedSimulator(place.renderer(graph), graph.all_tracks, drive, place.lanes)
    start = ReconstructedScenario(
        start_s,
        sensors,
        past_frames,
        ends_on_collision=True,
        length_s=length_s,
        contact=rules.contact,
        stays_trusted=stay_trusted,
    )
    return SafetyRun(simulator, start, drawn, pilot_of(rules, simulator))


def pilot_of(rules: Rules, simulator: ReconstructedSimulator) -> Pilot:
    """Return the pilot that follows an agent's plans under some rules."""
    if rules.controller == "own":
        return FollowingPilot(simulator, rules.latency_s)
    return LqrPilot(simulator, rules)


class LqrPilot:
    """Follow plans by nuPlan's regulator every 0.1 s. States between two commands are interpolated."""

    def __init__(self, simulator: ReconstructedSimulator, rules: Rules) -> None:
        self._simulator, self._rules = simulator, rules
        self._plan: LqrPlan | None = None
        self._made_s = 0.0
        self._next: BicycleState | None = None

    def expect(self, trajectory: Trajectory, ego: BicycleState, t_s: float) -> None:
        """Take over a plan. It takes effect at once.

        Raises:
            InputError: the plan has no finite point.
        """
        self._plan = LqrPlan(ego, waypoints_of(trajectory), trajectory.dt_s)
        self._made_s = t_s

    def step(self, ego: BicycleState, t_s: float) -> Step:
        """Move the vehicle on by one step of the simulation, half a step of the regulator."""
        # Every second step of the simulation is halfway between two commands
        if self._next is not None:
            arrived, self._next = self._next, None
            return self._simulator.step_to(arrived)
        if self._plan is None:
            raise InputError("there is no plan to follow")
        rules = self._rules
        self._next = lqr_step(
            self._plan, ego, t_s - self._made_s, rules.vehicle, rules.stops_below_m, rules.pose_feedback
        )
        return self._simulator.step_to(_between(ego, self._next))


def _between(before: BicycleState, after: BicycleState) -> BicycleState:
    """Return the state in the middle of two. Its acceleration is that of the later one."""
    turned = float(np.remainder(after.yaw_rad - before.yaw_rad + np.pi, 2 * np.pi) - np.pi)
    return BicycleState(
        0.5 * (before.x_m + after.x_m),
        0.5 * (before.y_m + after.y_m),
        before.yaw_rad + 0.5 * turned,
        0.5 * (before.speed_mps + after.speed_mps),
        0.5 * (before.steering_rad + after.steering_rad),
        after.acceleration_mps2,
    )


@dataclass(frozen=True, eq=False)
class ConstantSpeedAgent:
    """Agent that follows the logged path at the speed that it has at the start of the drive."""

    drive: LoggedDrive
    speed_mps: float

    def act(self, observation: Clip) -> Trajectory:
        """Return points on the path ahead, for a batch of one. Behind the log's end the path is straight."""
        T_world_ego = observation.T_world_ego[0, -1].numpy()
        line = self.drive.line
        # From the nearest point of the path on, at constant speed
        from_m = line.project(shapely.Point(T_world_ego[:2, 3]))
        ahead_m = self.speed_mps * FRAME_DT_S * np.arange(1, HORIZON_STEPS + 1)
        xy = np.array([line.interpolate(from_m + way).coords[0] for way in ahead_m])
        # Row vectors times the rotation give ego coordinates
        local = (xy - T_world_ego[:2, 3]) @ T_world_ego[:2, :2]
        return plan_of(torch.from_numpy(local).float()[None, None])


def drive_without_action(place: Place, scenario: SafetyScenario, number: int, rules: Rules) -> float | None:
    """Drive a run at constant speed along the logged path. Return the impact speed, m/s, None without one.

    Nothing is rendered.

    Raises:
        InputError: as `set_up_run`, or the vehicle cannot be driven.
    """
    run = set_up_run(place, scenario, number, rules, sensors=False, past_frames=0)
    speed_mps = run.simulator.drive.state_at(run.scenario.start_s).speed_mps
    agent = ConstantSpeedAgent(run.simulator.drive, speed_mps)
    drive = drive_route(run.simulator, run.scenario, agent, route=scenario.label, pilot=run.pilot)
    if drive.error:
        raise InputError(f"{scenario.label}: run {number} cannot be driven at constant speed: {drive.error}")
    hit = first_collision(drive)
    return None if hit is None else hit.severity


def reference_mps(rules: Rules, drive: LoggedDrive, drawn: DrawnRun, no_action_mps: float) -> float:
    """Return the reference speed of an impact in a run, m/s.

    Args:
        no_action_mps: the impact speed that `drive_without_action` found for this run.
    """
    if rules.reference is Reference.NO_ACTION:
        return no_action_mps
    after_s = FRAME_DT_S * drawn.start_frame + REFERENCE_S
    # Speeds by the rule: of the log after 4 s, or at its end as in the released code
    from_s = after_s if rules.reference is Reference.AFTER_4_S else drive.end_s - FRAME_DT_S
    before, after = (drive.pose_at(t_s)[:2, 3] for t_s in (from_s, from_s + FRAME_DT_S))
    ego = (after - before) / FRAME_DT_S
    return float(np.hypot(*(ego - way_velocity(drawn.target.way, after_s))))
