"""Privileged expert for reconstructed logs: it is given the true boxes of all road users.

Twice a second it chooses among plans along the logged path, each with one acceleration and one offset to the
side, and each driven by the controller and the vehicle of our drives, as PDM-Closed does (Dauner et al.,
"Parting with Misconceptions about Learning-based Vehicle Motion Planning", CoRL 2023, sec. 4). Of the plans
that touch nobody it takes the one that comes furthest, less what it swerves; those that keep a margin go
first. If all touch somebody, it takes the one with the slowest first impact.

In a simulator it knows where the road users will be, since they replay their tracks. In a log it expects
them to go on at constant velocity.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float64

from foredrive.driving.collisions import Box, RoadUsers, touched
from foredrive.driving.controller import ControllerState, follow
from foredrive.driving.dynamics import EGO, STEP_S, step
from foredrive.driving.observation import FRAME_DT_S, HORIZON_STEPS
from foredrive.driving.plans import fixed_in_world
from foredrive.driving.replay.logged_drive import LoggedDrive
from foredrive.driving.replay.reconstructed import ReconstructedSimulator
from foredrive.driving.replay.replayed import users_at
from foredrive.driving.simple_agents import plan_of
from foredrive.errors import InputError
from foredrive.geometry.polylines import arc_lengths, points_at
from foredrive.scene import BicycleState, Boxes, Clip, Trajectory

LOOK_DT_S = 0.25
LOOK_TIMES_S = LOOK_DT_S * np.arange(1, 17)
"""Times ahead at which impacts are looked for, s. Plans end after 3 s; the controller brakes from there."""
ACCELERATIONS_MPS2 = (1.5, 0.0, -1.5, -3.0, -5.0, -7.5)
ASIDE_M = (0.0, 1.2, -1.2, 2.4, -2.4, 3.6, -3.6)
"""Offsets to the left of the logged path, m. Beyond 6 m a drive ends."""
SWERVES_PER_M = 1.5
"""Progress, m, that a plan has to gain for each metre of offset."""
SHIFT_M = 12.0
"""Distance over which the vehicle moves over to the offset of a plan, m; at least that of 1.5 s."""
MARGIN_M = 0.3
"""Distance that the expert keeps around its box, m."""
MIN_CRUISE_MPS = 3.0
"""The expert drives as fast as the log does here, but this fast at least, m/s."""


@runtime_checkable
class PrivilegedWorld(Protocol):
    """The privileged state that a simulator gives the expert beside its observations."""

    def ego(self) -> BicycleState:
        """Return the state of the ego vehicle."""
        ...

    def users_in(self, after_s: float) -> RoadUsers:
        """Return the road users some seconds from now, in the world frame."""
        ...


@dataclass(frozen=True, eq=False)
class ReplayedWorld:
    """A `PrivilegedWorld` of the simulator of a reconstructed log."""

    simulator: ReconstructedSimulator

    def ego(self) -> BicycleState:
        """Return the state of the ego vehicle."""
        return self.simulator.ego()

    def users_in(self, after_s: float) -> RoadUsers:
        """Return the actors some seconds from now, in the world frame."""
        simulator = self.simulator
        t_s = simulator.scenario.start_s + simulator.state.t_s + after_s
        return users_at(simulator.tracks, simulator.drive.vehicle.T_world_scene, t_s)


@dataclass(frozen=True, eq=False)
class ReplayExpert:
    """An agent that reads the boxes of its observation, which are true in a simulator."""

    drive: LoggedDrive
    world: PrivilegedWorld | None = None
    """None: road users are expected to go on at constant velocity."""

    def act(self, observation: Clip) -> Trajectory:
        """Return the best plan, for a batch of one.

        Raises:
            InputError: the observation has no boxes.
        """
        # A batch of one: the plan is made in the ego frame of now
        clip = observation[0]
        if not bool(clip.boxes_valid[-1]):
            raise InputError("the expert needs the true boxes of the road users")
        T_world_ego = clip.T_world_ego[-1].numpy()
        users = self._foreseen(_users(clip.boxes[clip.now]), T_world_ego)
        now = BicycleState(0.0, 0.0, 0.0, float(clip.ego_speed_mps[-1]))
        if self.world is not None:
            state = self.world.ego()
            now = dataclasses.replace(
                now, steering_rad=state.steering_rad, acceleration_mps2=state.acceleration_mps2
            )
        path = self.drive.path_ahead(T_world_ego)
        cruise_mps = max(MIN_CRUISE_MPS, self._logged_mps(T_world_ego))
        # All combinations of accelerations and lateral offsets
        plans = [
            _plan(path, now.speed_mps, cruise_mps, acceleration, aside_m)
            for acceleration, aside_m in itertools.product(ACCELERATIONS_MPS2, ASIDE_M)
        ]
        return _best(plans, now, users).trajectory

    def _foreseen(self, now: RoadUsers, T_world_ego: Float64[np.ndarray, "4 4"]) -> list[RoadUsers]:
        """Return the road users at each step that is looked ahead, in the ego frame of now."""
        if self.world is None:
            return [_moved_on(now, float(after_s)) for after_s in LOOK_TIMES_S]
        return [_in_ego(self.world.users_in(float(after_s)), T_world_ego) for after_s in LOOK_TIMES_S]

    def _logged_mps(self, T_world_ego: Float64[np.ndarray, "4 4"]) -> float:
        """Return the speed of the log at its pose that is nearest to the vehicle, m/s."""
        away_m = np.hypot(*(self.drive.poses[:, :2, 3] - T_world_ego[:2, 3]).T)
        return self.drive.state_at(float(self.drive.vehicle.t_s[int(np.argmin(away_m))])).speed_mps


@dataclass(frozen=True, eq=False)
class _Plan:
    """A plan in the ego frame."""

    trajectory: Trajectory
    worth: float
    """Progress, less what it swerves, m."""


def _best(plans: Sequence[_Plan], now: BicycleState, users: Sequence[RoadUsers]) -> _Plan:
    """Return the plan of the largest worth that keeps its margin; else one that touches nobody, or least.

    Args:
        now: the ego vehicle, at the origin.
        users: the road users at each step, in the ego frame of now.
    """
    close, touching = list[_Plan](), list[tuple[float, _Plan]]()
    # In order of worth: the first plan that keeps its margin is the best one
    for plan in sorted(plans, key=lambda plan: plan.worth, reverse=True):
        driven = _driven(plan.trajectory, now)
        if _impact_mps(driven, users, MARGIN_M) is None:
            return plan
        impact_mps = _impact_mps(driven, users, 0.0)
        if impact_mps is None:
            close.append(plan)
        else:
            touching.append((impact_mps, plan))
    return close[0] if close else min(touching, key=lambda item: item[0])[1]


def _driven(trajectory: Trajectory, now: BicycleState) -> list[BicycleState]:
    """Return the states at `LOOK_TIMES_S` of a vehicle that follows a plan."""
    state, states, every = now, [], round(LOOK_DT_S / STEP_S)
    # Drive the plan by the same controller and dynamics as in the simulator
    controller = ControllerState(fixed_in_world(trajectory, now, 0.0))
    for number in range(every * len(LOOK_TIMES_S)):
        control, controller = follow(controller, state, number * STEP_S)
        state = step(state, control)
        if number % every == every - 1:
            states.append(state)
    return states


def _impact_mps(driven: Sequence[BicycleState], users: Sequence[RoadUsers], margin_m: float) -> float | None:
    """Return the relative speed of the first touch; None if there is none."""
    half_lw = 0.5 * np.array([EGO.length_m, EGO.width_m]) + margin_m
    for state, user in zip(driven, users, strict=True):
        forward = np.array([math.cos(state.yaw_rad), math.sin(state.yaw_rad)])
        foot = np.array([state.x_m, state.y_m, 0.0])
        foot[:2] += EGO.axle_to_centre_m * forward
        hit = touched(Box(foot, state.yaw_rad, half_lw), user)
        if hit.any():
            against = state.speed_mps * forward - user.velocity_mps[hit]
            return float(np.linalg.norm(against, axis=1).max())
    return None


def _plan(
    path: Float64[np.ndarray, "N 2"],
    speed_mps: float,
    cruise_mps: float,
    acceleration_mps2: float,
    aside_m: float,
) -> _Plan:
    # Constant acceleration, between standing and the cruising speed
    highest = max(cruise_mps, speed_mps) if acceleration_mps2 > 0 else speed_mps
    speeds = np.clip(speed_mps + acceleration_mps2 * LOOK_TIMES_S, 0.0, highest)
    before = np.concatenate([[speed_mps], speeds[:-1]])
    way_m = np.cumsum(0.5 * (before + speeds) * LOOK_DT_S)
    arc_m = arc_lengths(path)
    # Headings of the path half a metre ahead
    ahead = points_at(path, arc_m, way_m + 0.5) - points_at(path, arc_m, way_m)
    headings = np.arctan2(ahead[:, 1], ahead[:, 0])
    starts_m = float(path[0] @ [-math.sin(headings[0]), math.cos(headings[0])])  # path left of the vehicle
    # Smoothstep from the present offset to that of the plan
    share = np.minimum(way_m / max(SHIFT_M, 1.5 * speed_mps), 1.0)
    smooth = share * share * (3 - 2 * share)
    left_m = -starts_m + smooth * (aside_m + starts_m)
    left = np.stack([-np.sin(headings), np.cos(headings)], axis=1)
    xy = points_at(path, arc_m, way_m) + left_m[:, None] * left
    every = round(FRAME_DT_S / LOOK_DT_S)
    points = torch.from_numpy(xy[every - 1 :: every][:HORIZON_STEPS]).float()
    return _Plan(plan_of(points[None, None]), float(way_m[-1]) - SWERVES_PER_M * abs(aside_m))


def _users(boxes: Boxes) -> RoadUsers:
    """Return the road users of an observation, in the ego frame, on one level."""
    centre = boxes.centre.double().numpy()
    foot = np.column_stack([centre[:, :2], np.zeros(len(centre))])
    velocity = np.nan_to_num(boxes.velocity.double().numpy())
    return RoadUsers(
        track_id=np.where(boxes.valid.numpy(), boxes.track_id.numpy(), -1),
        category=boxes.category.numpy(),
        foot_m=foot,
        yaw=boxes.yaw.double().numpy(),
        half_lw=0.5 * boxes.size_lwh[:, :2].double().numpy(),
        velocity_mps=velocity,
    )


def _moved_on(users: RoadUsers, after_s: float) -> RoadUsers:
    """Return the road users after some time at constant velocity."""
    foot_m = users.foot_m.copy()
    foot_m[:, :2] += after_s * users.velocity_mps
    return users._replace(foot_m=foot_m)


def _in_ego(users: RoadUsers, T_world_ego: Float64[np.ndarray, "4 4"]) -> RoadUsers:
    """Return road users of the world frame in the ego frame, on one level."""
    R, foot_m = T_world_ego[:2, :2], np.zeros_like(users.foot_m)
    # Row vectors times the rotation give ego coordinates
    foot_m[:, :2] = (users.foot_m - T_world_ego[:3, 3])[:, :2] @ R
    return users._replace(
        foot_m=foot_m,
        yaw=users.yaw - math.atan2(T_world_ego[1, 0], T_world_ego[0, 0]),
        velocity_mps=users.velocity_mps @ R,
    )
