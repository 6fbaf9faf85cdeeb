"""NeuroNCAP's naive baseline on lidar: drive on along the path, and stop if something stands in its corridor.

Source: Ljungbergh et al., ECCV 2024, sec. 4.1, and `BaselineModelAPI` of the public repository
atonderski/neuro-ncap. There the objects are those that a planner detects, and the corridor is 5 m wide. Here
they are lidar returns, so that the agent needs no training. A corridor of 5 m holds the cars that are parked
beside a street, so this one is as wide as the vehicle and a margin.
"""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float64

from foredrive.driving.dynamics import EGO
from foredrive.driving.observation import FRAME_DT_S, HORIZON_STEPS
from foredrive.driving.replay.logged_drive import LoggedDrive
from foredrive.driving.simple_agents import plan_of
from foredrive.errors import InputError
from foredrive.geometry.polylines import arc_lengths, points_at
from foredrive.scene import Clip, LidarSweep, Trajectory

CORRIDOR_S = 2.0
"""Length of the corridor in time at the present speed, s."""
START_M = 2.0
"""Shortest corridor beyond the bumper, m."""
HALF_WIDTH_M = 0.5 * EGO.width_m + 0.3
HEIGHT_M = (0.4, 2.2)
"""Returns within these heights above the road count, m."""
FEWEST_RETURNS = 2
"""Single returns may be noise."""


@dataclass(eq=False)
class CorridorAgent:
    """An agent that sees lidar alone. It follows the logged path at its first speed until it has to stop.

    Once something was in the corridor, the corridor keeps its length, so that a slower vehicle still sees it.
    """

    drive: LoggedDrive
    _speed_mps: float | None = field(default=None, init=False)
    _fixed_m: float | None = field(default=None, init=False)

    def act(self, observation: Clip) -> Trajectory:
        """Return points on the path, all at the vehicle's place to stop, for a batch of one.

        Raises:
            InputError: there is no sweep.
        """
        clip = observation[0]
        if not bool(clip.sweep_valid[-1]):
            raise InputError("an agent that sees lidar alone needs a lidar")
        speed_mps = float(clip.ego_speed_mps[-1])
        self._speed_mps = speed_mps if self._speed_mps is None else self._speed_mps
        path = self.drive.path_ahead(clip.T_world_ego[-1].numpy())
        length_m = START_M + CORRIDOR_S * speed_mps if self._fixed_m is None else self._fixed_m
        if returns_in_corridor(clip.sweeps[clip.now], path, length_m) >= FEWEST_RETURNS:
            self._fixed_m = length_m
            return plan_of(torch.zeros(1, 1, HORIZON_STEPS, 2))
        ahead_m = self._speed_mps * FRAME_DT_S * np.arange(1, HORIZON_STEPS + 1)
        points = points_at(path, arc_lengths(path), ahead_m)
        return plan_of(torch.from_numpy(points).float()[None, None])


def returns_in_corridor(sweep: LidarSweep, path: Float64[np.ndarray, "N 2"], length_m: float) -> int:
    """Return the number of returns above the road in the corridor of a path in the ego frame.

    The corridor begins at the bumper.
    """
    points = sweep.points_ego[sweep.valid & sweep.returned].double().numpy()
    points = points[(points[:, 2] > HEIGHT_M[0]) & (points[:, 2] < HEIGHT_M[1])]
    bumper_m = EGO.axle_to_centre_m + 0.5 * EGO.length_m
    arc_m = arc_lengths(path)
    # Points every 0.25 m along the corridor, and the distance of each return from the nearest of them
    line = points_at(path, arc_m, np.arange(bumper_m, bumper_m + length_m, 0.25))
    away_m = np.linalg.norm(points[:, None, :2] - line, axis=2).min(axis=1, initial=np.inf)
    ahead = points[:, 0] > bumper_m
    return int(((away_m < HALF_WIDTH_M) & ahead).sum())
