"""Edges of lidar sweeps: points next to which a beam hit something farther, on static surfaces."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from foredrive.geometry.se3 import transform_points
from foredrive.methods.reconstruction.scene_graph import STATIC
from foredrive.methods.reconstruction.seed_points import actor_rows
from foredrive.methods.reconstruction.tracks import ActorTracks, states_at
from foredrive.methods.reconstruction.views import SweepView
from foredrive.scene import LidarSweep

_SWEEPS = 10
_JUMP_M, _JUMP_SHARE = 0.5, 0.1
"""An edge needs a range jump of this many metres plus this share of the range."""
_BESIDE_RAD, _ABOVE_RAD = math.radians(0.8), math.radians(0.6)
"""Maximum angle to the next beam of a channel and to the next channel."""
_COLUMN_RAD, _ROW_RAD = math.radians(0.2), math.radians(0.1)
"""Width of a column of beams, and height of a row that stands for the channel where a log has none."""
_MAX_STATIC_MPS = 0.3


@dataclass(frozen=True)
class SweepEdges:
    """Points of a sweep next to which a beam hit something farther, on static surfaces."""

    t_s: float
    T_scene_ego: Float[Tensor, "4 4"]
    points_ego: Float[Tensor, "N 3"]
    horizontal: Bool[Tensor, "N"]
    """True where the farther beam is above or below, False where it is left or right."""


def spread_along_path(position_m: Float[Tensor, "F 3"], count: int = _SWEEPS) -> list[int]:
    """Return up to `count` indices, evenly along the path, or in time where the path is short."""
    frames = len(position_m)
    if frames <= count:
        return list(range(frames))
    # Path length up to each frame, starting at 0
    path_m = F.pad((position_m[1:] - position_m[:-1]).norm(dim=-1).cumsum(0), (1, 0))
    # Less than a metre per chosen frame: the vehicle hardly moved, so frames are spread in time
    if float(path_m[-1]) < count:
        return torch.linspace(0, frames - 1, count).round().long().unique().tolist()
    even_m = torch.linspace(0, float(path_m[-1]), count, dtype=path_m.dtype)
    # First frame at or behind each even path length; a standing
    # vehicle gives duplicates, which unique drops
    return torch.searchsorted(path_m, even_m).clamp_max(frames - 1).unique().tolist()


def sweep_edges(sweeps: Sequence[SweepView], tracks: ActorTracks) -> list[SweepEdges]:
    """Return the edges of sweeps that are spread over the driven path, without those of moving actors."""
    if not sweeps:
        return []
    position_m = torch.stack([sweep.T_scene_ego[:3, 3] for sweep in sweeps])
    return [_sweep_edges(sweeps[index], tracks) for index in spread_along_path(position_m)]


def _sweep_edges(sweep: SweepView, tracks: ActorTracks) -> SweepEdges:
    beams = sweep.beams[sweep.beams.returned]
    # Direction of each beam as azimuth and elevation in the ego frame
    azimuth = torch.atan2(beams.dir_ego[:, 1], beams.dir_ego[:, 0])
    elevation = torch.asin(beams.dir_ego[:, 2].clamp(-1, 1))
    column = (azimuth / _COLUMN_RAD).round().long()
    # Negative row numbers cannot meet real channel numbers, which are at least 0
    elevation_row = (elevation / _ROW_RAD).round().long() - 10_000
    channel = torch.where(beams.beam >= 0, beams.beam.long(), elevation_row)
    # Pairs of neighbours along a channel (kind 0) and along a column (kind 1)
    pairs = [
        _pairs_before_farther(beams.range_m, channel, azimuth, _BESIDE_RAD),
        _pairs_before_farther(beams.range_m, column, elevation, _ABOVE_RAD),
    ]
    horizontal = torch.cat(
        [torch.full((len(pair),), kind, dtype=torch.bool) for kind, pair in enumerate(pairs)]
    )
    near, far = torch.cat(pairs).T
    # Moving objects are at other places when the image is taken
    static = _static(beams[near], sweep, tracks)
    near, far = near[static], far[static]
    # The edge lies between the two beams; all near beams lie inside of the outlines of what they hit.
    middle = F.normalize(beams.dir_ego[near] + beams.dir_ego[far], dim=-1)
    points_ego = beams.origin_ego[near] + beams.range_m[near, None] * middle
    return SweepEdges(sweep.t_s, sweep.T_scene_ego, points_ego, horizontal[static])


def _pairs_before_farther(
    range_m: Float[Tensor, "N"], line: Tensor, angle_rad: Float[Tensor, "N"], max_apart_rad: float
) -> Int64[Tensor, "E 2"]:
    """Return each beam and its neighbour in angle on the same line, where that hit something farther."""
    # Sort by line, then by angle: lines are whole numbers and angles span less than 10
    order = (line.double() * 10 + angle_rad).argsort()
    line, angle_rad, sorted_m = line[order], angle_rad[order], range_m[order]
    # Neighbours in the order are neighbours in angle if they share the line and are close
    near = (line[1:] == line[:-1]) & ((angle_rad[1:] - angle_rad[:-1]) < max_apart_rad)
    farther_m = sorted_m[1:] - sorted_m[:-1]
    min_jump_m = _JUMP_M + _JUMP_SHARE * torch.minimum(sorted_m[1:], sorted_m[:-1])
    # The nearer beam comes first: pairs where the second is farther, then pairs where the first is
    forwards = torch.stack([order[:-1], order[1:]], dim=-1)
    return torch.cat(
        [forwards[near & (farther_m > min_jump_m)], forwards.flip(-1)[near & (-farther_m > min_jump_m)]]
    )


def _static(beams: LidarSweep, sweep: SweepView, tracks: ActorTracks) -> Bool[Tensor, "N"]:
    """Return which beams hit static surfaces."""
    # Every actor that moves claims the points in its box; all others count as static
    states = states_at(tracks, sweep.t_s)
    moving = states.present & (states.velocity_mps.norm(dim=-1) > _MAX_STATIC_MPS)
    points_scene = transform_points(sweep.T_scene_ego, beams.points_ego)
    return actor_rows(points_scene, beams.dt_s, dataclasses.replace(states, present=moving), tracks) == STATIC
