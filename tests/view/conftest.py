"""A small street whose sensors are ray cast exactly: pictures of it can be computed by hand."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from foredrive.geometry.boxes import points_in_boxes
from foredrive.geometry.projection import pixel_centres, pixels_to_rays
from foredrive.geometry.se3 import rotate_vectors
from foredrive.scene import (
    Boxes,
    CameraRig,
    Category,
    Clip,
    Command,
    Example,
    LidarSweep,
    MapKind,
    MapPatch,
    Trajectory,
    VoxelGrid,
    VoxelSpec,
)
from foredrive.scene.boxes import unlabelled

SIZE_HW = (54, 96)
SPEC = VoxelSpec(lower_m=(-16.0, -16.0, -1.0), voxel_m=1.0, shape_zyx=(5, 32, 32))
AZIMUTH_DEG = {
    "front": 0,
    "front_left": 55,
    "front_right": -55,
    "back": 180,
    "back_left": 110,
    "back_right": -110,
}
ACTORS = [  # x, y, z, l, w, h, yaw, speed, category
    (12.0, 0.0, 0.8, 4.5, 1.9, 1.6, 0.0, 6.0, Category.CAR),
    (6.0, 4.0, 0.8, 4.4, 1.8, 1.6, math.pi, 4.0, Category.CAR),
    (-9.0, -4.5, 1.5, 8.0, 2.5, 3.0, 0.1, 0.0, Category.BUS),
    (8.0, -5.5, 0.9, 0.6, 0.6, 1.8, 1.6, 1.4, Category.PEDESTRIAN),
    (3.0, -13.0, 3.0, 14.0, 4.0, 6.0, 0.0, 0.0, Category.OTHER),
]
NOW, FRAMES = 1, 3


def ray_cast(origin: Tensor, direction: Tensor, boxes: Boxes) -> tuple[Tensor, Tensor]:
    """Range to the nearest of ground and boxes, and what was hit: -1 sky, 0 ground, 1 + box."""
    down = direction[:, 2] < -1e-6
    ground = torch.where(
        down, -origin[:, 2] / direction[:, 2].clamp_max(-1e-6), torch.full_like(origin[:, 2], 1e9)
    )
    ranges = [torch.full_like(ground, 1e8), ground]
    for centre, size, yaw in zip(boxes.centre, boxes.size_lwh, boxes.yaw, strict=True):
        cos, sin = float(yaw.cos()), float(yaw.sin())
        R = torch.tensor([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1.0]])
        o, d = (origin - centre) @ R.T, direction @ R.T
        safe = torch.where(d.abs() < 1e-9, torch.full_like(d, 1e-9), d)
        one, two = (-size / 2 - o) / safe, (size / 2 - o) / safe
        enter, leave = torch.minimum(one, two).amax(-1), torch.maximum(one, two).amin(-1)
        ranges.append(torch.where((enter < leave) & (enter > 0), enter, torch.full_like(enter, 1e9)))
    nearest, hit = torch.stack(ranges).min(0)
    return nearest, hit - 1


def make_rig() -> CameraRig:
    """Six pinhole cameras of 70 degrees, 1.6 m above the ground."""
    focal = SIZE_HW[1] / 2 / math.tan(math.radians(35))
    K = torch.tensor([[focal, 0, SIZE_HW[1] / 2], [0, focal, SIZE_HW[0] / 2], [0, 0, 1]])
    poses = []
    for degrees in AZIMUTH_DEG.values():
        cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        pose = torch.eye(4)
        pose[:3, :3] = torch.tensor([[sin, 0, cos], [-cos, 0, sin], [0, -1, 0]])
        pose[:3, 3] = torch.tensor([0.8 + 0.5 * cos, 0.5 * sin, 1.6])
        poses.append(pose)
    count = len(poses)
    return CameraRig(
        K.expand(count, 3, 3),
        torch.stack(poses),
        torch.zeros(count, 5),
        torch.zeros(count),
        tuple(AZIMUTH_DEG),
        SIZE_HW,
    )


def make_boxes(seconds: float) -> Boxes:
    """The street's actors after some time."""
    rows = torch.tensor([[float(v) for v in actor] for actor in ACTORS])
    velocity = torch.stack([rows[:, 6].cos(), rows[:, 6].sin()], -1) * rows[:, 7:8]
    centre = rows[:, :3].clone()
    centre[:, :2] += velocity * seconds
    count = len(rows)
    return Boxes(
        centre,
        rows[:, 3:6],
        rows[:, 6],
        velocity,
        torch.arange(count),
        rows[:, 8].long(),
        torch.ones(count).bool(),
        **unlabelled(count),
    )


def make_images(rig: CameraRig, boxes: Boxes) -> Tensor:
    """[C 3 H W]: sky, grey road, and each box in its own colour."""
    rays = pixels_to_rays(
        pixel_centres(SIZE_HW).reshape(1, -1, 2).expand(len(rig.names), -1, -1), rig.K, rig.dist
    )
    direction = rotate_vectors(rig.T_ego_cam, rays)
    origin = rig.T_ego_cam[:, None, :3, 3].expand_as(direction)
    distance, hit = ray_cast(origin.reshape(-1, 3), direction.reshape(-1, 3), boxes)
    colours = torch.tensor(
        [[150, 190, 230], [92, 94, 98], *[[60 + 37 * i, 180 - 25 * i, 90 + 20 * i] for i in range(5)]]
    )
    shade = (1 - distance / 120).clamp(0.4, 1)[:, None] * (hit >= 0)[:, None] + (hit < 0)[:, None]
    rgb = (colours[hit + 1] * shade).to(torch.uint8)
    return rgb.reshape(len(rig.names), *SIZE_HW, 3).permute(0, 3, 1, 2)


def make_sweep(boxes: Boxes) -> LidarSweep:
    """24 beams x 240 azimuths from 1.9 m above the ground, misses at 60 m."""
    azimuth = torch.linspace(-math.pi, math.pi, 241)[:-1]
    elevation = torch.linspace(-0.45, 0.12, 24)
    e, a = torch.meshgrid(elevation, azimuth, indexing="ij")
    direction = torch.stack([e.cos() * a.cos(), e.cos() * a.sin(), e.sin()], -1).reshape(-1, 3)
    origin = torch.tensor([0.9, 0.0, 1.9]).expand_as(direction)
    distance, _ = ray_cast(origin, direction, boxes)
    returned = distance < 60
    count = len(direction)
    return LidarSweep(
        origin,
        direction,
        distance.clamp_max(60),
        returned,
        0.4 * returned.float(),
        torch.zeros(count),
        torch.arange(24).repeat_interleave(240),
        torch.ones(count).bool(),
    )


def make_map() -> MapPatch:
    """A straight road with a crosswalk."""
    x = torch.linspace(-40, 40, 9)
    lines = [
        (MapKind.LANE_CENTRE, 0.0),
        (MapKind.LANE_BOUNDARY, 2.0),
        (MapKind.ROAD_EDGE, -3.5),
        (MapKind.ROAD_EDGE, 6),
    ]
    vertices = torch.zeros(5, 9, 3)
    valid = torch.ones(5, 9, dtype=torch.bool)
    for row, (_, y) in enumerate(lines):
        vertices[row, :, 0], vertices[row, :, 1] = x, y
    vertices[4, :5, :2] = torch.tensor([[16.0, -3.5], [19.0, -3.5], [19.0, 6.0], [16.0, 6.0], [16.0, -3.5]])
    valid[4, 5:] = False
    return MapPatch(vertices, valid, torch.tensor([*[kind for kind, _ in lines], MapKind.CROSSWALK]))


def make_occupancy(boxes: Boxes) -> tuple[Tensor, Tensor]:
    """[1 Z Y X] occupied (boxes, the layer below ground) and [Z Y X] known (within 18 m)."""
    centres = SPEC.centres_m()
    inside = points_in_boxes(centres.reshape(-1, 3), boxes.centre, boxes.size_lwh + 0.5, boxes.yaw)
    occupied = inside.any(-1).reshape(SPEC.shape_zyx) | (centres[..., 2] < 0)
    known = centres[..., :2].norm(dim=-1) < 18
    return (occupied & known)[None].float(), known


def stack(records: list) -> object:
    """Stack records of equal shape along a new leading dimension."""
    first = records[0]
    tensors = iter([torch.stack(values) for values in zip(*(_tensors(r) for r in records), strict=True)])
    return first.map_tensors(lambda _: next(tensors))


def _tensors(record: object) -> list[Tensor]:
    found: list[Tensor] = []
    record.map_tensors(lambda t: found.append(t) or t)
    return found


def make_clip() -> Clip:
    """Three key frames, now in the middle, of a vehicle that stands still for them (so ego = world)."""
    rig = make_rig()
    at = [make_boxes(0.5 * (i - NOW)) for i in range(FRAMES)]
    future_x = torch.arange(1, 7) * 1.5
    return Clip(
        t_s=torch.arange(FRAMES) * 0.5 - 0.5 * NOW,
        T_world_ego=torch.eye(4, dtype=torch.float64).expand(FRAMES, 4, 4).clone(),
        images=torch.stack([make_images(rig, boxes) for boxes in at]),
        image_valid=torch.ones(FRAMES, len(rig.names), dtype=torch.bool),
        rig=stack([rig] * FRAMES),
        sweeps=stack([make_sweep(boxes) for boxes in at]),
        sweep_valid=torch.ones(FRAMES, dtype=torch.bool),
        misses_known=torch.ones(FRAMES, dtype=torch.bool),
        boxes=stack(at),
        boxes_valid=torch.ones(FRAMES, dtype=torch.bool),
        ego_speed_mps=torch.full((FRAMES,), 3.0),
        ego_speed_valid=torch.ones(FRAMES, dtype=torch.bool),
        command=torch.tensor(Command.STRAIGHT),
        command_valid=torch.tensor(True),
        route_xy=torch.zeros(7, 2),
        route_valid=torch.zeros(7, dtype=torch.bool),
        future=Trajectory(
            torch.stack([future_x, 0.02 * future_x**2], -1)[None],
            torch.zeros(1, 6),
            torch.ones(1, 6, dtype=torch.bool),
            torch.zeros(1),
            0.5,
        ),
        map=make_map(),
    )


@pytest.fixture(scope="session")
def clip() -> Clip:
    return make_clip()


@pytest.fixture(scope="session")
def example(clip: Clip) -> Example:
    grids = [make_occupancy(clip.boxes[i]) for i in range(FRAMES)]
    occupied = torch.stack([values for values, _ in grids])
    known = torch.stack([mask for _, mask in grids])
    flow = torch.zeros(FRAMES, 3, *SPEC.shape_zyx)
    return Example(
        clip,
        VoxelGrid(SPEC, occupied, known),
        VoxelGrid(SPEC, flow, occupied[:, 0].bool() & known),
        ("street_0.5",),
    )


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)
