"""Forecasts of occupancy: the present moved along the driven path or with its flow, and sampled futures."""

import functools
import itertools
import operator
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from foredrive.geometry.se3 import transform_points
from foredrive.scene import VoxelGrid, VoxelSpec
from foredrive.scene.record import Record
from foredrive.scene.voxels import MOVING_MPS
from foredrive.tasks.occupancy.scores import OccupancyCounts, count_occupancy


def ego_compensated(
    occupied: Bool[Tensor, "b Z Y X"], T_src_dst: Float64[Tensor, "b 4 4"], spec: VoxelSpec
) -> Bool[Tensor, "b Z Y X"]:
    """Return the occupancy of a static scene from another pose, by the nearest voxel.

    Args:
        occupied: on the grid in the frame src; free outside of it.
        T_src_dst: points of the frame dst, in which the result is, -> src.
        spec: of both grids.
    """
    # Centres of all voxels of dst, in the frame of src
    centres = spec.centres_m(occupied.device).flatten(0, 2).double()
    place = transform_points(T_src_dst, centres.expand(len(occupied), -1, -1))
    # Nearest voxel of each; those outside of the grid are free
    index = ((place - place.new_tensor(spec.lower_m)) / spec.voxel_m).floor().long()
    nz, ny, nx = spec.shape_zyx
    inside = ((index >= 0) & (index < index.new_tensor([nx, ny, nz]))).all(-1)
    # The index of outside voxels is 0 and is masked below
    flat = ((index[..., 2] * ny + index[..., 1]) * nx + index[..., 0]).where(inside, 0)
    return (occupied.flatten(1).gather(1, flat) & inside).view(occupied.shape)


def carried_by_flow(
    occupied: Bool[Tensor, "b Z Y X"],
    flow_mps: Float[Tensor, "b 3 Z Y X"],
    T_src_dst: Float64[Tensor, "b 4 4"],
    after_s: Float64[Tensor, "b"],
    spec: VoxelSpec,
) -> Bool[Tensor, "b Z Y X"]:
    """Return the occupancy from another pose after some time, if each voxel goes on at its velocity.

    Args:
        occupied, T_src_dst, spec: as of `ego_compensated`.
        flow_mps: velocity over ground of the content of each voxel, in the axes of src.
        after_s: time since src.
    """
    moves = occupied & (flow_mps.norm(dim=1) > MOVING_MPS)
    carried = ego_compensated(occupied & ~moves, T_src_dst, spec)
    for item in moves.flatten(1).any(1).nonzero()[:, 0].tolist():
        velocity = flow_mps[item].movedim(0, -1)
        # The voxels of one thing have one velocity: its place in src is behind by what it moves
        for one in velocity[moves[item]].unique(dim=0):
            same = moves[item] & (velocity == one).all(dim=-1)
            T_behind_src = torch.eye(4, dtype=T_src_dst.dtype, device=T_src_dst.device)
            T_behind_src[:3, 3] = -after_s[item] * one
            carried[item] |= ego_compensated(same[None], T_behind_src @ T_src_dst[item : item + 1], spec)[0]
    return carried


def swept_by_motion(
    moving: Bool[Tensor, "b F Z Y X"], T_now_ego: Float64[Tensor, "b F 4 4"], spec: VoxelSpec
) -> Bool[Tensor, "b F Z Y X"]:
    """Return the voxels of each frame that moving things fill at the frames up to it, and those next to them.

    Args:
        moving: occupied voxels that move, each frame in its own ego frame.
        T_now_ego: poses of the frames relative to now.
        spec: of the grids.
    """
    swept = []
    for k in range(moving.shape[1]):
        before = [
            ego_compensated(moving[:, j], torch.linalg.inv(T_now_ego[:, j]) @ T_now_ego[:, k], spec)
            for j in range(k + 1)
        ]
        filled = torch.stack(before).any(dim=0)
        # Neighbours count: what is found a voxel beside them is wrong
        swept.append(F.max_pool3d(filled.float(), 3, stride=1, padding=1) > 0)
    return torch.stack(swept, dim=1)


@dataclass(frozen=True)
class FuturesCounts(Record):
    """Agreement of K sampled futures with the labels, and with each other; per frame."""

    best: OccupancyCounts
    """Of the future of each item that is the best over all its frames together."""
    mean: OccupancyCounts
    """Of all futures."""
    spread: Float[Tensor, "F"]
    """Sum over items of 1 - IoU between two of its futures, averaged over pairs: 0 if they are alike."""
    items: int

    def __add__(self, other: "FuturesCounts") -> "FuturesCounts":
        return FuturesCounts(
            self.best + other.best,
            self.mean + other.mean,
            self.spread + other.spread,
            self.items + other.items,
        )


def count_futures(
    futures: Bool[Tensor, "b K F Z Y X"], labels: VoxelGrid, region: Bool[Tensor, "Z Y X"] | None = None
) -> FuturesCounts:
    """Compare K sampled futures of each item with labels [b F 1 Z Y X], as `count_occupancy` does."""
    best, mean, spread = [], [], torch.zeros(futures.shape[2], dtype=torch.float64)
    # Every item has K futures; the best is chosen by IoU over all of its frames
    for item, drawn in enumerate(futures):
        label = labels[item : item + 1]
        counts = [count_occupancy(future[None], label, region) for future in drawn]
        agreement = [float(_pooled_iou(count)) for count in counts]
        best.append(counts[max(range(len(counts)), key=agreement.__getitem__)])
        mean += counts
        inside = drawn if region is None else drawn & region.to(drawn.device)
        spread += _disagreement(inside)
    return FuturesCounts(_total(best), _total(mean), spread, len(futures))


def _pooled_iou(counts: OccupancyCounts) -> Float[Tensor, ""]:
    """Return the IoU over all frames together; 0 where nothing was occupied."""
    hits = counts.true_positive.sum()
    return hits / (hits + counts.false_positive.sum() + counts.false_negative.sum()).clamp_min(1)


def _total(counts: Sequence[OccupancyCounts]) -> OccupancyCounts:
    return functools.reduce(operator.add, counts)


def _disagreement(drawn: Bool[Tensor, "K F Z Y X"]) -> Float64[Tensor, "F"]:
    """Return 1 - IoU per frame, averaged over pairs of futures; two empty frames agree."""
    pairs = list(itertools.combinations(drawn.flatten(2).unbind(), 2))
    apart = torch.zeros(drawn.shape[1], dtype=torch.float64)
    # 1 - IoU is the symmetric difference over the union
    for one, other in pairs:
        either = (one | other).sum(-1)
        apart += ((one ^ other).sum(-1) / either.clamp_min(1)).double().cpu()
    return apart / max(len(pairs), 1)
