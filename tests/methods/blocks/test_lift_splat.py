"""Lift, splat: a feature ends where its depth says, and nowhere else."""

import dataclasses
from collections.abc import Callable

import torch

from foredrive.methods.blocks.lift_splat import LiftSplatConfig, LiftSplatEncoder, splat
from foredrive.scene import CameraRig, Example, VoxelSpec

SPEC = VoxelSpec(lower_m=(-8.0, -8.0, -1.0), voxel_m=1.0, shape_zyx=(4, 16, 16))


def rig_of(make_example: Callable[..., Example]) -> CameraRig:
    """Two cameras 1.6 m up, one looking ahead and one back."""
    return make_example(batch=1, past=0, future=0, spec=SPEC).clip.rig[:, 0]


def encoder() -> LiftSplatEncoder:
    torch.manual_seed(0)
    depths = LiftSplatConfig(near_m=1.0, far_m=10.0, step_m=1.0)
    return LiftSplatEncoder(depths, SPEC, channels=3, plane_channels=4, levels=1)


def test_depths_lie_along_the_optical_axis(make_example: Callable[..., Example]) -> None:
    points = encoder().points_m(rig_of(make_example), (2, 4)).view(2, 2, 4, 9, 3)
    ahead, back = points
    torch.testing.assert_close(ahead[..., 0], torch.arange(1.0, 10.0).expand(2, 4, 9))
    torch.testing.assert_close(back[..., 0], -torch.arange(1.0, 10.0).expand(2, 4, 9))
    # 32 × 64 px at a focal length of 40 px: the second of four features is 8 px left of the middle.
    torch.testing.assert_close(ahead[0, 1, :, 1], torch.arange(1.0, 10.0) * 8 / 40)
    torch.testing.assert_close(ahead[0, 1, :, 2], 1.6 + torch.arange(1.0, 10.0) * 8 / 40)


def test_what_falls_into_a_cell_is_summed_and_the_rest_is_gone(make_example: Callable[..., Example]) -> None:
    lift = encoder()
    cell, inside = lift.cells(rig_of(make_example), (2, 4))
    share, feature = torch.rand(1, 16, 9), torch.rand(1, 16, 5)
    values = (share[..., None] * feature[:, :, None]).flatten(1, 2)
    plane = splat(share, feature, cell, inside, (16, 16))
    torch.testing.assert_close(plane.sum(dim=(2, 3)), (values * inside[..., None]).sum(1))
    points = lift.points_m(rig_of(make_example), (2, 4))[0]
    one = int(inside[0].nonzero()[7])
    x, y = (points[one, :2] + 8).floor().long().tolist()
    there = (cell[0] == y * 16 + x) & inside[0]
    torch.testing.assert_close(plane[0, :, y, x], values[0, there].sum(0))
    assert not inside[0][points[:, 0].abs() > 8].any()


def test_a_camera_that_is_not_valid_adds_nothing(make_example: Callable[..., Example]) -> None:
    lift, rig = encoder(), rig_of(make_example)
    features = [torch.randn(1, 2, 2, 4, 3)]
    both, ahead = torch.tensor([[True, True]]), torch.tensor([[True, False]])
    changed = [torch.cat([features[0][:, :1], torch.randn(1, 1, 2, 4, 3)], dim=1)]
    assert torch.equal(lift(features, rig, ahead), lift(changed, rig, ahead))
    assert not torch.equal(lift(features, rig, both), lift(changed, rig, both))
    far = dataclasses.replace(rig, T_ego_cam=rig.T_ego_cam + 1000 * torch.eye(4)[:, 3:] * torch.eye(4)[3:, :])
    assert lift(features, far, both).isfinite().all()
