"""Pillar features from any number of points (dynamic voxelisation, Zhou et al. 2020)."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from foredrive.scene import LidarSweep
from foredrive.scene.record import Record

POINT_CHANNELS = 4


@dataclass(frozen=True)
class PillarGrid:
    """Cells on the ground and the range of heights."""

    lower_m: tuple[float, float, float] = (0.0, -20.0, -1.0)
    """Lower bound in x, y and z. Points outside the grid are ignored."""
    pillar_m: float = 0.5
    cells: int = 80
    """Number of cells along x and along y."""
    height_m: float = 6.0


@dataclass(frozen=True)
class PointCloud(Record):
    """The returns of a batch of sweeps, concatenated; each sweep may have any number."""

    points: Float[Tensor, "P 4"]
    """x, y, z (m) and intensity (0 to 1)."""
    item: Int[Tensor, "P"]
    """Index of the sweep of each point in the batch."""

    @classmethod
    def from_sweeps(cls, sweeps: LidarSweep) -> "PointCloud":
        """Gather the returns of sweeps [n N], without padding and non-finite points."""
        points = torch.cat([sweeps.points_ego, sweeps.intensity[..., None]], dim=-1)
        kept = sweeps.valid & sweeps.returned & points.isfinite().all(-1)
        return cls(points[kept].float(), kept.nonzero()[:, 0])


class Pillars(NamedTuple):
    """The occupied pillars of a batch, sorted by item, then y, then x."""

    features: Float[Tensor, "K D"]
    cell_yx: Int[Tensor, "K 2"]
    item: Int[Tensor, "K"]


class PillarEncoder(nn.Module):
    """Two layers on every point, each followed by the maximum over the pillar of the point.

    A point is described by its offsets from the centre of its pillar and from the mean of the points there,
    by its height and intensity, and by the number of points in the pillar. This does not depend on the
    position of the pillar. No point is dropped.

    Args:
        widths: widths of both layers.
    """

    def __init__(self, grid: PillarGrid, widths: tuple[int, int]) -> None:
        super().__init__()
        self.grid = grid
        first, second = widths
        self.first = nn.Sequential(nn.Linear(POINT_CHANNELS + 4, first), nn.LayerNorm(first), nn.ReLU())
        self.second = nn.Sequential(nn.Linear(2 * first, second), nn.LayerNorm(second))

    def forward(self, cloud: PointCloud, items: int) -> Pillars:
        """Return the pillars of a batch of `items` sweeps. A sweep may have none."""
        grid = self.grid
        lower = cloud.points.new_tensor(grid.lower_m)
        # Coordinates in pillar units
        place = (cloud.points[:, :3] - lower) / grid.pillar_m
        upper = place.new_tensor([grid.cells, grid.cells, grid.height_m / grid.pillar_m])
        inside = ((place >= 0) & (place < upper)).all(-1)
        place, intensity, item = place[inside], cloud.points[inside, 3:], cloud.item[inside]
        cell_xy = place[:, :2].floor().long()
        # Number of each point's cell: item, then row, then column
        flat = (item * grid.cells + cell_xy[:, 1]) * grid.cells + cell_xy[:, 0]
        count = torch.bincount(flat, minlength=items * grid.cells**2)
        occupied = count.nonzero()[:, 0]
        # Rank of the occupied cell: the cumulative count of occupied cells up to it
        pillar = (count > 0).cumsum(0)[flat] - 1

        mean = place.new_zeros(len(occupied), 3).index_add_(0, pillar, place) / count[occupied, None]
        # Offset from the pillar's centre, offset from the mean of its points, and height in 0 to 1
        inputs = torch.cat(
            [place[:, :2] - cell_xy - 0.5, place - mean[pillar], place[:, 2:] / upper[2]], dim=-1
        )
        # The logarithm of the count is scaled to order 1
        features = self.first(torch.cat([inputs, intensity, count[flat, None].log() / 4], dim=-1))
        features = self._second(features, pillar, len(occupied))
        cell = occupied % grid.cells**2
        cell_yx = torch.stack([cell // grid.cells, cell % grid.cells], dim=-1)
        return Pillars(features, cell_yx, occupied // grid.cells**2)

    def _second(
        self, features: Float[Tensor, "P C"], pillar: Int[Tensor, "P"], pillars: int
    ) -> Float[Tensor, "K D"]:
        """Apply the second layer to each point's features, joined with the maximum over its pillar.

        The part of the maximum is computed once per pillar. The ReLU after the last maximum gives the same
        result as before it.
        """
        linear, norm = self.second
        assert isinstance(linear, nn.Linear)
        # Linear on the concatenation is the sum of two linear maps,
        # of the point and of its pillar's maximum
        of_point, of_pillar = linear.weight.split(features.shape[1], dim=1)
        shared = F.linear(pillar_max(features, pillar, pillars), of_pillar, linear.bias)
        return pillar_max(norm(F.linear(features, of_point) + shared[pillar]), pillar, pillars).relu()


def pillar_max(
    features: Float[Tensor, "P D"], pillar: Int[Tensor, "P"], pillars: int
) -> Float[Tensor, "K D"]:
    """Return the maximum of each channel over the points of each pillar, of which there is at least one."""
    out = features.new_zeros(pillars, features.shape[1])
    index = pillar[:, None].expand_as(features)
    return out.scatter_reduce(0, index, features, "amax", include_self=False)
