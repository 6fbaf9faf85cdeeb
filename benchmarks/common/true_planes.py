"""True surroundings of virtual egos, drawn from above: the most that a planner could see."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Int8
from rich.progress import track
from safetensors.torch import load_file, save_file
from torch import Tensor

from foredrive.data import ClipConfig, ClipDataset, LogPath
from foredrive.data.logs import Log
from foredrive.data.truth.affordances import read_stop_lines
from foredrive.files import atomic_path
from foredrive.methods.planner.ego_mlp import ego_motion
from foredrive.scene import Boxes, Category, Clip, Command, MapKind, VoxelSpec
from foredrive.scene.record import Record
from foredrive.scene.traffic_light import LightState

SPEC = VoxelSpec(lower_m=(-32.0, -32.0, -1.5), voxel_m=2.0, shape_zyx=(1, 32, 36))
FINE = 2
"""Lines and boxes are drawn on a grid that is so many times finer, then averaged: cells keep part of where
in them something is."""
LINES = (MapKind.LANE_CENTRE, MapKind.ROAD_EDGE, MapKind.CROSSWALK, MapKind.WALKWAY, MapKind.STOP_ZONE)
LIGHTS = (LightState.GREEN, LightState.YELLOW, LightState.RED)
WALKERS = (Category.PEDESTRIAN, Category.BICYCLE)
CHANNELS = len(LINES) + len(LIGHTS) + 8
"""Kinds of lines, states of lights at their stop lines, vehicles and walkers with their velocity, direction
of lanes."""
SIDEWAYS = (CHANNELS - 6, CHANNELS - 3, CHANNELS - 1)
"""Channels that change sign in a mirror: velocities and directions along y."""
PAST, HORIZON = 3, 6
MAX_MPS = 10.0
SLACK_US = 1e4
"""Difference between times of a log and of plans that does not count, µs."""
LEVELS = 64
"""Steps of a stored channel between 0 and 1."""
_IN_BOX = (13, 5)
R = TypeVar("R", bound=Record)


@dataclass(frozen=True)
class TruePlanes(Record):
    """True surroundings, ego status and driven future of N virtual egos."""

    planes: Int8[Tensor, "N K Y X"]
    poses: Float[Tensor, "N P 3"]
    speeds: Float[Tensor, "N P+1"]
    """As of `ego_motion`, with P = `PAST`."""
    command: Int[Tensor, "N"]
    command_valid: Bool[Tensor, "N"]
    driven: Float[Tensor, "N T 3"]
    """x, y (m), yaw (rad)."""
    log: Int[Tensor, "N"]
    """Number of the log of an ego."""
    now: Int[Tensor, "N"]
    """Number of the frame in its log."""
    window: Int[Tensor, "N"]
    """Number of the stretch of traffic that an ego is taken from: its egos see the same."""

    def volumes(self) -> Float[Tensor, "N K 1 Y X"]:
        """Return the planes as volumes of one layer."""
        return self.planes[:, :, None].float() / LEVELS

    def mirrored(self) -> "TruePlanes":
        """Return the same egos with left and right exchanged."""
        planes = self.planes.flip(2)
        planes[:, SIDEWAYS] = -planes[:, SIDEWAYS]
        flip = torch.tensor([1.0, -1.0, -1.0])
        left, right = (self.command == int(side) for side in (Command.LEFT, Command.RIGHT))
        command = torch.where(left, int(Command.RIGHT), torch.where(right, int(Command.LEFT), self.command))
        return dataclasses.replace(
            self, planes=planes, poses=self.poses * flip, driven=self.driven * flip, command=command
        )


def kept(kind: type[R], file: Path, make: Callable[[], R]) -> R:
    """Return a record of tensors from a file; make it if it is missing."""
    if not file.is_file():
        made = make()
        file.parent.mkdir(parents=True, exist_ok=True)
        fields = {field.name: getattr(made, field.name) for field in dataclasses.fields(made)}
        with atomic_path(file) as temporary:
            save_file({name: tensor.contiguous() for name, tensor in fields.items()}, temporary)
    return kind(**load_file(file))


def read_planes(logs: Sequence[LogPath], clips: ClipConfig) -> TruePlanes:
    """Draw the clips of some logs whose driven future is complete and touches nobody."""
    config = dataclasses.replace(
        clips, past_frames=PAST, cameras=(), future_frames=0, future_images=False, map=True
    )
    dataset = ClipDataset(tuple(logs), config, None)
    rows, windows = [], dict[tuple[str, int], int]()
    for index in track(range(len(dataset)), description="true planes"):
        number, frames = dataset.frames_of(index)
        log = dataset.logs[number]
        # Known without reading the clip: its future is longer than the log
        last_us = log.t_us[frames[PAST]] + 1e6 * config.horizon_steps * config.horizon_dt_s
        if last_us > log.t_us[-1] + SLACK_US:
            continue
        clip = dataset.clip(index)
        if not bool(clip.future.valid.all()):
            continue
        poses, speeds = ego_motion(clip.map_tensors(lambda tensor: tensor[None]), PAST)
        stops = read_stop_lines(log, frames[PAST])
        T_ego_world = torch.linalg.inv(clip.T_world_ego[clip.now])
        plane = draw(clip, [(state, _in_ego(ends, T_ego_world)) for state, ends in stops])
        rows.append(
            TruePlanes(
                planes=(LEVELS * plane).round().clamp(-127, 127).to(torch.int8)[None],
                poses=poses,
                speeds=speeds,
                command=clip.command[None],
                command_valid=clip.command_valid[None],
                driven=torch.cat([clip.future.xy[0], clip.future.yaw[0, :, None]], dim=-1)[None],
                log=torch.tensor([number]),
                now=torch.tensor([frames[PAST]]),
                window=torch.tensor([windows.setdefault(_window(log), len(windows))]),
            )
        )
    return joined(rows)


def _window(log: Log) -> tuple[str, int]:
    """Return the recording of a log, without the number of its ego, and the beginning of its window."""
    return log.path.name.rsplit("_", 1)[0], int(log.t_us[0])


def joined(parts: Sequence[R]) -> R:
    """Return the rows of several records of tensors."""
    names = [field.name for field in dataclasses.fields(parts[0])]
    return type(parts[0])(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})


def draw(clip: Clip, stops: Sequence[tuple[LightState, Float[Tensor, "2 2"]]]) -> Float[Tensor, "K Y X"]:
    """Draw the true surroundings at the now of one clip.

    Args:
        clip: unbatched, with a map.
        stops: state and ends of each stop line with a light, ego frame, m.
    """
    assert clip.map is not None
    height, width = (FINE * cells for cells in SPEC.shape_zyx[1:])
    image = torch.zeros(CHANNELS, height, width)
    for channel, kind in enumerate(LINES):
        chosen = clip.map.kind == int(kind)
        known = clip.map.valid[chosen, 1:]
        start, end = (clip.map.vertices[chosen, part, :2][known] for part in (slice(-1), slice(1, None)))
        points, segment = _points_along(start, end)
        _put(image[channel], points, torch.ones(len(points)))
        if kind == MapKind.LANE_CENTRE:
            along = F.normalize(end - start, dim=-1)[segment]
            _put(image[-2], points, along[:, 0])
            _put(image[-1], points, along[:, 1])
    for state, ends in stops:
        if state in LIGHTS:
            points, _ = _points_along(ends[:1], ends[1:])
            _put(image[len(LINES) + LIGHTS.index(state)], points, torch.ones(len(points)))
    now = clip.boxes.map_tensors(itemgetter(clip.now))
    walks = torch.isin(now.category, torch.tensor([int(kind) for kind in WALKERS]))
    first = len(LINES) + len(LIGHTS)
    _put_boxes(image[first : first + 3], now, now.valid & ~walks)
    _put_boxes(image[first + 3 : first + 6], now, now.valid & walks)
    return F.avg_pool2d(image, FINE)


def _points_along(
    start: Float[Tensor, "S 2"], end: Float[Tensor, "S 2"]
) -> tuple[Float[Tensor, "n 2"], Int[Tensor, "n"]]:
    """Return points of segments, closer together than the fine cells, and the segment of each point."""
    count = (2 * FINE / SPEC.voxel_m * (end - start).norm(dim=-1)).ceil().long() + 1
    segment = torch.arange(len(start)).repeat_interleave(count)
    # Number of a point in its segment
    number = torch.arange(len(segment)) - (count.cumsum(0) - count)[segment]
    share = (number + 0.5) / count[segment]
    return start[segment] + share[:, None] * (end - start)[segment], segment


def _put_boxes(image: Float[Tensor, "3 y x"], boxes: Boxes, chosen: Bool[Tensor, "N"]) -> None:
    """Draw boxes: 1 and the velocity over `MAX_MPS`. Unknown velocities are 0."""
    # Points in a box, closer together than the fine cells; none is on its edge, which may be that of a cell
    along, across = torch.meshgrid(*((torch.arange(n) + 0.5) / n - 0.5 for n in _IN_BOX), indexing="ij")
    local = torch.stack([along, across], dim=-1).view(-1, 2) * boxes.size_lwh[chosen, None, :2]
    cos, sin = boxes.yaw[chosen].cos(), boxes.yaw[chosen].sin()
    R_ego_box = torch.stack([torch.stack([cos, -sin], -1), torch.stack([sin, cos], -1)], dim=-2)
    points = (local @ R_ego_box.mT + boxes.centre[chosen, None, :2]).flatten(0, 1)
    velocity = torch.nan_to_num(boxes.velocity[chosen, :2]) / MAX_MPS
    velocity = velocity.repeat_interleave(local.shape[1], dim=0)
    for channel, values in enumerate((torch.ones(len(points)), velocity[:, 0], velocity[:, 1])):
        _put(image[channel], points, values)


def _put(image: Float[Tensor, "y x"], points: Float[Tensor, "n 2"], values: Float[Tensor, "n"]) -> None:
    """Set the cells of points in the ego frame, m; those beside the image are left out."""
    x, y = ((points - torch.tensor(SPEC.lower_m[:2])) * FINE / SPEC.voxel_m).floor().long().unbind(-1)
    inside = (x >= 0) & (y >= 0) & (x < image.shape[1]) & (y < image.shape[0])
    image[y[inside], x[inside]] = values[inside]


def _in_ego(ends: Float[np.ndarray, "2 2"], T_ego_world: Float[Tensor, "4 4"]) -> Float[Tensor, "2 2"]:
    """Return the ends of a line in the ego frame, where the ground has the ego vehicle's height."""
    height = torch.linalg.inv(T_ego_world)[2, 3].expand(2, 1)
    world = torch.cat([torch.from_numpy(ends), height, torch.ones_like(height)], dim=-1)
    return (world @ T_ego_world.mT)[:, :2].float()
