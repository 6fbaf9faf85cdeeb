"""Small made-up drives with everything that an evaluation reads."""

import dataclasses
import math

import torch

from foredrive.geometry.se3 import inverse_se3, matrix_from_yaw, transform_points, yaw_from_matrix
from foredrive.scene import (
    Boxes,
    CameraRig,
    Category,
    Clip,
    Command,
    Example,
    LidarSweep,
    Trajectory,
    VoxelGrid,
    VoxelSpec,
)
from foredrive.scene.boxes import unlabelled

SPEC = VoxelSpec(lower_m=(-2.0, -2.0, -0.5), voxel_m=0.5, shape_zyx=(4, 8, 8))
PAST, FUTURE, DT_S = 2, 6, 0.5
CAMERAS, IMAGE_HW = 2, (16, 24)


def one_example(seed: int) -> Example:
    """Item `seed` of the drives: a vehicle on a circle, one car far off, random voxels and images."""
    generator = torch.Generator().manual_seed(seed)
    frames, c = PAST + 1 + FUTURE, CAMERAS
    speed_mps = 2.0 + 6.0 * torch.rand(1, generator=generator).item()
    turn_radps = 0.2 * torch.randn(1, generator=generator).item()
    t_s = (torch.arange(frames) - PAST) * DT_S
    yaw = turn_radps * t_s.double() + seed
    step = speed_mps * DT_S * torch.stack([yaw.cos(), yaw.sin(), torch.zeros_like(yaw)], dim=-1)
    T_world_ego = matrix_from_yaw(yaw, 1000.0 + step.cumsum(dim=0))
    T_now_ego = inverse_se3(T_world_ego[PAST : PAST + 1]) @ T_world_ego
    car = transform_points(
        inverse_se3(T_now_ego), torch.tensor([[0.0, 30.0, 0.8]]).double().expand(frames, 1, 3)
    )
    none = torch.zeros(1, frames, 0)
    clip = Clip(
        t_s=t_s[None].float(),
        T_world_ego=T_world_ego[None],
        images=torch.randint(0, 256, (1, frames, c, 3, *IMAGE_HW), generator=generator, dtype=torch.uint8),
        image_valid=torch.ones(1, frames, c, dtype=torch.bool),
        rig=CameraRig(
            K=torch.eye(3).expand(1, frames, c, 3, 3),
            T_ego_cam=torch.eye(4).expand(1, frames, c, 4, 4),
            dist=torch.zeros(1, frames, c, 5),
            readout_s=torch.zeros(1, frames, c),
            names=("left", "right"),
            size_hw=IMAGE_HW,
        ),
        sweeps=LidarSweep(
            origin_ego=torch.zeros(1, frames, 0, 3),
            dir_ego=torch.zeros(1, frames, 0, 3),
            range_m=none,
            returned=none.bool(),
            intensity=none,
            dt_s=none,
            beam=none.long(),
            valid=none.bool(),
        ),
        sweep_valid=torch.zeros(1, frames, dtype=torch.bool),
        misses_known=torch.zeros(1, frames, dtype=torch.bool),
        boxes=Boxes(
            centre=car[None].float(),
            size_lwh=torch.tensor([4.0, 2.0, 1.6]).expand(1, frames, 1, 3),
            yaw=torch.zeros(1, frames, 1),
            velocity=torch.zeros(1, frames, 1, 2),
            track_id=torch.ones(1, frames, 1, dtype=torch.long),
            category=torch.full((1, frames, 1), int(Category.CAR)),
            valid=torch.ones(1, frames, 1, dtype=torch.bool),
            **unlabelled(1, frames, 1),
        ),
        boxes_valid=torch.ones(1, frames, dtype=torch.bool),
        ego_speed_mps=torch.full((1, frames), speed_mps),
        ego_speed_valid=torch.ones(1, frames, dtype=torch.bool),
        command=torch.tensor([int(Command.LEFT if turn_radps > 0 else Command.RIGHT)]),
        command_valid=torch.ones(1, dtype=torch.bool),
        route_xy=torch.zeros(1, 7, 2),
        route_valid=torch.zeros(1, 7, dtype=torch.bool),
        future=Trajectory(
            xy=T_now_ego[None, None, PAST + 1 :, :2, 3].float(),
            yaw=yaw_from_matrix(T_now_ego)[None, None, PAST + 1 :].float(),
            valid=torch.ones(1, 1, FUTURE, dtype=torch.bool),
            log_prob=torch.zeros(1, 1),
            dt_s=DT_S,
        ),
    )
    assert math.isclose(clip.t_s[0, clip.now].item(), 0.0)
    occupied = (torch.rand(1, frames, 1, *SPEC.shape_zyx, generator=generator) < 0.2).float()
    known = torch.rand(1, frames, *SPEC.shape_zyx, generator=generator) < 0.9
    flow = 2.0 * torch.randn(1, frames, 3, *SPEC.shape_zyx, generator=generator)
    return Example(
        clip,
        VoxelGrid(SPEC, occupied, known),
        VoxelGrid(SPEC, flow, known & (occupied[:, :, 0] > 0)),
        (f"drive@{seed}",),
    )


def join(examples: list[Example]) -> Example:
    """Concatenate along the batch; everything here has one shape."""

    def cat(values: list):  # type: ignore[no-untyped-def, type-arg]
        first = values[0]
        if isinstance(first, torch.Tensor):
            return torch.cat(values)
        if hasattr(first, "map_tensors"):
            names = [field.name for field in dataclasses.fields(first)]
            return type(first)(**{name: cat([getattr(v, name) for v in values]) for name in names})
        return first

    joined = cat(examples)
    return Example(joined.clip, joined.occupancy, joined.flow, tuple(e.key[0] for e in examples))


def drives(*seeds: int) -> Example:
    """Return a batch from the numbers of its items."""
    return join([one_example(seed) for seed in seeds])
