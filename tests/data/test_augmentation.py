"""Augmentation: a mirrored example is a consistent recording of a mirrored world."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from small_drives import drives, one_example
from torch import Tensor

from foredrive.data.augmentation import AugmentConfig, augmented, mirrored
from foredrive.data.labels import voxel_labels
from foredrive.errors import InputError
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import exp_se3, inverse_se3, transform_points
from foredrive.scene import Example, LidarSweep, VoxelSpec

ACROSS = torch.tensor([1.0, -1.0, 1.0])
BOTH = torch.tensor([True, True])


def tensors(example: Example) -> list[Tensor]:
    found: list[Tensor] = []
    example.map_tensors(lambda tensor: found.append(tensor) or tensor)
    return found


def with_cameras(example: Example) -> Example:
    """Two cameras with skew, distortion and full rotations, in place of identities."""
    rng = torch.Generator().manual_seed(0)
    rig, shape = example.clip.rig, example.clip.rig.dist.shape[:-1]
    K = torch.tensor([[20.0, 0.7, 11.0], [0.0, 19.0, 7.0], [0.0, 0.0, 1.0]]).expand(*shape, 3, 3)
    looking = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    T_ego_cam = exp_se3(0.3 * torch.randn(*shape, 6, generator=rng))
    T_ego_cam[..., :3, :3] = T_ego_cam[..., :3, :3] @ looking
    dist = torch.tensor([-0.1, 0.02, 0.01, -0.02, 0.003]).expand(*shape, 5)
    rig = dataclasses.replace(rig, K=K, T_ego_cam=T_ego_cam, dist=dist)
    return dataclasses.replace(example, clip=dataclasses.replace(example.clip, rig=rig))


def test_a_mirrored_point_is_seen_at_the_mirrored_pixel() -> None:
    example = with_cameras(drives(0, 1))
    point = torch.tensor([9.0, 1.5, 0.4])
    other = mirrored(example, BOTH)

    def pixels(of: Example, where: Tensor) -> Tensor:
        rig = of.clip.rig
        in_camera = transform_points(inverse_se3(rig.T_ego_cam), where.expand(*rig.dist.shape[:-1], 1, 3))
        return project(in_camera, rig.K, rig.dist, rig.size_hw)[0]

    seen, mirrored_seen = pixels(example, point), pixels(other, point * ACROSS)
    width = example.clip.rig.size_hw[1]
    torch.testing.assert_close(mirrored_seen[..., 0], width - seen[..., 0], atol=1e-4, rtol=0)
    torch.testing.assert_close(mirrored_seen[..., 1], seen[..., 1], atol=1e-4, rtol=0)
    assert torch.equal(other.clip.images[..., 0], example.clip.images[..., -1])


def test_what_stands_still_stands_still_in_the_mirrored_drive() -> None:
    example = drives(0, 1)
    clip, other = example.clip, mirrored(example, BOTH).clip
    T_now_then = inverse_se3(clip.T_world_ego[:, :1]) @ clip.T_world_ego
    mirrored_now_then = inverse_se3(other.T_world_ego[:, :1]) @ other.T_world_ego
    point = torch.tensor([4.0, 2.0, 1.0]).double().expand(2, clip.t_s.shape[1], 1, 3)
    expected = transform_points(T_now_then, point) * ACROSS.double()
    torch.testing.assert_close(transform_points(mirrored_now_then, point * ACROSS.double()), expected)
    along = inverse_se3(other.T_world_ego[:, other.now : other.now + 1]) @ other.T_world_ego
    torch.testing.assert_close(along[:, other.now + 1 :, :2, 3].float(), other.future.xy[:, 0])
    turned = torch.atan2(along[..., 1, 0], along[..., 0, 0])[:, other.now + 1 :].float()
    torch.testing.assert_close(turned, other.future.yaw[:, 0], atol=1e-5, rtol=0)
    assert (other.command == 1 - clip.command).all()


def test_labels_of_a_mirrored_sweep_are_the_mirrored_labels() -> None:
    spec = VoxelSpec(lower_m=(-4.0, -4.0, -1.0), voxel_m=1.0, shape_zyx=(3, 8, 8))
    rng = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn(200, 3, generator=rng), dim=-1)
    none, yes = torch.zeros(200), torch.ones(200, dtype=torch.bool)
    sweep = LidarSweep(
        origin_ego=torch.tensor([0.1, 0.3, 0.7]).expand(200, 3),
        dir_ego=direction,
        range_m=5 * torch.rand(200, generator=rng),
        returned=yes,
        intensity=none,
        dt_s=none,
        beam=none.long(),
        valid=yes,
    )
    example = one_example(0)
    frames = example.clip.t_s.shape[1]
    batched = sweep.map_tensors(lambda tensor: tensor.expand(1, frames, *tensor.shape))
    example = dataclasses.replace(example, clip=dataclasses.replace(example.clip, sweeps=batched))
    across = mirrored(example, torch.tensor([True])).clip.sweeps[0, 0]
    labels, other = voxel_labels(sweep, spec, None, None), voxel_labels(across, spec, None, None)
    assert torch.equal(other.occupied, labels.occupied.flip(1))
    assert torch.equal(other.known, labels.known.flip(1))


def test_boxes_flow_and_grids_are_mirrored_and_other_items_are_left_alone() -> None:
    example = drives(0, 1)
    boxes = dataclasses.replace(
        example.clip.boxes,
        yaw=torch.full_like(example.clip.boxes.yaw, 0.3),
        velocity=torch.tensor([3.0, 1.0]).expand_as(example.clip.boxes.velocity),
    )
    example = dataclasses.replace(example, clip=dataclasses.replace(example.clip, boxes=boxes))
    other = mirrored(example, torch.tensor([False, True]))
    for before, after in zip(tensors(example), tensors(other), strict=True):
        assert torch.equal(before[0], after[0])
    torch.testing.assert_close(other.clip.boxes.yaw[1], torch.full_like(boxes.yaw[1], -0.3))
    assert (other.clip.boxes.velocity[1] == torch.tensor([3.0, -1.0])).all()
    flow, other_flow = example.flow.values[1], other.flow.values[1]
    assert torch.equal(other_flow[:, 1], -flow[:, 1].flip(2))
    assert torch.equal(other_flow[:, 0], flow[:, 0].flip(2))
    assert torch.equal(other.occupancy.values[1, :, 0], example.occupancy.values[1, :, 0].flip(2))
    assert torch.equal(other.flow.known[1], example.flow.known[1].flip(2))


def test_mirroring_twice_changes_nothing() -> None:
    example = with_cameras(drives(0, 1))
    for before, after in zip(tensors(example), tensors(mirrored(mirrored(example, BOTH), BOTH)), strict=True):
        torch.testing.assert_close(after, before)


def test_a_grid_with_more_on_one_side_is_refused() -> None:
    example = one_example(0)
    spec = dataclasses.replace(example.occupancy.spec, lower_m=(-2.0, -1.0, -0.5))
    lopsided = dataclasses.replace(example, occupancy=dataclasses.replace(example.occupancy, spec=spec))
    with pytest.raises(InputError, match="symmetric"):
        mirrored(lopsided, torch.tensor([True]))


def test_shares_of_items_and_cameras_are_as_configured() -> None:
    example = drives(*range(40))
    left_out = augmented(example, AugmentConfig(camera_dropout=0.25), torch.Generator().manual_seed(0))
    valid = left_out.clip.image_valid
    assert (valid == valid[:, :1]).all()  # in all frames alike
    assert math.isclose(1 - valid.float().mean().item(), 0.25, abs_tol=0.1)
    assert not left_out.clip.images[~valid].any()
    assert torch.equal(left_out.clip.images[valid], example.clip.images[valid])
    half = augmented(example, AugmentConfig(mirror=0.5), torch.Generator().manual_seed(0))
    changed = (half.clip.future.yaw != example.clip.future.yaw).flatten(1).any(1)
    assert 10 < int(changed.sum()) < 30


def test_colour_changes_all_frames_and_cameras_of_an_item_alike() -> None:
    example = drives(0, 1)
    grey = torch.full_like(example.clip.images, 100)
    example = dataclasses.replace(example, clip=dataclasses.replace(example.clip, images=grey))
    config = AugmentConfig(colour=0.4)
    images = augmented(example, config, torch.Generator().manual_seed(1)).clip.images
    again = augmented(example, config, torch.Generator().manual_seed(1)).clip.images
    assert torch.equal(images, again)
    per_item = [np.unique(images[item].transpose(0, 2).flatten(1).numpy(), axis=1) for item in range(2)]
    assert all(values.shape == (3, 1) for values in per_item)
    assert not np.array_equal(*per_item)
    assert images.min() >= 100 * 0.6 * 0.8 - 1
    assert images.max() <= 100 * 1.4 * 1.2 + 1


def test_without_augmentation_nothing_is_drawn() -> None:
    generator = torch.Generator().manual_seed(0)
    state = generator.get_state()
    example = drives(0)
    after = augmented(example, AugmentConfig(), generator)
    assert torch.equal(generator.get_state(), state)
    assert all(one is other for one, other in zip(tensors(example), tensors(after), strict=True))
