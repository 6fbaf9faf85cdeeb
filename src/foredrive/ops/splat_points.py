"""Sample points for splats: camera pixels or lidar beams, grouped in tiles.

A tile has up to 256 neighbouring points in 16 blocks of 16. Tiles form rows of different lengths. Thus pixels
and the uneven beams of real lidars have the same structure for compositing.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

LANES = 16
"""Number of points in a block, and of blocks in a tile."""
SLOTS = LANES * LANES
"""Maximum number of points in a tile."""
QUADRANTS = 4
"""Number of parts of a turn. A tile of beams never extends over two parts."""
SIDE_PX = 16
"""Side length of a camera tile in pixels. Its blocks have 4 by 4 pixels."""


@dataclass(frozen=True)
class TiledPoints:
    """P points on a plane, in T tiles that form R rows. `pixel_points` and `beam_points` create it.

    A slot without a point repeats the position and time of a neighbour.
    """

    position: Float[Tensor, "T S 2"]
    """Position on the sensor plane: u v in px, or azimuth and elevation in rad."""
    time_s: Float[Tensor, "T S"]
    """Measurement time of each point, relative to the time of the splats."""
    index: Int[Tensor, "T S"]
    """Index of the point in each slot; -1 for an empty slot."""
    count: int
    """P, the number of points."""
    left_edge: Float[Tensor, "T"]
    """Start of each tile along x; ascending within a row, without gaps between tiles."""
    lower_edge: Float[Tensor, "R"]
    """Start of each row of tiles along y, ascending."""
    first_tile: Int[Tensor, "R1"]
    """First tile of each row, and T at the end."""
    period: float = 0.0
    """Period of x; 0 if x is not periodic."""
    size_hw: tuple[int, int] | None = None
    """Size of the image if the points are its pixels in row order; else None."""

    @cached_property
    def rows(self) -> Float[Tensor, "T 3 S"]:
        """Return x, y and time, each contiguous over the points of a tile."""
        return torch.cat([self.position, self.time_s[..., None]], -1).transpose(1, 2).contiguous()

    @cached_property
    def block_bounds(self) -> Float[Tensor, "T 6 B"]:
        """Return the smallest and largest x, y and time of each block."""
        blocks = self.rows.unflatten(2, (LANES, LANES))
        return torch.stack([blocks.amin(3), blocks.amax(3)], 2).flatten(1, 2)

    @cached_property
    def tile_bounds(self) -> Float[Tensor, "T 6"]:
        """Return the smallest and largest x, y and time of each tile."""
        return torch.stack([self.rows.amin(2), self.rows.amax(2)], 2).flatten(1, 2)

    @cached_property
    def single_instant(self) -> bool:
        """Return whether the points are the pixels of an image of one instant."""
        return self.size_hw is not None and not bool(self.time_s.any())

    def to(self, device: torch.device | str, dtype: torch.dtype | None = None) -> "TiledPoints":
        """Return the points on another device or in another precision. Return `self` if nothing changes."""
        if self.position.device == torch.device(device) and dtype in (self.position.dtype, None):
            return self
        return TiledPoints(
            position=self.position.to(device, dtype),
            time_s=self.time_s.to(device, dtype),
            index=self.index.to(device),
            count=self.count,
            left_edge=self.left_edge.to(device, dtype),
            lower_edge=self.lower_edge.to(device, dtype),
            first_tile=self.first_tile.to(device),
            period=self.period,
            size_hw=self.size_hw,
        )


def pixel_points(size_hw: tuple[int, int], readout_s: float = 0.0) -> TiledPoints:
    """Return the centres of all pixels of an image in tiles of 16×16.

    Args:
        size_hw: image size, px.
        readout_s: time from the first to the last row of a rolling shutter. Times are relative to the middle
            row, as in `sensors.camera_rays`.
    """
    height, width = size_hw
    rows, columns = -(-height // SIDE_PX), -(-width // SIDE_PX)
    # Slot to pixel: 4×4 blocks in a tile, 4×4 pixels in a block
    slot = torch.arange(SLOTS)
    block, lane = slot // LANES, slot % LANES
    dv, du = 4 * (block // 4) + lane // 4, 4 * (block % 4) + lane % 4
    tile = torch.arange(rows * columns)[:, None]
    v, u = SIDE_PX * (tile // columns) + dv, SIDE_PX * (tile % columns) + du
    # Slots beyond the image repeat the pixel at its border
    inside = (v < height) & (u < width)
    v, u = v.clamp(max=height - 1), u.clamp(max=width - 1)
    return TiledPoints(
        position=torch.stack([u + 0.5, v + 0.5], -1),
        # Readout time of a pixel's row, relative to the middle of the image
        time_s=((v + 0.5) / height - 0.5) * readout_s,
        index=torch.where(inside, v * width + u, -1),
        count=height * width,
        left_edge=(SIDE_PX * torch.arange(columns)).repeat(rows).float(),
        lower_edge=(SIDE_PX * torch.arange(rows)).float(),
        first_tile=columns * torch.arange(rows + 1),
        size_hw=size_hw,
    )


def beam_points(
    azimuth_rad: Float[Tensor, "P"], elevation_rad: Float[Tensor, "P"], time_s: Float[Tensor, "P"]
) -> TiledPoints:
    """Return lidar beams in tiles of 256.

    Each row of tiles holds about the same number of beams. It ends in the widest nearby gap between
    elevations, which is between two channels if the lidar has channels. Within a row, tiles are sorted by
    azimuth. Each tile lies in one quarter of a turn, so that the side of a tile on which a splat lies is well
    defined.

    Args:
        azimuth_rad, elevation_rad: beam directions in the sensor frame at the firing time.
        time_s: firing time relative to the time of the splats.
    """
    # Azimuth to -π … π, so that quadrants and left edges are comparable
    azimuth_rad = torch.remainder(azimuth_rad + math.pi, 2 * math.pi) - math.pi
    # Rows of tiles: cut the beams, sorted by elevation, at the chosen starts
    by_elevation = elevation_rad.argsort(stable=True)
    starts = _row_starts(elevation_rad[by_elevation])
    row = torch.repeat_interleave(torch.arange(len(starts) - 1), starts.diff())
    # Within a row by azimuth, then cut at the quarters of a turn
    order = by_elevation[_sorted_within(row, azimuth_rad[by_elevation])]
    quadrant = ((azimuth_rad[order] + math.pi) * (QUADRANTS / (2 * math.pi))).long().clamp(0, QUADRANTS - 1)
    part = row * QUADRANTS + quadrant
    # Each quarter of a row fills whole tiles; its last one may be partly empty
    lengths = part.bincount(minlength=QUADRANTS * (len(starts) - 1))
    zero = torch.zeros(1, dtype=torch.long)
    first_in_part = torch.cat([zero, (-(-lengths // SLOTS)).cumsum(0)])  # in tiles
    slot_in_part = torch.arange(len(order)) - torch.cat([zero, lengths.cumsum(0)])[part]
    tile = first_in_part[part] + slot_in_part // SLOTS
    # Within a tile, sort each quarter by elevation: blocks of 16 become compact in both directions
    column = tile * 4 + slot_in_part % SLOTS // (SLOTS // 4)  # four columns of blocks, of four blocks each
    order = order[_sorted_within(column, elevation_rad[order])]
    index = torch.full((int(first_in_part[-1]) * SLOTS,), -1)
    index[tile * SLOTS + slot_in_part % SLOTS] = order
    index = index.view(-1, SLOTS)
    # Empty slots repeat a beam of their own tile, so that bounds stay tight
    filled = torch.where(index >= 0, index, index.amax(1, keepdim=True))
    position = torch.stack([azimuth_rad, elevation_rad], -1)[filled]
    return TiledPoints(
        position=position,
        time_s=time_s[filled],
        index=index,
        count=len(order),
        left_edge=position[..., 0].amin(1),
        lower_edge=elevation_rad[by_elevation][starts[:-1]],
        first_tile=first_in_part[::QUADRANTS],
        period=2 * math.pi,
    )


def _row_starts(ascending: Float[Tensor, "P"]) -> Int[Tensor, "R1"]:
    """Return the start of each row of tiles in beams sorted by elevation, and P at the end.

    The number of rows makes tiles about square where most beams are.
    """
    count = len(ascending)
    if count == 0:
        return torch.tensor([0])
    # Twice the range of the middle half stands for the height: outliers do not count
    height_rad = float(ascending[count * 3 // 4] - ascending[count // 4]) * 2
    # Side by side, rows · columns ≈ count / 256 with columns / rows = 2π / height
    rows = max(1, round(math.sqrt(height_rad * count / (2 * math.pi * SLOTS))))
    gap = ascending.diff()
    # Look for the widest gap within a third of a row around the even division
    reach = count // (3 * rows)
    starts = [0]
    for k in range(1, rows):
        begin = max(k * count // rows - reach, starts[-1])
        starts.append(begin + int(gap[begin : begin + 2 * reach + 1].argmax()) + 1)
    return torch.tensor([*starts, count])


def _sorted_within(group: Int[Tensor, "P"], value: Float[Tensor, "P"]) -> Int[Tensor, "P"]:
    """Return the permutation that sorts by group, and by value within each group."""
    # Stable sorts: first by the minor key, then by the major one
    by_value = value.argsort(stable=True)
    return by_value[group[by_value].argsort(stable=True)]
