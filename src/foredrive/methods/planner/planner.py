"""The temporal attention planner (NeMo §3.3, eq. 12–14)."""

import copy
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from foredrive.geometry.precision import full_precision
from foredrive.heads.few_queries import FewQueriesDecoderLayer
from foredrive.heads.heads import TaskHeadsConfig
from foredrive.heads.scene_tokens import Attended, SceneTokens
from foredrive.methods.planner.ego_mlp import EgoMLP, EgoMLPConfig, status_vector
from foredrive.methods.planner.path_correction import (
    PathCorrection,
    PathCorrectionConfig,
    headings,
    set_to_zero,
)
from foredrive.scene import Command, Trajectory, VoxelSpec

SHORTEST_M, LONGEST_M = 4.0, 200.0
"""Wavelengths of the initial places of rows and columns, m."""


@dataclass(frozen=True, kw_only=True)
class PlannerConfig:
    """Sizes and inputs of a `VolumePlanner`."""

    width: int
    """C (256 in the paper)."""
    layers: int
    """Layers of the decoder (3 in the paper)."""
    heads: int
    """Attention heads of the decoder."""
    pool: tuple[int, int, int]
    """Block of voxels (z, y, x) that shares a key and a value in the attention within the future volume."""
    future: Literal["attention", "concatenation", "none"] = "attention"
    """Combination of the predicted next volume with the present one."""
    history: int = 0
    """Number of key frames before now whose pose and speed enter the query. In the paper only the speed at
    now does, which does not reveal braking."""
    target: bool = False
    """Add the target point of the route (20 m ahead) to the query, as agents on CARLA's leaderboards
    do. The paper uses only the command."""
    ego_mlp: EgoMLPConfig | None = None
    """MLP whose plan is corrected, fitted to the demonstrations before fine-tuning; None corrects the plan
    that goes straight on at the present speed."""
    attends: tuple[Attended, ...] = ()
    """Outputs of the task heads that the decoder attends to beside the plane, as in VAD and UniAD."""
    path: PathCorrectionConfig | None = None
    """Also sample the volume along the initial plan. Not in the paper."""
    feed_forward: float = 2.0
    """Hidden width of the feed-forward networks of the decoder, as a multiple of C."""
    dropout: float = 0.0
    """Dropout of the decoder. It has one query: whatever is dropped is missing from the whole plan, and with
    0.1 it finds a cell of the plane several times less exactly."""
    final_norm: bool = False
    """Normalise the output of the decoder, as pre-norm decoders do. What depends on the scene is small beside
    the learned query at first, and this makes it smaller: with it, rates of 0.003 learn nothing."""
    speed_scale_mps: float = 10.0
    """Scale by which speeds are divided, m/s."""
    past_scale_m: float = 5.0
    """Scale by which past positions are divided, m."""
    target_scale_m: float = 20.0
    """Scale by which the target point is divided, m."""
    step_scale_m: float = 1.0
    """Length of a step for an output of 1, m. With outputs of order 1, the last layer does not have to grow
    first."""


def sinusoidal_places(count: int, step_m: float, width: int) -> Float[Tensor, "N C"]:
    """Return sines and cosines of equidistant positions with a root mean square of 1.

    The features of a plane are normalised to the same size: places of 0.02 would be lost beside them. Most
    waves, of `SHORTEST_M` to `LONGEST_M`, are longer than several cells, so attention that prefers a place
    prefers its surroundings too.
    """
    position_m = step_m * (np.arange(count) - 0.5 * (count - 1))
    length_m = np.geomspace(LONGEST_M, SHORTEST_M, (width + 1) // 2)
    phase = 2 * np.pi * position_m[:, None] / length_m
    places = math.sqrt(2) * np.concatenate([np.sin(phase), np.cos(phase)], axis=-1)[:, :width]
    return torch.tensor(places, dtype=torch.float32)


class FutureAttention(nn.Module):
    """Self-attention within the predicted future volume, multiplied onto the present one (eq. 13).

    Q, K and V all come from V̂_{t+1}. Full attention is too large: 640,000² pairs at the size of the paper,
    which does not discuss it. So keys and values are averaged over blocks of `pool` voxels, as in
    spatial-reduction attention (Wang et al. 2021). `pool=(1, 1, 1)` is exactly eq. 13.

    Args:
        channels: D.
        pool: block of voxels (z, y, x) that shares one key and value.
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
        """Return V_F = A ⊙ V_t."""
        # Keys and values are block means, so the attention is V/pool times smaller than over all pairs
        blocks = F.avg_pool3d(future, self.pool).flatten(2).transpose(1, 2)  # [b, blocks, D]
        tokens = future.flatten(2).transpose(1, 2)  # [b, Z·Y·X, D]
        one_head = (x[:, None] for x in (self.query(tokens), self.key(blocks), self.value(blocks)))
        # The fused attention never stores the matrix of all pairs
        attended = F.scaled_dot_product_attention(*one_head)[:, 0]  # else all pairs would be stored
        # The attended features scale the present volume elementwise (A ⊙ V_t)
        return attended.transpose(1, 2).unflatten(2, now.shape[2:]) * now


class VolumePlanner(nn.Module):
    """A planner of waypoints from the present volume and, unless `future` is "none", the predicted next one.

    The two volumes are combined by attention (eq. 13) or concatenation, or only the present one is used:
    three rows of NeMo's Table 1. Height is folded into the channels, Z·D → C, by an MLP. One query (command,
    speed and a learned planning embedding, fused) attends to the plane through a transformer decoder. An MLP
    regresses the differences between the steps of the plan and those of an initial plan, and the steps are
    summed up. The initial plan goes straight on at the present speed, or is the output of `ego_mlp`.

    Args:
        config: sizes and inputs.
        spec: grid of the volumes.
        channels: D.
        horizon_steps: steps of the plan.
        dt_s: time step of the plan, s.
        heads: sizes of the task heads, if the planner attends to what they find.

    Raises:
        InputError: the planner attends to what no head finds, or scores plans without a target point.
    """

    def __init__(
        self,
        config: PlannerConfig,
        spec: VoxelSpec,
        *,
        channels: int,
        horizon_steps: int,
        dt_s: float,
        heads: TaskHeadsConfig | None = None,
    ) -> None:
        super().__init__()
        height, ny, nx = spec.shape_zyx
        width, self.config = config.width, config
        self.horizon_steps, self.dt_s = horizon_steps, dt_s
        self.history, self.target = config.history, config.target
        self.ego_mlp: EgoMLP | None = None
        if config.ego_mlp is not None:
            self.ego_mlp = EgoMLP(
                config.ego_mlp,
                past_frames=config.history,
                horizon_steps=horizon_steps,
                dt_s=dt_s,
                target=config.target,
            )
        attends = config.future == "attention"
        self.fuse_future = FutureAttention(channels, config.pool) if attends else None
        volumes = 2 if config.future == "concatenation" else 1
        # The fold maps a column of Z · D numbers (twice that with both volumes) to C
        self.fold = nn.Sequential(
            nn.Linear(height * channels * volumes, width),
            nn.ReLU(),
            nn.Linear(width, width),
            nn.LayerNorm(width),
        )
        # Learned place of each row and column, since attention itself knows no positions
        row, column = (sinusoidal_places(count, spec.voxel_m, width // 2) for count in (ny, nx))
        self.row = nn.Parameter(F.pad(row, (0, width - width // 2))[:, None])
        self.column = nn.Parameter(F.pad(column, (width - width // 2, 0))[None])
        self.command = nn.Embedding(len(Command) + 1, width)  # the last entry: unknown command
        # Speed and its flag, 4 numbers per past frame, and x, y and flag of the target
        inputs = 2 + 4 * config.history + 3 * config.target
        self.speed = nn.Sequential(nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width))
        self.plan = nn.Parameter(0.02 * torch.randn(width))
        self.fuse_query = nn.Sequential(nn.Linear(3 * width, width), nn.ReLU(), nn.Linear(width, width))
        self._build_regression(config, horizon_steps)
        status = 0 if self.ego_mlp is None else len(self.ego_mlp.status_mean)
        self.path: PathCorrection | None = None
        if config.path is not None:
            self.path = PathCorrection(
                config.path, spec, channels=channels, status=status, steps=horizon_steps
            )
        self.scene: SceneTokens | None = None
        if config.attends:  # built last, so that the other weights start as without it
            self.scene = SceneTokens(config.attends, heads, spec, width)

    def _build_regression(self, config: PlannerConfig, horizon_steps: int) -> None:
        """Build the decoder of one query and the MLP of waypoints."""
        width = config.width
        # Pre-norm keeps a direct path for speed and command, which determine most of a plan.
        layer = FewQueriesDecoderLayer(
            width, config.heads, round(config.feed_forward * width), config.dropout
        )
        self.decoder = nn.ModuleList([copy.deepcopy(layer) for _ in range(config.layers)])  # as in torch
        self.final_norm = nn.LayerNorm(width) if config.final_norm else nn.Identity()
        # Without the norm, the learned query turns most rectifiers off for all scenes; leaky ones recover
        bend = nn.ReLU() if config.final_norm else nn.LeakyReLU(0.1)
        self.waypoints = nn.Sequential(nn.Linear(width, width), bend, nn.Linear(width, 2 * horizon_steps))
        if self.ego_mlp is not None:  # the MLP's plan is good already: start from no correction
            set_to_zero(self.waypoints[-1])

    @property
    def imagined_frames(self) -> int:
        """Number of key frames that have to be imagined for a plan."""
        return 0 if self.config.future == "none" else 1

    def forward(
        self,
        now: Float[Tensor, "b D Z Y X"],
        future: Float[Tensor, "b D Z Y X"] | None,
        command: Int[Tensor, "b"],
        command_valid: Bool[Tensor, "b"],
        speed_mps: Float[Tensor, "b"],
        speed_valid: Bool[Tensor, "b"],
        past: Float[Tensor, "b P 4"],
        target: Float[Tensor, "b 3"] | None = None,
        tokens: Float[Tensor, "b _N C"] | None = None,
    ) -> Trajectory:
        """Plan in the ego frame at now.

        Args:
            now, future: volumes at now and, if it is used, at the next key frame.
            command, command_valid: at now.
            speed_mps, speed_valid: speed at now, and whether it was measured and not estimated from poses. An
                estimate is enough to begin with; the query is told that the speed is unknown.
            past: x, y (m), yaw (rad) in the ego frame at now and speed (m/s) of the last `history` frames.
            target: see `route_target`; required if the config's `target` is set.
            tokens: output of `scene`; required if the config's `attends` is not empty.
        """
        plane, query = self._read(
            now, future, command, command_valid, speed_mps, speed_valid, past, target, tokens
        )
        # The decoder attends to every cell of the plane, and to the tokens of agents and map elements
        memory = plane.flatten(1, 2)
        if tokens is not None and self.scene is not None:
            memory = torch.cat([memory, tokens.to(memory)], dim=1)
        initial_xy, ego_status = self.initial_plan(command, command_valid, speed_mps, past, target)
        # The plan has one query; each layer refines it
        query = query[:, None]
        for layer in self.decoder:
            query = layer(query, memory)
        # Waypoints are regressed as changes of the steps between them, in 32 bits
        change = self.waypoints(self.final_norm(query[:, 0])).float().unflatten(1, (self.horizon_steps, 2))
        change = self.config.step_scale_m * change
        if self.path is not None:
            change = change + self.path(self.path.sample(now, initial_xy), ego_status)
        # Changes of steps are summed to positions, so a change of one step shifts all later waypoints
        xy = (initial_xy + change.cumsum(dim=1))[:, None]
        return Trajectory(
            xy=xy,
            yaw=headings(xy),
            valid=torch.ones_like(xy[..., 0], dtype=torch.bool),
            log_prob=torch.zeros_like(xy[..., 0, 0]),
            dt_s=self.dt_s,
        )

    def _read(
        self,
        now: Float[Tensor, "b D Z Y X"],
        future: Float[Tensor, "b D Z Y X"] | None,
        command: Int[Tensor, "b"],
        command_valid: Bool[Tensor, "b"],
        speed_mps: Float[Tensor, "b"],
        speed_valid: Bool[Tensor, "b"],
        past: Float[Tensor, "b P 4"],
        target: Float[Tensor, "b 3"] | None,
        tokens: Float[Tensor, "b _N C"] | None,
    ) -> tuple[Float[Tensor, "b Y X C"], Float[Tensor, "b C"]]:
        """Return the plane of the fused volumes, and the query of what the planner is told."""
        if self.scene is not None and tokens is None:
            raise ValueError("this planner needs tokens of agents or map elements")
        if self.target and target is None:
            raise ValueError("this planner needs the target point of the route")
        fused = self._fuse(now, future)
        # Fold the heights of each column and add its place
        plane = self.fold(fused.permute(0, 3, 4, 2, 1).flatten(3)) + self.row + self.column
        # An unknown command has an embedding of its own
        command = torch.where(command_valid, command, len(Command))
        sizes = self.config
        # An estimated speed is hidden from the query; only the initial plan uses it
        measured_mps = torch.where(speed_valid, speed_mps, 0.0)
        status = torch.stack([measured_mps / sizes.speed_scale_mps, speed_valid.to(speed_mps)], dim=-1)
        # Scales bring metres, radians and m/s to numbers of order 1; yaw is kept
        past_scale = past.new_tensor((sizes.past_scale_m, sizes.past_scale_m, 1.0, sizes.speed_scale_mps))
        status = torch.cat([status, (past / past_scale).flatten(1)], dim=-1)
        if self.target and target is not None:
            target_scale = target.new_tensor((sizes.target_scale_m, sizes.target_scale_m, 1.0))
            status = torch.cat([status, target / target_scale], dim=-1)
        # Three embeddings side by side: command, ego status, learned planning query
        query = torch.cat(
            [self.command(command), self.speed(status), self.plan.expand(len(command), -1)], dim=-1
        )
        return plane, self.fuse_query(query)

    @torch.no_grad()
    def initial_plan(
        self,
        command: Int[Tensor, "b"],
        command_valid: Bool[Tensor, "b"],
        speed_mps: Float[Tensor, "b"],
        past: Float[Tensor, "b P 4"],
        target: Float[Tensor, "b 3"] | None = None,
    ) -> tuple[Float[Tensor, "b T 2"], Float[Tensor, "b _S"]]:
        """Return the initial plan and the standardised ego status (no columns without an ego MLP)."""
        if self.target and target is None:
            raise ValueError("this planner needs the target point of the route")
        if self.ego_mlp is None:
            # Straight ahead at constant speed: the same step T times
            step = torch.stack([self.dt_s * speed_mps, torch.zeros_like(speed_mps)], dim=-1)
            return step[:, None].expand(-1, self.horizon_steps, 2).cumsum(dim=1), step[:, :0]
        speeds_mps = torch.cat([past[..., 3], speed_mps[:, None]], dim=-1)
        # 32 bits also under automatic mixed precision: the plan is in metres
        with full_precision(past, speeds_mps) as (poses, speeds):
            target = target if self.target else None
            status = status_vector(
                poses[..., :3], speeds, command, command_valid, target, rates=self.ego_mlp.rates
            )
            return self.ego_mlp(status)[..., :2], self.ego_mlp.standardised(status)

    def _fuse(
        self, now: Float[Tensor, "b D Z Y X"], future: Float[Tensor, "b D Z Y X"] | None
    ) -> Float[Tensor, "b _D Z Y X"]:
        if self.config.future == "none":
            return now
        if future is None:
            raise ValueError("this planner needs the next volume too")
        return torch.cat([now, future], 1) if self.fuse_future is None else self.fuse_future(now, future)


def set_planner_trainable(planner: VolumePlanner, trainable: bool) -> None:
    """Enable or disable the training of a planner. Its ego MLP is never trained here."""
    planner.requires_grad_(trainable)
    if planner.ego_mlp is not None:
        planner.ego_mlp.requires_grad_(False)
