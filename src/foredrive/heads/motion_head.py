"""Forecasts of road users: kinematic modes and learned corrections."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.heads.decoder import DecoderConfig, PlaceEmbedding, QueryDecoderLayer
from foredrive.heads.plane import Planes

FIRST_MODES = ((0.0, 0.0), (-1.5, 0.0), (1.0, 0.0), (0.0, 0.2), (0.0, -0.2), (-6.0, 0.0))
"""Initial acceleration (m/s²) and yaw rate (rad/s): steady, braking, starting, left, right, stopping."""
SLOW_MPS = 0.5
"""Below this speed, an agent moves along its heading instead of its measured velocity."""


@dataclass(frozen=True)
class MotionConfig:
    """Sizes of the forecast of each agent's motion."""

    modes: int = 6
    steps: int = 12
    dt_s: float = 0.5
    decoder: DecoderConfig = field(default_factory=lambda: DecoderConfig(layers=1))


class MotionModes(nn.Module):
    """Alternative motions of each agent: a kinematic mode plus a correction.

    A mode is a learned acceleration and yaw rate, the same for all agents; the first one begins as constant
    velocity. A query for each agent and mode attends to all others and to the plane, and corrects the motion
    along and across the heading, so that one mode means the same for agents of all headings. Positions,
    headings and velocities pass no gradient to the boxes.

    Args:
        width: channels of the queries.
        config: sizes.
    """

    def __init__(self, width: int, config: MotionConfig) -> None:
        super().__init__()
        self.config = config
        self.mode = nn.Parameter(torch.randn(config.modes, width))
        first = torch.tensor([FIRST_MODES[n % len(FIRST_MODES)] for n in range(config.modes)])
        self.acceleration_mps2 = nn.Parameter(first[:, 0].clone())
        self.yaw_rate_rps = nn.Parameter(first[:, 1].clone())
        self.speed = nn.Linear(3, width)
        self.layers = nn.ModuleList(
            QueryDecoderLayer(width, config.decoder) for _ in range(config.decoder.layers)
        )
        self.out = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 2 * config.steps + 1))
        final = self.out[-1]
        assert isinstance(final, nn.Linear)
        with torch.no_grad():  # start with the kinematic modes as they are
            final.weight *= 0.1
            final.bias.zero_()

    def forward(
        self,
        queries: Float[Tensor, "b Q W"],
        xy: Float[Tensor, "b Q 2"],
        heading: Float[Tensor, "b Q 2"],
        velocity: Float[Tensor, "b Q 2"],
        planes: Planes,
        place: PlaceEmbedding,
    ) -> tuple[Float[Tensor, "b Q M S 2"], Float[Tensor, "b Q M"]]:
        """Return the positions of each agent in each mode, m, and the log-probabilities of the modes.

        Args:
            queries: contents of the agents.
            xy: centres, m.
            heading: sine and cosine.
            velocity: m/s.
            planes: features of motion.
            place: embedding of positions.
        """
        config, plane = self.config, planes.coarse
        # Boxes and motion are trained apart
        xy, heading, velocity = xy.detach(), heading.detach(), velocity.detach()
        speed = velocity.norm(dim=-1, keepdim=True)
        # Speed and velocity in units of 10 m/s are part of the query
        queries = queries + self.speed(torch.cat([velocity, speed], dim=-1) / 10.0)
        # One query for each agent and mode
        modes = (queries[:, :, None] + self.mode).flatten(1, 2)
        anchors = place(plane.share(xy)).repeat_interleave(config.modes, dim=1)
        cell_place = place(plane.share(plane.middle_m))[None]
        for layer in self.layers:
            modes = layer(modes, anchors, plane.cells, cell_place)
        out = self.out(modes).unflatten(1, (queries.shape[1], config.modes))
        # Corrections of velocity, summed to corrections of position
        change = config.dt_s * out[..., :-1].unflatten(-1, (config.steps, 2)).cumsum(dim=-2)
        sin, cos = heading[:, :, None, None, 0], heading[:, :, None, None, 1]
        along, across = change.unbind(-1)
        # Along and across the heading to x and y
        corrected = torch.stack([cos * along - sin * across, sin * along + cos * across], dim=-1)
        moved = kinematic_motion(
            velocity, heading, self.acceleration_mps2, self.yaw_rate_rps, config.steps, config.dt_s
        )
        future_xy = xy[:, :, None, None] + moved + corrected
        # The last number of each mode is its logit
        return future_xy, out[..., -1].log_softmax(dim=-1)


def kinematic_motion(
    velocity: Float[Tensor, "*n 2"],
    heading: Float[Tensor, "*n 2"],
    acceleration_mps2: Float[Tensor, "M"],
    yaw_rate_rps: Float[Tensor, "M"],
    steps: int,
    dt_s: float,
) -> Float[Tensor, "*n M S 2"]:
    """Return how far agents have moved at each step at constant acceleration and yaw rate, m.

    Agents do not drive backwards: a braking agent stands once its speed is 0. Speed and direction are those
    in the middle of each step.

    Args:
        velocity: at the start, m/s.
        heading: sine and cosine, the direction of agents that hardly move.
        acceleration_mps2: of each mode.
        yaw_rate_rps: of each mode.
        steps: S.
        dt_s: length of a step, s.
    """
    speed = velocity.norm(dim=-1, keepdim=True)
    slow = speed < SLOW_MPS
    # Direction of motion: the velocity if there is enough of it, else the heading (cosine first)
    direction = torch.where(slow, heading.flip(-1), velocity / speed.clamp_min(SLOW_MPS))
    # Middle of each step, so that the sum is exact for linear speed
    t_s = dt_s * (torch.arange(steps, device=velocity.device) + 0.5)
    # Braking stops at speed 0
    at_mps = (speed[..., None] + acceleration_mps2[:, None] * t_s).clamp_min(0.0)  # [*n, M, S]
    turn = yaw_rate_rps[:, None] * t_s
    sin, cos = turn.sin(), turn.cos()
    x, y = direction[..., None, None, 0], direction[..., None, None, 1]
    # The direction turns at constant yaw rate
    step = torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1) * at_mps[..., None]
    return dt_s * step.cumsum(dim=-2)
