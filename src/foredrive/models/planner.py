"""The temporal attention planner (NeMo §3.3, eq. 12–14)."""

from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from foredrive.scene import Command, Trajectory

SPEED_SCALE_MPS = 10.0
MOVES_M = 0.1
PAST_SCALE = (5.0, 5.0, 1.0, SPEED_SCALE_MPS)
STEP_SCALE_M = 1.0
"""What an output of 1 stands for: with steps of this order the last layer need not grow first."""


class FutureAttention(nn.Module):
    """Self-attention within the predicted future volume, multiplied onto the present one (eq. 13).

    Q, K and V all come from V̂_{t+1}. Every voxel attending to every other is out of reach (640,000² pairs at
    the paper's size, about which it is silent), so keys and values are averaged over blocks of `pool` voxels,
    as in spatial-reduction attention (Wang et al. 2021); `pool=(1, 1, 1)` is eq. 13 to the letter.

    Args:
        channels: D.
        pool: block of voxels (z, y, x) that share one key and value.
    """

    def __init__(self, channels: int, pool: tuple[int, int, int]) -> None:
        super().__init__()
        self.pool = pool
        self.query = nn.Linear(channels, channels)
        self.key = nn.Linear(channels, channels)
        self.value = nn.Linear(channels, channels)

    def forward(
        self, now: Float[Tensor, "b D Z Y X"], future: Float[Tensor, "b D Z Y X"]
    ) -> Float[Tensor, "b D Z Y X"]:
        """V_F = A ⊙ V_t."""
        blocks = F.avg_pool3d(future, self.pool).flatten(2).transpose(1, 2)  # [b, blocks, D]
        tokens = future.flatten(2).transpose(1, 2)  # [b, Z·Y·X, D]
        one_head = (x[:, None] for x in (self.query(tokens), self.key(blocks), self.value(blocks)))
        attended = F.scaled_dot_product_attention(*one_head)[:, 0]  # without a head it would hold all pairs
        return attended.transpose(1, 2).unflatten(2, now.shape[2:]) * now


class VolumePlanner(nn.Module):
    """Waypoints from the present volume and, unless `future` is "none", the one predicted next.

    The two are put together by attention (eq. 13), or by concatenation, or only the present is looked at:
    three rows of NeMo's Table 1. Height is folded into the channels, Z·D → C by an MLP; one query (command,
    speed and a learned planning embedding, fused) attends to the plane through a transformer decoder; an MLP
    regresses by how much the steps between waypoints differ from going straight on at this speed, and they
    are summed up.

    Args:
        channels: D.
        shape_zyx: of the volumes.
        width: C (256 in the paper).
        layers, heads: of the decoder (3 layers in the paper).
        future: what becomes of the predicted volume.
        pool: blocks of the future attention.
        history: how many key frames before now the query knows pose and speed of; in the paper it knows the
            speed at now alone, from which nobody can tell who brakes.
        horizon_steps, dt_s: of the plan.
    """

    def __init__(
        self,
        *,
        channels: int,
        shape_zyx: tuple[int, int, int],
        width: int,
        layers: int,
        heads: int,
        future: Literal["attention", "concatenation", "none"],
        pool: tuple[int, int, int],
        history: int,
        horizon_steps: int,
        dt_s: float,
    ) -> None:
        super().__init__()
        height, ny, nx = shape_zyx
        self.horizon_steps, self.dt_s = horizon_steps, dt_s
        self.future, self.history = future, history
        self.fuse_future = FutureAttention(channels, pool) if future == "attention" else None
        volumes = 2 if future == "concatenation" else 1
        self.fold = nn.Sequential(
            nn.Linear(height * channels * volumes, width),
            nn.ReLU(),
            nn.Linear(width, width),
            nn.LayerNorm(width),
        )
        self.row = nn.Parameter(0.02 * torch.randn(ny, 1, width))
        self.column = nn.Parameter(0.02 * torch.randn(1, nx, width))
        self.command = nn.Embedding(len(Command) + 1, width)  # the last one: not known
        self.speed = nn.Sequential(nn.Linear(2 + 4 * history, width), nn.ReLU(), nn.Linear(width, width))
        self.plan = nn.Parameter(0.02 * torch.randn(width))
        self.fuse_query = nn.Sequential(nn.Linear(3 * width, width), nn.ReLU(), nn.Linear(width, width))
        # Normalising first keeps an open path for speed and command, which most of a plan follows from.
        layer = nn.TransformerDecoderLayer(
            width, heads, 2 * width, dropout=0.1, batch_first=True, norm_first=True
        )
        self.decoder = nn.TransformerDecoder(layer, layers)
        self.waypoints = nn.Sequential(
            nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 2 * horizon_steps)
        )

    @property
    def looks_ahead(self) -> int:
        """How many key frames have to be imagined for a plan."""
        return 0 if self.future == "none" else 1

    def forward(
        self,
        now: Float[Tensor, "b D Z Y X"],
        future: Float[Tensor, "b D Z Y X"] | None,
        command: Int[Tensor, "b"],
        command_valid: Bool[Tensor, "b"],
        speed_mps: Float[Tensor, "b"],
        speed_valid: Bool[Tensor, "b"],
        past: Float[Tensor, "b P 4"],
    ) -> Trajectory:
        """Plan in the ego frame at now.

        Args:
            now, future: volumes at now and at the next key frame, if it is looked at.
            command, command_valid, speed_mps, speed_valid: of now.
            past: x, y (m), yaw (rad) in the ego frame at now and speed (m/s) of the last `history` frames.
        """
        fused = self._fuse(now, future)
        plane = self.fold(fused.permute(0, 3, 4, 2, 1).flatten(3))  # [b, Y, X, C]
        memory = (plane + self.row + self.column).flatten(1, 2)
        command = torch.where(command_valid, command, len(Command))
        speed_mps = torch.where(speed_valid, speed_mps, 0.0)
        status = torch.stack([speed_mps / SPEED_SCALE_MPS, speed_valid.to(speed_mps)], dim=-1)
        status = torch.cat([status, (past / past.new_tensor(PAST_SCALE)).flatten(1)], dim=-1)
        query = torch.cat(
            [self.command(command), self.speed(status), self.plan.expand(len(command), -1)], dim=-1
        )
        decoded = self.decoder(self.fuse_query(query)[:, None], memory)[:, 0]
        change = STEP_SCALE_M * self.waypoints(decoded).float().view(len(command), 1, self.horizon_steps, 2)
        straight_on = torch.stack([self.dt_s * speed_mps, torch.zeros_like(speed_mps)], dim=-1)
        xy = (straight_on[:, None, None] + change).cumsum(dim=2)
        return Trajectory(
            xy=xy,
            yaw=_headings(xy),
            valid=torch.ones_like(xy[..., 0], dtype=torch.bool),
            log_prob=torch.zeros_like(xy[..., 0, 0]),
            dt_s=self.dt_s,
        )

    def _fuse(
        self, now: Float[Tensor, "b D Z Y X"], future: Float[Tensor, "b D Z Y X"] | None
    ) -> Float[Tensor, "b _D Z Y X"]:
        if self.future == "none":
            return now
        if future is None:
            raise ValueError("this planner looks at the next volume too")
        return torch.cat([now, future], 1) if self.fuse_future is None else self.fuse_future(now, future)


def _headings(xy: Float[Tensor, "b M T 2"]) -> Float[Tensor, "b M T"]:
    """Headings along a path from the origin; where it hardly moves, the heading it had before."""
    with torch.no_grad():
        step = torch.diff(xy, dim=2, prepend=torch.zeros_like(xy[:, :, :1]))
        along = torch.atan2(step[..., 1], step[..., 0])
        moves = step.norm(dim=-1) > MOVES_M
        count = torch.arange(1, xy.shape[2] + 1, device=xy.device)
        last_move = torch.where(moves, count, 0).cummax(dim=2).values  # 0: has not moved yet
        return torch.cat([torch.zeros_like(along[..., :1]), along], dim=2).gather(2, last_move)
