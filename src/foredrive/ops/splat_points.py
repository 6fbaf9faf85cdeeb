"""Where splats are looked at: the pixels of a camera or the beams of a lidar, grouped in tiles.

A tile is up to 256 neighbouring points in 16 blocks of 16. Tiles stand in rows of their own lengths, so that
pixels and the uneven beams of real lidars are the same thing to whoever composites.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

LANES = 16
"""Points in a block, blocks in a tile."""
SLOTS = LANES * LANES
"""Most points in a tile."""
PARTS = 4
"""Of a turn: no tile of beams reaches over two."""
SIDE_PX = 16
"""Pixels along each side of a camera's tile; its blocks are squares of 4."""


@dataclass(frozen=True)
class TiledPoints:
    """P points on a plane, in T tiles that stand in R rows. Made by `pixel_points` and `beam_points`.

    Slots that no point fills repeat a neighbour's place and time.
    """

    position: Float[Tensor, "T S 2"]
    """On the sensor's plane: u v in px, or azimuth and elevation in rad."""
    time_s: Float[Tensor, "T S"]
    """When the sensor looks at each point, relative to the splats' time."""
    index: Int[Tensor, "T S"]
    """Which point fills a slot; -1: none."""
    count: int
    """P."""
    left_edge: Float[Tensor, "T"]
    """Where a tile begins along x; ascending within a row, without gaps between tiles."""
    lower_edge: Float[Tensor, "R"]
    """Where a row of tiles begins along y, ascending."""
    first_tile: Int[Tensor, "R1"]
    """Where a row's tiles begin, and T at the end."""
    period: float = 0.0
    """After how much x comes back to where it was; 0: never."""
    size_hw: tuple[int, int] | None = None
    """Of the image whose pixels these are, row by row; None: no image."""

    @cached_property
    def rows(self) -> Float[Tensor, "T 3 S"]:
        """x, y and time, each side by side for all points of a tile."""
        return torch.cat([self.position, self.time_s[..., None]], -1).transpose(1, 2).contiguous()

    @cached_property
    def block_bounds(self) -> Float[Tensor, "T 6 B"]:
        """Of each block: least and greatest x, then y, then time."""
        blocks = self.rows.unflatten(2, (LANES, LANES))
        return torch.stack([blocks.amin(3), blocks.amax(3)], 2).flatten(1, 2)

    @cached_property
    def tile_bounds(self) -> Float[Tensor, "T 6"]:
        """The same of each tile."""
        return torch.stack([self.rows.amin(2), self.rows.amax(2)], 2).flatten(1, 2)

    @cached_property
    def at_once(self) -> bool:
        """Whether these are the pixels of an image of one instant."""
        return self.size_hw is not None and not bool(self.time_s.any())

    def to(self, device: torch.device | str, dtype: torch.dtype | None = None) -> "TiledPoints":
        """The same on another device, in another precision; these points themselves where nothing changes."""
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
    """The centres of all pixels of an image in tiles of 16×16.

    Args:
        size_hw: image size, px.
        readout_s: time from the first to the last row, which are read one after the other; times are relative
            to the middle row, as in `sensors.camera_rays`.
    """
    height, width = size_hw
    rows, columns = -(-height // SIDE_PX), -(-width // SIDE_PX)
    slot = torch.arange(SLOTS)
    block, lane = slot // LANES, slot % LANES
    dv, du = 4 * (block // 4) + lane // 4, 4 * (block % 4) + lane % 4
    tile = torch.arange(rows * columns)[:, None]
    v, u = SIDE_PX * (tile // columns) + dv, SIDE_PX * (tile % columns) + du
    inside = (v < height) & (u < width)
    v, u = v.clamp(max=height - 1), u.clamp(max=width - 1)
    return TiledPoints(
        position=torch.stack([u + 0.5, v + 0.5], -1),
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
    """Any beams in tiles of 256.

    Rows of tiles hold about as many beams each, and end in the widest gap between elevations that is near:
    between two channels where there are channels. Within a row tiles follow each other in azimuth; each lies
    in one quarter of a turn, so that it is clear on which side of a tile a splat lies.

    Args:
        azimuth_rad, elevation_rad: in the sensor's frame at the moment that the beam is fired.
        time_s: that moment, relative to the splats' time.
    """
    azimuth_rad = torch.remainder(azimuth_rad + math.pi, 2 * math.pi) - math.pi
    by_elevation = elevation_rad.argsort(stable=True)
    starts = _row_starts(elevation_rad[by_elevation])
    row = torch.repeat_interleave(torch.arange(len(starts) - 1), starts.diff())
    order = by_elevation[_sorted_within(row, azimuth_rad[by_elevation])]
    part = row * PARTS + ((azimuth_rad[order] + math.pi) * (PARTS / (2 * math.pi))).long().clamp(0, PARTS - 1)
    lengths = part.bincount(minlength=PARTS * (len(starts) - 1))
    zero = torch.zeros(1, dtype=torch.long)
    first_in_part = torch.cat([zero, (-(-lengths // SLOTS)).cumsum(0)])  # tiles
    place = torch.arange(len(order)) - torch.cat([zero, lengths.cumsum(0)])[part]
    tile = first_in_part[part] + place // SLOTS
    quarter = tile * 4 + place % SLOTS // (SLOTS // 4)  # four columns of blocks, four blocks in each
    order = order[_sorted_within(quarter, elevation_rad[order])]
    index = torch.full((int(first_in_part[-1]) * SLOTS,), -1)
    index[tile * SLOTS + place % SLOTS] = order
    index = index.view(-1, SLOTS)
    filled = torch.where(index >= 0, index, index.amax(1, keepdim=True))
    position = torch.stack([azimuth_rad, elevation_rad], -1)[filled]
    return TiledPoints(
        position=position,
        time_s=time_s[filled],
        index=index,
        count=len(order),
        left_edge=position[..., 0].amin(1),
        lower_edge=elevation_rad[by_elevation][starts[:-1]],
        first_tile=first_in_part[::PARTS],
        period=2 * math.pi,
    )


def _row_starts(ascending: Float[Tensor, "P"]) -> Int[Tensor, "R1"]:
    """Where rows of tiles begin among beams in the order of their elevations; P at the end.

    As many rows as make the tiles where most beams are about as high as wide.
    """
    count = len(ascending)
    if count == 0:
        return torch.tensor([0])
    height_rad = float(ascending[count * 3 // 4] - ascending[count // 4]) * 2
    rows = max(1, round(math.sqrt(height_rad * count / (2 * math.pi * SLOTS))))
    gap = ascending.diff()
    reach = count // (3 * rows)
    starts = [0]
    for k in range(1, rows):
        begin = max(k * count // rows - reach, starts[-1])
        starts.append(begin + int(gap[begin : begin + 2 * reach + 1].argmax()) + 1)
    return torch.tensor([*starts, count])


def _sorted_within(group: Int[Tensor, "P"], value: Float[Tensor, "P"]) -> Int[Tensor, "P"]:
    """Where to find the entries by ascending group, and by ascending value within each."""
    by_value = value.argsort(stable=True)
    return by_value[group[by_value].argsort(stable=True)]
