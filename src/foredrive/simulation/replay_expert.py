"""Privileged expert for rebuilt logs: it is given the true boxes of all road users.

Twice a second it chooses among plans along the logged path, each with one acceleration and one offset to the
side, as PDM-Closed does (Dauner et al., "Parting with Misconceptions about Learning-based Vehicle Motion
Planning", CoRL 2023, sec. 4). Road users are expected to go on at constant velocity. Of the plans that touch
nobody it takes the one that comes furthest, less what it swerves. If all touch somebody, it takes the one
with the slowest first impact.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64

from foredrive.errors import InputError
from foredrive.geometry.polylines import arc_lengths, points_at
from foredrive.scene import Boxes, Clip, Trajectory
from foredrive.simulation.dynamics import EGO
from foredrive.simulation.logged_drive import LoggedDrive
from foredrive.simulation.observation import FRAME_DT_S, HORIZON_STEPS
from foredrive.simulation.road_users import Box, RoadUsers, touched
from foredrive.simulation.simple_agents import plan_of

LOOK_S, LOOK_DT_S = 4.0, 0.25
"""Time ahead in which impacts are looked for, and its step, s."""
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


@dataclass(frozen=True, eq=False)
class ReplayExpert:
    """An agent that reads the boxes of its observation, which are true in a simulator."""

    drive: LoggedDrive

    def act(self, observation: Clip) -> Trajectory:
        """Return the best plan, for a batch of one.

        Raises:
            InputError: the observation has no boxes.
        """
        clip = observation[0]
        if not bool(clip.boxes_valid[-1]):
            raise InputError("the expert needs the true boxes of the road users")
        T_world_ego, users = clip.T_world_ego[-1].numpy(), _users(clip.boxes[clip.now])
        speed_mps, path = float(clip.ego_speed_mps[-1]), self.drive.path_ahead(T_world_ego)
        cruise_mps = max(MIN_CRUISE_MPS, self._logged_mps(T_world_ego))
        plans = [
            _plan(path, speed_mps, cruise_mps, acceleration, aside_m)
            for acceleration, aside_m in itertools.product(ACCELERATIONS_MPS2, ASIDE_M)
        ]
        best = max(plans, key=lambda plan: plan.rank(users))
        every = round(FRAME_DT_S / LOOK_DT_S)
        xy = best.xy_m[every - 1 :: every][:HORIZON_STEPS]
        return plan_of(torch.from_numpy(xy).float()[None, None])

    def _logged_mps(self, T_world_ego: Float64[np.ndarray, "4 4"]) -> float:
        """Return the speed of the log at its pose that is nearest to the vehicle, m/s."""
        away_m = np.hypot(*(self.drive.poses[:, :2, 3] - T_world_ego[:2, 3]).T)
        return self.drive.state_at(float(self.drive.vehicle.t_s[int(np.argmin(away_m))])).speed_mps


@dataclass(frozen=True, eq=False)
class _Plan:
    """A plan in the ego frame at steps of `LOOK_DT_S`."""

    xy_m: Float64[np.ndarray, "T 2"]
    """Rear axle."""
    yaw_rad: Float64[np.ndarray, "T"]
    speed_mps: Float64[np.ndarray, "T"]
    driven_m: float
    aside_m: float

    def rank(self, users: RoadUsers) -> tuple[bool, float]:
        """Return whether nobody is touched, and a value that grows with the plan's worth."""
        half_lw = 0.5 * np.array([EGO.length_m, EGO.width_m]) + MARGIN_M
        for step, (xy, yaw) in enumerate(zip(self.xy_m, self.yaw_rad.tolist(), strict=True)):
            after_s = LOOK_DT_S * (step + 1)
            moved = users.foot_m.copy()
            moved[:, :2] += after_s * users.velocity_mps
            forward = np.array([math.cos(yaw), math.sin(yaw)])
            foot = np.append(xy + EGO.axle_to_centre_m * forward, 0.0)
            hit = touched(Box(foot, yaw, half_lw), users._replace(foot_m=moved))
            if hit.any():
                against = self.speed_mps[step] * forward - users.velocity_mps[hit]
                return False, -float(np.linalg.norm(against, axis=1).max())
        return True, self.driven_m - SWERVES_PER_M * abs(self.aside_m)


def _plan(
    path: Float64[np.ndarray, "N 2"],
    speed_mps: float,
    cruise_mps: float,
    acceleration_mps2: float,
    aside_m: float,
) -> _Plan:
    times = LOOK_DT_S * np.arange(1, round(LOOK_S / LOOK_DT_S) + 1)
    highest = max(cruise_mps, speed_mps) if acceleration_mps2 > 0 else speed_mps
    speeds = np.clip(speed_mps + acceleration_mps2 * times, 0.0, highest)
    before = np.concatenate([[speed_mps], speeds[:-1]])
    way_m = np.cumsum(0.5 * (before + speeds) * LOOK_DT_S)
    arc_m = arc_lengths(path)
    ahead = points_at(path, arc_m, way_m + 0.5) - points_at(path, arc_m, way_m)
    headings = np.arctan2(ahead[:, 1], ahead[:, 0])
    starts_m = float(path[0] @ [-math.sin(headings[0]), math.cos(headings[0])])  # path left of the vehicle
    share = np.minimum(way_m / max(SHIFT_M, 1.5 * speed_mps), 1.0)
    smooth = share * share * (3 - 2 * share)
    left_m = -starts_m + smooth * (aside_m + starts_m)
    left = np.stack([-np.sin(headings), np.cos(headings)], axis=1)
    xy = points_at(path, arc_m, way_m) + left_m[:, None] * left
    steps = np.diff(np.vstack([np.zeros(2), xy]), axis=0)
    moves = np.hypot(*steps.T) > 0.05
    yaw = np.where(moves, np.arctan2(steps[:, 1], steps[:, 0]), headings)
    return _Plan(xy, yaw, speeds, float(way_m[-1]), aside_m)


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
