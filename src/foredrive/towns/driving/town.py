"""Simulator of a town: the ego vehicle drives at 20 Hz, traffic reacts to it, sensors render key frames."""

import dataclasses
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float64

from foredrive.driving.collisions import Contacts, RoadUsers
from foredrive.driving.dynamics import EGO, STEP_S, step, yaw_rate_radps
from foredrive.driving.lane_rules import RuleState
from foredrive.driving.observation import FRAME_STEPS, KeyFrame, no_images
from foredrive.driving.route_progress import RouteLine, RouteProgress, first_step
from foredrive.driving.route_scenario import SETTLE_S, RouteScenario
from foredrive.errors import InputError
from foredrive.scene import BicycleState, Clip, Control, DriveProgress, Event, Step
from foredrive.scene.actors import boxes_in_ego_frame, in_box_range
from foredrive.scene.conditions import BackgroundTraffic
from foredrive.towns.driving.collision_sense import CollisionSense
from foredrive.towns.driving.road_users import road_users
from foredrive.towns.driving.town_lanes import TownLaneRules
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.scenarios.context import ScenarioEgo, ScenarioProgress
from foredrive.towns.scenarios.director import Director
from foredrive.towns.scenarios.scenario import Scenario
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.traffic.external_ego import EgoPose, find_lane
from foredrive.towns.traffic.fleet import ego_vehicle
from foredrive.towns.traffic.state import TrafficState
from foredrive.towns.traffic.traffic import Traffic
from foredrive.towns.world import World

TRAFFIC_STEPS = 2
"""The traffic decides at 10 Hz, as in recordings. Between decisions its road users move in a straight
line."""
DECISION_S = TRAFFIC_STEPS * STEP_S
SCENARIO_SLOTS = 6
"""Maximum number of scenario vehicles on the road at one time."""


@dataclass(frozen=True, eq=False)
class TownScenario(RouteScenario):
    """Set-up of a drive in an embedded town."""

    sensors: SensorSuite | None = None
    lanes: tuple[int, ...] = ()
    """Lane of the route at the end of each stretch, as `TrafficState.route`. The traffic expects it.
    Without lanes the traffic expects the vehicle to go straight on."""
    scenarios: tuple[Scenario, ...] = ()
    """Scenarios on the route, in the order in which they are met, as `scenarios_on` returns them for route
    and seed."""


@dataclass(frozen=True, eq=False)
class TownState:
    """State of a drive at one time. Together with the scenario it determines the future of the drive."""

    step_index: int
    ego: BicycleState
    z_m: float
    """Height of the road below the rear axle, m."""
    traffic: TrafficState
    """Traffic at its last decision."""
    decided: TrafficState
    """Traffic one decision later: the state towards which the road users move."""
    scenarios: ScenarioProgress
    """State of the scenarios at that decision."""
    frames: tuple[KeyFrame, ...]
    contacts: Contacts = field(default_factory=Contacts)
    rules: RuleState = field(default_factory=RuleState)
    progress: RouteProgress = field(default_factory=RouteProgress)
    ended: str | None = None
    """Reason why the drive is over. None while it goes on."""

    @property
    def t_s(self) -> float:
        """Return the time since the drive began, s."""
        return self.step_index * STEP_S


@dataclass(frozen=True, eq=False)
class PredictedState:
    """Predicted state in which the traffic's own rules drive the ego vehicle, which is vehicle 0 here."""

    t_s: float
    traffic: TrafficState
    scenarios: ScenarioProgress
    progress: RouteProgress


@dataclass(frozen=True, eq=False)
class SavedDrive:
    """A saved drive, to be continued in this process or in another."""

    scenario: TownScenario
    state: TownState


class TownSimulator:
    """A `Simulator` over the embedded towns: equal scenarios and controls give equal drives, bit by bit."""

    state: TownState
    _users: tuple[RoadUsers, RoadUsers]
    """Road users in `state.traffic` and in `state.decided`."""

    def reset(self, scenario: TownScenario) -> Clip:
        """Start a drive. This takes some seconds if the town is not the previous one.

        Raises:
            InputError: there is no such town, or the route has no length or begins on no lane.
        """
        self._prepare(scenario)
        # The vehicle stands at the start of the route, on the nearest lane there
        ego = _start(scenario.route_xyz)
        z_m = float(scenario.route_xyz[0, 2])
        driven = self._driven(ego, z_m)
        middle = driven.axle_xyz + EGO.axle_to_centre_m * driven.forward
        nowhere = np.zeros(0, dtype=np.int64)
        placed_lane = find_lane(self._traffic.lane_index, middle, driven.yaw_rad, nowhere, nowhere)
        if placed_lane is None:
            raise InputError(f"the route begins on no lane of {scenario.town}: {scenario.route_xyz[0]}")
        row = ego_vehicle(self._traffic.lanes, np.array([placed_lane[0]]), np.array([placed_lane[1]]))
        lanes = np.array(scenario.lanes, dtype=np.int64) if scenario.lanes else None
        scenarios, traffic = self._director.set_up(
            self._traffic.start(row, lanes), self._seen(ego, RouteProgress(), z_m, 0.0), DECISION_S
        )
        # Run the traffic for some seconds around the standing
        # vehicle; its frames are the past of the first clip
        before = max(round(SETTLE_S / DECISION_S), scenario.past_frames * FRAME_STEPS // TRAFFIC_STEPS)
        frames: tuple[KeyFrame, ...] = ()
        for number in range(-before, 1):
            state = TownState(number * TRAFFIC_STEPS, ego, z_m, traffic, traffic, scenarios, frames)
            if number * TRAFFIC_STEPS % FRAME_STEPS == 0:
                frames = self._with_frame(state)
            # Time is negative before the drive begins
            if number < 0:
                scenarios, traffic = self._decide(state)
        self._adopt(TownState(0, ego, z_m, traffic, traffic, scenarios, frames))
        return self._clip

    def step(self, control: Control) -> Step:
        """Drive on for `STEP_S`. The clip is that of the latest key frame.

        Raises:
            InputError: the drive is over, or the control is not finite.
        """
        state = self.state
        if state.ended is not None:
            raise InputError(f"the drive is over ({state.ended}): reset the simulator")
        # The vehicle moves first; the traffic decides at every second step, from the state before the move
        moved = step(state.ego, control)
        if state.step_index % TRAFFIC_STEPS == 0:
            scenarios, decided = self._decide(state)
            state = dataclasses.replace(state, traffic=state.decided, decided=decided, scenarios=scenarios)
            self._users = self._users[1], road_users(self._traffic, decided)
        # Scenarios that this decision has begun
        begun = state.scenarios.begun[len(self.state.scenarios.begun) :]
        state, events = self._drive(state, moved)
        events = [*(self._begin_of(number) for number, _ in begun), *events]
        if state.step_index % FRAME_STEPS == 0:
            state = dataclasses.replace(state, frames=self._with_frame(state))
            self.state, self._clip = state, self._make_clip(state)
        self.state = state
        return Step(self._clip, events, state.ended is not None)

    def _begin_of(self, number: int) -> Event:
        state, kind = self.state, self._scenario.scenarios[number].kind
        return Event("scenario", state.t_s, (state.ego.x_m, state.ego.y_m), what=kind.value)

    @property
    def scenario(self) -> TownScenario:
        """Return the current scenario."""
        return self._scenario

    def ego(self) -> BicycleState:
        """Return the current state of the ego vehicle."""
        return self.state.ego

    @property
    def traffic(self) -> Traffic:
        """Return the traffic, with the rules that its road users follow."""
        return self._traffic

    def predict_now(self) -> PredictedState:
        """Return the prediction for now if the traffic decides now, else for its next decision."""
        state = self.state
        # Traffic at its next decision, with vehicle 0 handed to the rules of the traffic
        traffic = self._traffic.with_own_driver(state.decided, self.driven)
        return PredictedState(state.t_s, traffic, state.scenarios, state.progress)

    def predict_next(self, now: PredictedState) -> PredictedState:
        """Return the prediction `DECISION_S` later."""
        v, poses, route = now.traffic.vehicles, self._traffic.poses(now.traffic), self._route
        xyz, speed, t_s = poses.axle_xyz[0], float(v.speed_mps[0]), now.t_s
        # In the prediction, progress and scenarios follow the simulated vehicle
        progress = route.advance(now.progress, xyz[:2], speed, t_s)
        motion = speed, float(v.acceleration_mps2[0])
        ego = ScenarioEgo(t_s, progress.done_m, *motion, poses.centre_m[0], float(poses.yaw[0]))
        scenarios, traffic, orders = self._director.direct(now.scenarios, now.traffic, ego, DECISION_S)
        after = self._traffic.step(traffic, DECISION_S, orders=orders)
        return PredictedState(t_s + DECISION_S, after, scenarios, progress)

    @property
    def signal_xyz(self) -> dict[int, Float64[np.ndarray, "_ 3"]]:
        """Return points on the lamps of each traffic light, by the index of its stop zone."""
        return self._world.signal_xyz

    @property
    def done_m(self) -> float:
        """Return how far along its route the vehicle has come, m."""
        return self.state.progress.done_m

    @property
    def driven(self) -> EgoPose:
        """Return the current ego vehicle as the traffic sees it."""
        return self._driven(self.state.ego, self.state.z_m)

    def progress(self) -> DriveProgress:
        """Return the progress of the drive."""
        return self.state.rules.progress(self._route.completion(self.state.progress))

    def save(self) -> SavedDrive:
        """Return the drive in its current state, as an immutable value that can be pickled."""
        return SavedDrive(self._scenario, self.state)

    def restore(self, saved: SavedDrive) -> Clip:
        """Continue a saved drive as if there had been no interruption."""
        self._prepare(saved.scenario)
        self._adopt(saved.state)
        return self._clip

    def _prepare(self, scenario: TownScenario) -> None:
        # The order matters: lane rules and director need the traffic
        self._scenario = scenario
        self._world = grow(scenario.town, scenario.seed)
        self._traffic = _rules_of(scenario.town, scenario.seed, scenario.background_traffic)
        if scenario.conditions is not None:
            self._world = self._world.under(scenario.conditions)
        self._collisions = CollisionSense(self._world)
        self._rules = TownLaneRules(load_town_map(scenario.town), self._traffic)
        self._route = RouteLine(scenario.route_xyz)
        self._director = Director(self._traffic, scenario.scenarios)

    def _adopt(self, state: TownState) -> None:
        self.state, self._clip = state, self._make_clip(state)
        self._users = road_users(self._traffic, state.traffic), road_users(self._traffic, state.decided)

    def _decide(self, state: TownState) -> tuple[ScenarioProgress, TrafficState]:
        """Compute the next decision of the scenarios and the traffic."""
        seen = self._seen(state.ego, state.progress, state.z_m, state.t_s)
        scenarios, traffic, orders = self._director.direct(state.scenarios, state.decided, seen, DECISION_S)
        driven = self._driven(state.ego, state.z_m)
        return scenarios, self._traffic.step(traffic, DECISION_S, driven, orders)

    def _seen(self, ego: BicycleState, progress: RouteProgress, z_m: float, t_s: float) -> ScenarioEgo:
        """Return the ego vehicle as scenarios see it."""
        driven = self._driven(ego, z_m)
        middle = driven.axle_xyz + EGO.axle_to_centre_m * driven.forward
        return ScenarioEgo(t_s, progress.done_m, ego.speed_mps, ego.acceleration_mps2, middle, ego.yaw_rad)

    def _drive(self, state: TownState, moved: BicycleState) -> tuple[TownState, list[Event]]:
        """Move the ego vehicle unless an obstacle stops it. Return the new state and the events."""
        index = state.step_index + 1
        # Share of the way from one decision of the traffic to the next
        t_s, part = index * STEP_S, (state.step_index % TRAFFIC_STEPS + 1) / TRAFFIC_STEPS
        users: RoadUsers = self._users[0].towards(self._users[1], part)
        T = self._pose(moved, state.z_m)
        # A collision that stops the vehicle keeps its old pose at speed 0
        events, contacts, stopped = self._collisions.check(T, moved, users, state.contacts, t_s)
        if stopped:
            moved = dataclasses.replace(state.ego, speed_mps=0.0, acceleration_mps2=0.0)
            T = self._pose(moved, state.z_m)
        z_m = float(T[2, 3])
        # Lights at the time of this step, which lies between two decisions
        lights = self._traffic.zone_lights(state.traffic.time_s + part * DECISION_S)
        more, rules = self._rules.check(state.ego, moved, z_m, lights, state.rules, t_s)
        progress = self._route.advance(state.progress, T[:2, 3], moved.speed_mps, t_s)
        ended = self._route.end_of(progress, t_s, self._scenario.limit_s)
        events += more
        if ended is not None:
            events += [*rules.final_events(t_s), self._route.end_event(ended, progress, moved, t_s)]
        return dataclasses.replace(
            state,
            step_index=index,
            ego=moved,
            z_m=z_m,
            contacts=contacts,
            rules=rules,
            progress=progress,
            ended=ended,
        ), events

    def _driven(self, ego: BicycleState, z_m: float) -> EgoPose:
        axle = np.array([ego.x_m, ego.y_m, z_m])
        return EgoPose(axle, ego.yaw_rad, ego.speed_mps, yaw_rate_radps(ego))

    def _pose(self, ego: BicycleState, about_z_m: float) -> Float64[np.ndarray, "4 4"]:
        """Return `T_world_ego` on the road: both axles are at road height, and roll is 0."""
        flat = np.array([np.cos(ego.yaw_rad), np.sin(ego.yaw_rad)])
        # Ground points of rear and front axle; their heights give the pitch
        axles = np.array([ego.x_m, ego.y_m]) + np.array([[0.0], [EGO.wheelbase_m]]) * flat
        rear_m, front_m = self._traffic.lane_index.height_m(axles, about_z_m)
        forward = np.array([*(EGO.wheelbase_m * flat), front_m - rear_m])
        forward /= np.linalg.norm(forward)
        # No roll: left is horizontal, up completes the right-handed frame
        left = np.array([-flat[1], flat[0], 0.0])
        T = np.eye(4)
        T[:3, :3] = np.stack([forward, left, np.cross(forward, left)], axis=1)
        T[:3, 3] = ego.x_m, ego.y_m, rear_m
        return T

    def now(self) -> Clip:
        """Return what is sensed now, between key frames too: a clip of one frame. It changes no drive."""
        sensors = self._scenario.sensors
        return self._route.observe(
            (self._frame(self.state),), self.state.progress, None if sensors is None else sensors.rig
        )

    def _with_frame(self, state: TownState) -> tuple[KeyFrame, ...]:
        """Append the current key frame and return the latest frames, as many as an observation has."""
        return (*state.frames, self._frame(state))[-1 - self._scenario.past_frames :]

    def _frame(self, state: TownState) -> KeyFrame:
        T, sensors = self._pose(state.ego, state.z_m), self._scenario.sensors
        actors = self._traffic.actors(state.decided)
        near = in_box_range([*actors, *self._world.parked], T)
        images, sweep = no_images(), None
        if sensors is not None:
            # Image noise depends on seed and key frame, so that a restored drive renders the same images
            number = state.step_index // FRAME_STEPS + self._scenario.past_frames
            noise = np.random.SeedSequence((self._scenario.seed, max(number, 0))).generate_state(1)
            twist = np.array([state.ego.speed_mps, 0.0, 0.0, 0.0, 0.0, yaw_rate_radps(state.ego)])
            lights = self._traffic.zone_lights(state.decided.time_s)
            seen = self._world.render(actors, sensors, T, twist, int(noise[0]), lights)
            # Images as [camera, channel, row, column]
            images = torch.from_numpy(np.stack(list(seen.images.values()))).permute(0, 3, 1, 2).contiguous()
            sweep = seen.sweep
        return KeyFrame(state.t_s, T, state.ego.speed_mps, images, sweep, boxes_in_ego_frame(near, T))

    def _make_clip(self, state: TownState) -> Clip:
        sensors = self._scenario.sensors
        return self._route.observe(state.frames, state.progress, None if sensors is None else sensors.rig)


_grown: dict[tuple[str, int], World] = {}


def grow(town: str, seed: int) -> World:
    """Build the world of a town and a seed, in bright daylight. The last one is kept for the next drives."""
    if (town, seed) not in _grown:
        _grown.clear()  # first: with two at a time, each new one would leave memory scattered
        _grown[town, seed] = World(load_town_map(town), seed)
    return _grown[town, seed]


@lru_cache(maxsize=1)
def _rules_of(town: str, seed: int, background: BackgroundTraffic) -> Traffic:
    return Traffic(load_town_map(town), seed, background.vehicles + 1, background.pedestrians, SCENARIO_SLOTS)


def _start(route_xyz: Float64[np.ndarray, "M 3"]) -> BicycleState:
    """Return the state of a vehicle at rest at the beginning of a route, pointing along it."""
    x, y, _ = first_step(route_xyz)
    return BicycleState(float(route_xyz[0, 0]), float(route_xyz[0, 1]), float(np.arctan2(y, x)), 0.0)
