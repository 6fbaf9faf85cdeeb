"""A correction of plans from the features along them."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.geometry.precision import full_precision
from foredrive.ops.volume import sample_volume
from foredrive.scene import VoxelSpec

MOVES_M = 0.1
"""Minimum length of a step that has a heading of its own, m."""


@dataclass(frozen=True, kw_only=True)
class PathCorrectionConfig:
    """Sizes of a `PathCorrection`."""

    distances_m: tuple[float, ...]
    """Distances along the path, m. Beyond its end, the path continues straight."""
    lateral_m: tuple[float, ...] = (-3.0, 0.0, 3.0)
    """Lateral offsets that are sampled, m: on the path and in the lanes beside it."""
    width: int
    """Width of the hidden layers."""
    hidden: int
    """Channels kept for each distance."""
    dropout: float = 0.2
    """Dropout after the first layers."""
    place_scale_m: float = 20.0
    """Scale by which positions are divided, m."""


class PathSamples(NamedTuple):
    """Features of a volume along a plan, at D distances and S lateral offsets."""

    values: Float[Tensor, "b D S F"]
    """Columns of the volume at these places, F = Z·D features."""
    positions_m: Float[Tensor, "b D S 2"]
    """Positions in the ego frame, m."""


class PathCorrection(nn.Module):
    """A correction of a plan from the volume features along it.

    Columns of the volume are sampled at given distances on the path and beside it. The same inputs then mean
    the same place along the path whatever its curve, so braking for an obstacle in the lane is not learned
    anew for every cell of the plane. The columns can be stored, so that many thousand demonstrations train it
    in seconds (`path_fit.fit_path`). `bench planner-reads` measures how much they gain.

    Args:
        config: sizes.
        spec: grid of the volume.
        channels: channels of the volume.
        status: width of the ego status, an input because whether 20 m is near depends on the speed.
        steps: T, steps of the plan.
    """

    distances_m: Tensor
    lateral_m: Tensor
    lower_m: Tensor
    mean: Tensor
    std: Tensor

    def __init__(
        self, config: PathCorrectionConfig, spec: VoxelSpec, *, channels: int, status: int, steps: int
    ) -> None:
        super().__init__()
        self.voxel_m, self.place_scale_m = spec.voxel_m, config.place_scale_m
        self.register_buffer("distances_m", torch.tensor(config.distances_m), persistent=False)
        self.register_buffer("lateral_m", torch.tensor(config.lateral_m), persistent=False)
        self.register_buffer("lower_m", torch.tensor(spec.lower_m[:2]), persistent=False)
        features, width, hidden = spec.shape_zyx[0] * channels, config.width, config.hidden
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("std", torch.ones(features))
        self.place = nn.Sequential(
            nn.Linear(len(config.lateral_m) * (features + 2), width),
            nn.ReLU(),
            nn.Dropout(config.dropout),
            nn.Linear(width, hidden),
        )
        self.together = nn.Sequential(
            nn.Linear(len(config.distances_m) * hidden, width), nn.ReLU(), nn.Dropout(config.dropout)
        )
        self.change = nn.Sequential(
            nn.Linear(width + status, width),
            nn.ReLU(),
            nn.Linear(width, 2 * steps),
            nn.Unflatten(1, (steps, 2)),
        )
        set_to_zero(self.change[-2])

    def forward(self, samples: PathSamples, status: Float[Tensor, "b S"]) -> Float[Tensor, "b T 2"]:
        """Return corrections of the steps between waypoints, m.

        Args:
            samples: see `sample`.
            status: standardised ego status.
        """
        # Standardise by statistics of the training demonstrations (see `fit_path`)
        values = (samples.values.float() - self.mean) / self.std
        columns = torch.cat([values, samples.positions_m / self.place_scale_m], dim=-1).flatten(2)
        along = self.together(self.place(columns).flatten(1))
        # The effect of what is ahead depends on the speed, hence the ego status beside it
        return self.change(torch.cat([along, status], dim=-1)).float()

    def sample(self, volume: Float[Tensor, "b D Z Y X"], path_xy: Float[Tensor, "b T 2"]) -> PathSamples:
        """Sample the volume along a path from the origin of the ego frame through waypoints."""
        positions_m = self.positions_m(path_xy)
        columns = volume.permute(0, 3, 4, 2, 1).flatten(3).contiguous()
        with full_precision(columns, positions_m) as (values, at_m):
            # A plane is a volume of one layer, whose centre is at 0.5 in cell units
            cells = F.pad((at_m - self.lower_m) / self.voxel_m, (0, 1), value=0.5)
            samples = sample_volume(values[:, None], cells.flatten(1, 2)).unflatten(1, at_m.shape[1:3])
        return PathSamples(samples, positions_m)

    def positions_m(self, path_xy: Float[Tensor, "b T 2"]) -> Float[Tensor, "b D S 2"]:
        """Return the positions to sample: at every distance along the path, at S lateral offsets."""
        steps = torch.diff(path_xy, dim=1, prepend=torch.zeros_like(path_xy[:, :1]))
        lengths = steps.norm(dim=-1)[:, None]  # [b, 1, T]
        # Path length at the begin of each step
        begins = lengths.cumsum(-1) - lengths
        # Share of each step that is covered at a given distance: 1 for earlier steps, 0 for later ones
        share = ((self.distances_m[:, None] - begins) / lengths.clamp_min(1e-6)).clamp(0, 1)  # [b, D, T]
        beyond = (self.distances_m - lengths.sum(-1)).clamp_min(0)  # [b, D]
        # Headings are constant within a step; standing steps keep the heading before them
        yaw = headings(path_xy[:, None])[:, 0]
        forward = torch.stack([yaw.cos(), yaw.sin()], dim=-1)  # [b, T, 2]
        # Sum of the covered parts of the steps, plus a straight extension beyond the last waypoint
        on_path = share @ steps + beyond[..., None] * forward[:, -1:]
        step = (self.distances_m[:, None] >= begins).sum(-1) - 1  # [b, D]: index of the last step begun
        along = forward.gather(1, step[..., None].expand(-1, -1, 2))
        # Left normal of the path at each distance
        left = torch.stack([-along[..., 1], along[..., 0]], dim=-1)
        return on_path[:, :, None] + self.lateral_m[:, None] * left[:, :, None]


def set_to_zero(layer: nn.Module) -> None:
    """Set all parameters of a layer to zero: it starts as no change."""
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)


def headings(xy: Float[Tensor, "b M T 2"]) -> Float[Tensor, "b M T"]:
    """Return headings along a path from the origin. Where it hardly moves, the previous heading is kept."""
    with torch.no_grad():
        step = torch.diff(xy, dim=2, prepend=torch.zeros_like(xy[:, :, :1]))
        along = torch.atan2(step[..., 1], step[..., 0])
        moves = step.norm(dim=-1) > MOVES_M
        count = torch.arange(1, xy.shape[2] + 1, device=xy.device)
        # Index of the last step that moves, up to each step; 0 selects the prepended heading of 0
        last_move = torch.where(moves, count, 0).cummax(dim=2).values  # 0: has not moved yet
        return torch.cat([torch.zeros_like(along[..., :1]), along], dim=2).gather(2, last_move)
