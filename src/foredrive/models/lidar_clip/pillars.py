"""Points of any number to features of the pillars that hold some (dynamic voxelisation, Zhou et al. 2020)."""

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
    """Cells on the ground, and which heights count."""

    lower_m: tuple[float, float, float] = (0.0, -20.0, -1.0)
    """Of x, y and z; what lies beyond the grid is not looked at."""
    pillar_m: float = 0.5
    cells: int = 80
    """Along x, and along y."""
    height_m: float = 6.0


@dataclass(frozen=True)
class PointCloud(Record):
    """The returns of a batch of sweeps one after another, however many each has."""

    points: Float[Tensor, "P 4"]
    """x, y, z (m) and intensity (0 to 1)."""
    item: Int[Tensor, "P"]
    """Which sweep of the batch each is of."""

    @classmethod
    def of_sweeps(cls, sweeps: LidarSweep) -> "PointCloud":
        """The returns of sweeps [n N]; padding and what is not finite are left out."""
        points = torch.cat([sweeps.points_ego, sweeps.intensity[..., None]], dim=-1)
        kept = sweeps.valid & sweeps.returned & points.isfinite().all(-1)
        return cls(points[kept].float(), kept.nonzero()[:, 0])


class Pillars(NamedTuple):
    """Occupied pillars of a batch, by item, then y, then x."""

    features: Float[Tensor, "K D"]
    cell_yx: Int[Tensor, "K 2"]
    item: Int[Tensor, "K"]


class PillarEncoder(nn.Module):
    """Two layers on every point, each followed by the maximum over the point's pillar.

    A point is told by where it lies from the middle of its pillar and from the mean of the pillar's points,
    by its height and intensity, and by how many share the pillar: the same wherever the pillar is. No
    point is dropped.

    Args:
        widths: of both layers.
    """

    def __init__(self, grid: PillarGrid, widths: tuple[int, int]) -> None:
        super().__init__()
        self.grid = grid
        first, second = widths
        self.first = nn.Sequential(nn.Linear(POINT_CHANNELS + 4, first), nn.LayerNorm(first), nn.ReLU())
        self.second = nn.Sequential(nn.Linear(2 * first, second), nn.LayerNorm(second))

    def forward(self, cloud: PointCloud, items: int) -> Pillars:
        """The pillars of a batch of `items` sweeps, some of which may have none."""
        grid = self.grid
        lower = cloud.points.new_tensor(grid.lower_m)
        place = (cloud.points[:, :3] - lower) / grid.pillar_m
        upper = place.new_tensor([grid.cells, grid.cells, grid.height_m / grid.pillar_m])
        inside = ((place >= 0) & (place < upper)).all(-1)
        place, intensity, item = place[inside], cloud.points[inside, 3:], cloud.item[inside]
        cell_xy = place[:, :2].floor().long()
        flat = (item * grid.cells + cell_xy[:, 1]) * grid.cells + cell_xy[:, 0]
        count = torch.bincount(flat, minlength=items * grid.cells**2)
        occupied = count.nonzero()[:, 0]
        pillar = (count > 0).cumsum(0)[flat] - 1

        mean = place.new_zeros(len(occupied), 3).index_add_(0, pillar, place) / count[occupied, None]
        told = torch.cat(
            [place[:, :2] - cell_xy - 0.5, place - mean[pillar], place[:, 2:] / upper[2]], dim=-1
        )
        features = self.first(torch.cat([told, intensity, count[flat, None].log() / 4], dim=-1))
        features = self._second(features, pillar, len(occupied))
        cell = occupied % grid.cells**2
        cell_yx = torch.stack([cell // grid.cells, cell % grid.cells], dim=-1)
        return Pillars(features, cell_yx, occupied // grid.cells**2)

    def _second(
        self, features: Float[Tensor, "P C"], pillar: Int[Tensor, "P"], pillars: int
    ) -> Float[Tensor, "K D"]:
        """The second layer, on each point's features beside the maximum over its pillar.

        What comes of that maximum is worked out once a pillar. Rectifying after the last maximum is the same.
        """
        linear, norm = self.second
        assert isinstance(linear, nn.Linear)
        of_point, of_pillar = linear.weight.split(features.shape[1], dim=1)
        shared = F.linear(pillar_max(features, pillar, pillars), of_pillar, linear.bias)
        return pillar_max(norm(F.linear(features, of_point) + shared[pillar]), pillar, pillars).relu()


def pillar_max(
    features: Float[Tensor, "P D"], pillar: Int[Tensor, "P"], pillars: int
) -> Float[Tensor, "K D"]:
    """The maximum of each channel over the points of each pillar; every pillar has one at least."""
    out = features.new_zeros(pillars, features.shape[1])
    index = pillar[:, None].expand_as(features)
    return out.scatter_reduce(0, index, features, "amax", include_self=False)
