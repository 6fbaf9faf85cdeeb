"""Restart of imitation agents that stand still.

An agent that learns from recordings learns that a standing vehicle goes on standing, and drives begin at rest
(inertia in Codevilla et al. 2019, "Exploring the Limitations of Behavior Cloning"). TransFuser (Chitta et al.
2022) therefore lets a vehicle that has stood for long creep forward if its lidar sees no obstacle ahead. Here
the agent's own volume of what its cameras see takes the place of the lidar.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.driving.dynamics import EGO
from foredrive.driving.observation import FRAME_DT_S, HORIZON_STEPS
from foredrive.scene import Agent, Clip, Trajectory, VoxelSpec

STANDS_MPS, STAYS_M = 0.2, 1.0
"""A vehicle stands on purpose if it is slower than `STANDS_MPS` and plans to go no further than `STAYS_M`."""
AT_START_S, STUCK_S = 1.0, 20.0
"""Waiting times before a restart, s: before the vehicle has ever moved, and afterwards, when a red light
may be the reason for the stop."""
CREEPS_S, CREEPS_MPS, CREEPS_MPS2 = 2.0, 4.0, 1.5
FREE_M, FREE_HALF_WIDTH_M, FREE_HEIGHT_M = 6.0, 1.3, (0.3, 2.2)
"""Box ahead of the bumper that must be free."""


class RestartingAgent:
    """An `Agent` that wraps another agent and creeps forward if that has stood for long and the way is free.

    Args:
        agent: agent that drives; it observes a batch of one clip.
        clock: returns the time of the drive, s.
        is_free: returns whether the way is free in an observation. An agent that sees nothing has none: its
            way always counts as free.
    """

    def __init__(
        self, agent: Agent, clock: Callable[[], float], is_free: Callable[[Clip], bool] = lambda _: True
    ) -> None:
        self._agent, self._clock, self._is_free = agent, clock, is_free
        self._stands_since_s: float | None = None
        self._has_moved = False
        self._creeps_until_s = -1.0

    def act(self, observation: Clip) -> Trajectory:
        """Return the agent's plan, or a plan to creep forward."""
        plan, t_s = self._agent.act(observation), self._clock()
        speed_mps = float(observation.ego_speed_mps[0, observation.now])
        # Standing counts only if the plan does not want to go on either
        if speed_mps > STANDS_MPS or float(plan.xy[0, 0].norm(dim=-1).max()) > STAYS_M:
            self._stands_since_s = None
            self._has_moved |= speed_mps > STANDS_MPS
        elif self._stands_since_s is None:
            self._stands_since_s = t_s
        since_s = t_s if self._stands_since_s is None else self._stands_since_s
        patience_s = STUCK_S if self._has_moved else AT_START_S
        # Patience is short before the first movement and long afterwards
        if t_s - since_s >= patience_s:
            self._creeps_until_s, self._stands_since_s = t_s + CREEPS_S, None
        if t_s < self._creeps_until_s and self._is_free(observation):
            return _creeping(speed_mps).to(plan.xy.device)
        return plan


def is_free_ahead(occupancy_logit: Float[Tensor, "Z Y X"], spec: VoxelSpec) -> bool:
    """Return whether no voxel in the box ahead of the bumper is probably occupied.

    A volume that has no voxel there does not tell: the way is not free.
    """
    x, y, z = spec.centres_m().unbind(-1)
    bumper_m, half_m = EGO.axle_to_centre_m + 0.5 * EGO.length_m, 0.5 * spec.voxel_m
    # Voxels that reach into the box from its sides, and those whose middle is at its heights.
    inside = (x > bumper_m) & (x - half_m < bumper_m + FREE_M) & (y.abs() - half_m < FREE_HALF_WIDTH_M)
    inside &= (z > FREE_HEIGHT_M[0]) & (z < FREE_HEIGHT_M[1])
    inside = inside.to(occupancy_logit.device)
    return bool(inside.any()) and not bool((occupancy_logit[inside] > 0).any())


def _creeping(speed_mps: float) -> Trajectory:
    """Return a straight plan with gentle acceleration."""
    t_s = FRAME_DT_S * torch.arange(1, HORIZON_STEPS + 1)
    # Accelerate until `CREEPS_MPS`, then keep the speed
    gains_s = max(CREEPS_MPS - speed_mps, 0.0) / CREEPS_MPS2
    gained_s = t_s.clamp_max(gains_s)
    x = speed_mps * t_s + 0.5 * CREEPS_MPS2 * gained_s**2 + CREEPS_MPS2 * gained_s * (t_s - gained_s)
    xy = torch.stack([x, torch.zeros_like(x)], dim=-1)[None, None]
    flat = xy[..., 0]
    return Trajectory(
        xy=xy,
        yaw=torch.zeros_like(flat),
        valid=torch.ones_like(flat, dtype=torch.bool),
        log_prob=torch.zeros(1, 1),
        dt_s=FRAME_DT_S,
    )
