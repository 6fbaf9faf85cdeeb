"""The planes that the heads read: a volume with its height folded into the channels, at two resolutions."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from foredrive.geometry.precision import full_precision
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
        """Return the middle of each of the `cells`, in float32 whatever the features are."""
        rows, columns = self.features.shape[-2:]
        return cell_middles(self.lower_m, self.cell_m, (rows, columns)).to(self.features.device)

    def share(self, points_m: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 2"]:
        """Return points of the ego frame as shares of the plane's extent, 0 to 1 inside."""
        rows, columns = self.features.shape[-2:]
        extent_m = points_m.new_tensor([columns * self.cell_m, rows * self.cell_m])
        return (points_m - points_m.new_tensor(self.lower_m)) / extent_m

    def at(self, points_m: Float[Tensor, "b *n 2"]) -> Float[Tensor, "b *n W"]:
        """Return the features at points of the ego frame, bilinear; they fall to 0 outside of the plane.

        Points and features are read in full precision, also within autocast.
        """
        with full_precision(self.features, points_m) as (features, points_m):
            # grid_sample has the borders of the plane at -1 and 1; one row of N points
            where = (2 * self.share(points_m) - 1).flatten(1, -2)[:, None]
            sampled = F.grid_sample(features, where, align_corners=False)
        return sampled[:, :, 0].mT.unflatten(1, points_m.shape[1:-1])


@dataclass(frozen=True)
class Planes(Record):
    """Two planes of one volume."""

    fine: Plane
    """In the resolution of the volume, with few channels: read at single places."""
    coarse: Plane
    """Few enough cells for all queries to attend to all of them."""


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
        # Heights and channels of a column become the channels of an image
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


class PlanePyramid(nn.Module):
    """A U-Net over the plane of a volume: columns, their surroundings, and the whole plane.

    Height is folded into the channels by one normed layer for each column. A past volume is folded by the
    same layer, moved by the ego motion and read beside the present one (BEVDet4D, Huang and Huang 2022), so
    that what moves can be told from what stands.

    Args:
        spec: grid of the volume.
        channels: D of the volume.
        width: channels of the coarse plane, a multiple of 16; the fine one has half as many.
        max_cells: maximum number of cells along a side of the coarse plane.
        past: whether a past volume is read.
    """

    def __init__(self, spec: VoxelSpec, *, channels: int, width: int, max_cells: int, past: bool) -> None:
        super().__init__()
        self.width, self.fine_width, self.past = width, width // 2, past
        self.halvings = max(1, halvings(spec, max_cells))
        fine = self.fine_width
        self.columns = _convolution(spec.shape_zyx[0] * channels, fine, size=1)
        self.join = _convolution(2 * fine if past else fine, fine)
        depths = self.halvings + 1  # one level below the coarse plane sees most of the surroundings
        widths = [fine] + depths * [width]
        self.down = nn.ModuleList(
            nn.Sequential(_convolution(widths[n], width, stride=2), _convolution(width, width))
            for n in range(depths)
        )
        self.narrow = nn.ModuleList(nn.Conv2d(width, widths[n], 1) for n in range(depths))
        self.up = nn.ModuleList(_convolution(widths[n], widths[n]) for n in range(depths))
        self.lower_m, self.cell_m, self.shape_yx = spec.lower_m[:2], spec.voxel_m, spec.shape_zyx[1:]
        self.coarse_m = spec.voxel_m * 2**self.halvings

    def forward(
        self,
        volume: Float[Tensor, "b D Z Y X"],
        past: Float[Tensor, "b D Z Y X"] | None = None,
        T_past_now: Float[Tensor, "b 4 4"] | None = None,
    ) -> Planes:
        """Return the planes of a volume.

        Args:
            volume: of now.
            past: an earlier one in its own ego frame; None counts as one of zeros.
            T_past_now: the ego frame at now -> the ego frame of the past volume.
        """
        plane = self.columns(volume.flatten(1, 2))
        # Without a past volume the second half of the channels is 0
        if self.past:
            before = torch.zeros_like(plane)
            if past is not None and T_past_now is not None:
                before = self._moved(self.columns(past.flatten(1, 2)), T_past_now)
            plane = torch.cat([plane, before], dim=1)
        # Channels-last memory is the faster layout for convolutions
        levels = [self.join(plane.contiguous(memory_format=torch.channels_last))]
        # Down to one level below the coarse plane
        for down in self.down:
            levels.append(down(levels[-1]))
        refined = levels.pop()
        # Up again: coarse features added to each finer level; the level of the coarse plane is kept
        for n in reversed(range(len(levels))):
            narrowed = self.narrow[n](refined)
            refined = self.up[n](
                levels[n] + F.interpolate(narrowed, size=levels[n].shape[-2:], mode="bilinear")
            )
            if n == self.halvings:
                coarse = refined
        return Planes(
            fine=Plane(refined, self.lower_m, self.cell_m), coarse=Plane(coarse, self.lower_m, self.coarse_m)
        )

    def _moved(self, past: Float[Tensor, "b W y x"], T_past_now: Float[Tensor, "b 4 4"]) -> Tensor:
        """Read the plane of the past at the places of now's cells, 0 outside."""
        middle = cell_middles(self.lower_m, self.cell_m, self.shape_yx).to(past.device)
        moved = moved_over_ground(T_past_now, middle)
        return Plane(past, self.lower_m, self.cell_m).at(moved).mT.unflatten(-1, self.shape_yx)


def _convolution(width_in: int, width: int, stride: int = 1, size: int = 3) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(width_in, width, size, stride=stride, padding=size // 2), nn.GroupNorm(8, width), nn.ReLU()
    )


def moved_over_ground(
    T_dst_src: Float[Tensor, "b 4 4"], points_m: Float[Tensor, "C 2"]
) -> Float[Tensor, "b C 2"]:
    """Return points of src in dst, in float32 and also within autocast; heights and tilts are left out."""
    with full_precision(T_dst_src.float(), points_m) as (T, points):
        return points @ T[:, :2, :2].mT + T[:, None, :2, 3]


def cell_middles(
    lower_m: tuple[float, float], cell_m: float, shape_yx: tuple[int, int]
) -> Float[Tensor, "C 2"]:
    """Return x, y of the middles of a plane's cells, x running faster."""
    y = lower_m[1] + (torch.arange(shape_yx[0]) + 0.5) * cell_m
    x = lower_m[0] + (torch.arange(shape_yx[1]) + 0.5) * cell_m
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).flatten(0, 1)


def spread_points(
    lower_m: tuple[float, float], cell_m: float, shape_yx: tuple[int, int], count: int
) -> Float[Tensor, "count 2"]:
    """Return points at about equal distances over a plane, m."""
    rows, columns = shape_yx
    # Rows and columns in the proportion of the plane, so that distances along both are equal
    per_row = math.ceil(math.sqrt(count * columns / rows))
    n_rows = math.ceil(count / per_row)
    index = torch.arange(count)
    share = torch.stack([(index % per_row + 0.5) / per_row, (index // per_row + 0.5) / n_rows], dim=-1)
    return torch.tensor(lower_m) + share * cell_m * torch.tensor([columns, rows])


def halvings(spec: VoxelSpec, max_cells: int) -> int:
    """Return how many times a plane is halved until neither side has more than `max_cells` cells."""
    # Number of halvings until the longer side fits
    return max(0, math.ceil(math.log2(max(spec.shape_zyx[1:]) / max_cells)))
