"""A planner that sees only the status of the ego vehicle."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from foredrive.errors import InputError
from foredrive.geometry.se3 import compose_se3, inverse_se3, yaw_from_matrix
from foredrive.scene import Clip, Command, Trajectory
from foredrive.scene.clip import TARGET

CURVED_M = 0.3
"""Least length of a step that has a curvature, m."""


def ego_speeds(clip: Clip) -> Float[Tensor, "b T"]:
    """Return the speeds at all key frames, m/s. Unknown ones follow from the pose before (at first, after).

    A clip of one key frame has no other pose: there an unknown speed is 0.
    """
    if clip.t_s.shape[1] == 1:
        return torch.where(clip.ego_speed_valid, clip.ego_speed_mps, 0.0)
    travelled_m = clip.T_world_ego[..., :3, 3].diff(dim=1).norm(dim=-1)
    between = (travelled_m / clip.t_s.diff(dim=1)).to(clip.ego_speed_mps)
    # The first key frame has no earlier pose and takes the speed of the interval after it
    return torch.where(clip.ego_speed_valid, clip.ego_speed_mps, torch.cat([between[:, :1], between], dim=1))


def ego_motion(clip: Clip, past_frames: int) -> tuple[Float[Tensor, "b P 3"], Float[Tensor, "b P+1"]]:
    """Return past poses and speeds of the ego vehicle.

    Returns:
        x, y (m) and yaw (rad) of the last P = `past_frames` key frames in the ego frame at now; speed at
        these frames and at now (see `ego_speeds`).

    Raises:
        InputError: the clip has fewer frames.
    """
    now = clip.now
    if now < past_frames:
        raise InputError(f"the ego status needs {past_frames} frames before now, but the clip has {now}")
    frames = slice(now - past_frames, now + 1)
    # Poses relative to the ego frame at now, computed in the precision of the world poses (float64)
    T_now_ego = compose_se3(inverse_se3(clip.T_world_ego[:, now : now + 1]), clip.T_world_ego[:, frames])
    # The last pose is the identity and is left out
    poses = torch.cat([T_now_ego[..., :2, 3], yaw_from_matrix(T_now_ego)[..., None]], dim=-1)[:, :-1]
    return poses.float(), ego_speeds(clip.observed())[:, frames]


def ego_status(
    clip: Clip, past_frames: int, *, target: bool = False, rates: bool = False
) -> Float[Tensor, "b S"]:
    """Return the ego status at now: `ego_motion` and the command as one-hot (zeros where unknown).

    Args:
        target: append `route_target`.
        rates: append `motion_rates`.
    """
    poses, speeds = ego_motion(clip, past_frames)
    target_xy1 = route_target(clip) if target else None
    return status_vector(poses, speeds, clip.command, clip.command_valid, target_xy1, rates=rates)


def route_target(clip: Clip) -> Float[Tensor, "b 3"]:
    """Return the route point 20 m ahead, or the route's end: x, y (m) and 1; zeros without a route."""
    given = clip.route_valid.any(-1, keepdim=True)
    target_xy = clip.route_xy[:, TARGET]
    return torch.cat([torch.where(given, target_xy, 0.0), given.to(target_xy)], dim=-1)


def status_vector(
    poses: Float[Tensor, "b P 3"],
    speeds: Float[Tensor, "b P+1"],
    command: Int[Tensor, "b"],
    command_valid: Bool[Tensor, "b"],
    target: Float[Tensor, "b 3"] | None = None,
    *,
    rates: bool = False,
) -> Float[Tensor, "b S"]:
    """Return the numbers of `ego_status` in order: `route_target` and `motion_rates` come last, if any."""
    # An unknown command is all zeros
    one_hot = nn.functional.one_hot(command.long(), len(Command)) * command_valid[:, None]
    columns = [poses.flatten(1), speeds, one_hot.to(speeds)]
    columns += [] if target is None else [target.to(speeds)]
    return torch.cat(columns + ([motion_rates(poses, speeds)] if rates else []), dim=-1)


def motion_rates(poses: Float[Tensor, "b P 3"], speeds: Float[Tensor, "b P+1"]) -> Float[Tensor, "b 2*P+4"]:
    """Return changes of speed and heading, and what braking and turning distances depend on.

    These are the change of speed (m/s) and of yaw (rad) from each key frame to the next, the curvature of the
    last step (1/m), the squared speed at now, and the speed times its last change and times the curvature.
    """
    faster_mps = speeds.diff(dim=1)
    # The pose at now is the identity
    yaw = torch.cat([poses[..., 2], torch.zeros_like(speeds[:, :1])], dim=1)
    travelled_m = poses[:, -1, :2].norm(dim=-1)
    turned = yaw.diff(dim=1)
    # The curve of a step that hardly moves is noise
    curvature = torch.where(travelled_m > CURVED_M, turned[:, -1] / travelled_m.clamp_min(CURVED_M), 0.0)
    now_mps = speeds[:, -1]
    products = torch.stack(
        [curvature, now_mps.square(), now_mps * faster_mps[:, -1], now_mps * curvature], dim=-1
    )
    return torch.cat([faster_mps, turned, products], dim=-1)


@dataclass(frozen=True)
class EgoMLPConfig:
    """Sizes of an `EgoMLP`."""

    hidden: int = 512
    """Width of both hidden layers (512 in the paper)."""
    rates: bool = False
    """Also read `motion_rates`, if there are frames before now. They follow from poses and speeds, but those
    are nearly collinear: without the rates the perceptron needs many more steps to use them."""


class EgoMLP(nn.Module):
    """An `Agent` that maps ego status to waypoints by a three-layer perceptron ("AD-MLP", Zhai et al. 2023).

    It cannot see the surroundings, so its score shows what a protocol reveals without them. Inputs and
    outputs are standardised by the mean and spread of the training set, which are part of the weights.

    Args:
        config: sizes.
        past_frames: number of key frames before now that it reads (4 in the paper).
        horizon_steps: steps of the plan.
        dt_s: time step of the plan, s.
        target: also read the target point of the route (not in the paper).
    """

    status_mean: Tensor
    status_std: Tensor
    plan_mean: Tensor
    plan_std: Tensor

    def __init__(
        self,
        config: EgoMLPConfig,
        *,
        past_frames: int,
        horizon_steps: int,
        dt_s: float,
        target: bool = False,
    ) -> None:
        super().__init__()
        hidden, self.rates = config.hidden, config.rates and past_frames > 0
        self.past_frames, self.horizon_steps, self.dt_s = past_frames, horizon_steps, dt_s
        self.target = target
        inputs = 4 * past_frames + 1 + len(Command) + 3 * target + self.rates * (2 * past_frames + 4)
        outputs = 3 * horizon_steps
        self.layers = nn.Sequential(
            nn.Linear(inputs, hidden),
            nn.ReLU(),
            nn.Linear(hidden, hidden),
            nn.ReLU(),
            nn.Linear(hidden, outputs),
        )
        self.register_buffer("status_mean", torch.zeros(inputs))
        self.register_buffer("status_std", torch.ones(inputs))
        self.register_buffer("plan_mean", torch.zeros(outputs))
        self.register_buffer("plan_std", torch.ones(outputs))

    def forward(self, status: Float[Tensor, "b S"]) -> Float[Tensor, "b T 3"]:
        """Return x, y (m) and yaw (rad) of each step, in the ego frame at now."""
        # Inputs and outputs are standardised, so layers work on numbers of order 1
        plan = self.layers(self.standardised(status))
        return (plan * self.plan_std + self.plan_mean).unflatten(1, (self.horizon_steps, 3))

    def standardised(self, status: Float[Tensor, "b S"]) -> Float[Tensor, "b S"]:
        """Return the ego status in numbers of order 1."""
        return (status - self.status_mean) / self.status_std

    @torch.no_grad()
    def act(self, observation: Clip) -> Trajectory:
        """Return the plan from now on."""
        status = ego_status(observation, self.past_frames, target=self.target, rates=self.rates)
        plan = self(status)[:, None]  # [b, 1, T, 3]
        return Trajectory(
            xy=plan[..., :2],
            yaw=plan[..., 2],
            valid=torch.ones_like(plan[..., 0], dtype=torch.bool),
            log_prob=torch.zeros_like(plan[..., 0, 0]),
            dt_s=self.dt_s,
        )
