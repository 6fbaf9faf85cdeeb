"""The plane that the heads read: a volume with its height folded into the channels, shrunk."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from foredrive.scene import VoxelSpec
from foredrive.scene.record import Record


@dataclass(frozen=True)
class Plane(Record):
    """Features seen from above, in the ego frame."""

    features: Float[Tensor, "b W y x"]
    lower_m: tuple[float, float]
    """x, y of the lower corner."""
    cell_m: float

    @property
    def cells(self) -> Float[Tensor, "b C W"]:
        """Return the cells as a sequence, x running faster."""
        return self.features.flatten(2).mT

    @property
    def middle_m(self) -> Float[Tensor, "C 2"]:
        """Return the middle of each of the `cells`."""
        rows, columns = self.features.shape[-2:]
        return cell_middles(self.lower_m, self.cell_m, (rows, columns)).to(self.features)

    def share(self, points_m: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 2"]:
        """Return points of the ego frame as shares of the plane's extent, 0 to 1 inside."""
        rows, columns = self.features.shape[-2:]
        extent_m = points_m.new_tensor([columns * self.cell_m, rows * self.cell_m])
        return (points_m - points_m.new_tensor(self.lower_m)) / extent_m

    def at(self, points_m: Float[Tensor, "b *n 2"]) -> Float[Tensor, "b *n W"]:
        """Return the features at points of the ego frame, bilinear; they fall to 0 outside of the plane."""
        where = (2 * self.share(points_m) - 1).flatten(1, -2)[:, None]
        found = F.grid_sample(self.features, where.to(self.features), align_corners=False)
        return found[:, :, 0].mT.unflatten(1, points_m.shape[1:-1])


class PlaneFeatures(nn.Module):
    """Convolutions from a volume to a plane. Each halving doubles the edge of a cell.

    Args:
        spec: grid of the volume.
        channels: D of the volume.
        width: channels of the plane, a multiple of 8.
        shrink: how many times the plane is halved.
    """

    def __init__(self, spec: VoxelSpec, *, channels: int, width: int, shrink: int) -> None:
        super().__init__()
        depth = spec.shape_zyx[0]
        convolutions: list[nn.Module] = [nn.Conv2d(depth * channels, width, 3, padding=1), nn.ReLU()]
        for _ in range(shrink):
            convolutions += [
                nn.Conv2d(width, width, 3, stride=2, padding=1),
                nn.GroupNorm(8, width),
                nn.ReLU(),
            ]
            convolutions += [nn.Conv2d(width, width, 3, padding=1), nn.ReLU()]
        self.convolutions = nn.Sequential(*convolutions)
        self.width, self.cell_m = width, spec.voxel_m * 2**shrink
        self.lower_m = spec.lower_m[:2]
        rows, columns = (-(-size // 2**shrink) for size in spec.shape_zyx[1:])
        self.shape_yx = (rows, columns)

    def forward(self, volume: Float[Tensor, "b D Z Y X"]) -> Plane:
        """Return the plane of a volume."""
        return Plane(self.convolutions(volume.flatten(1, 2)), self.lower_m, self.cell_m)


def cell_middles(
    lower_m: tuple[float, float], cell_m: float, shape_yx: tuple[int, int]
) -> Float[Tensor, "C 2"]:
    """Return x, y of the middles of a plane's cells, x running faster."""
    y = lower_m[1] + (torch.arange(shape_yx[0]) + 0.5) * cell_m
    x = lower_m[0] + (torch.arange(shape_yx[1]) + 0.5) * cell_m
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).flatten(0, 1)


def halvings(spec: VoxelSpec, max_cells: int) -> int:
    """Return how many times a plane is halved until neither side has more than `max_cells` cells."""
    return max(0, math.ceil(math.log2(max(spec.shape_zyx[1:]) / max_cells)))
