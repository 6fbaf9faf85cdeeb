"""Reconstruction and planning losses."""

import math

import pytest
import torch

from foredrive.geometry.se3 import matrix_from_yaw
from foredrive.heads.plan_losses import ego_motion_loss, waypoint_loss
from foredrive.methods.blocks.losses import l1_loss, perceptual_loss
from foredrive.scene import Trajectory, VoxelSpec


def trajectory(xy: list[list[float]], valid: list[bool]) -> Trajectory:
    points = torch.tensor(xy)[None, None]
    return Trajectory(
        xy=points,
        yaw=torch.zeros(points.shape[:-1]),
        valid=torch.tensor(valid)[None, None],
        log_prob=torch.zeros(1, 1),
        dt_s=0.5,
    )


def test_waypoint_loss_is_a_mean_distance_over_valid_steps() -> None:
    plan = trajectory([[3.0, 4.0], [1.0, 0.0], [100.0, 0.0]], [True] * 3)
    driven = trajectory([[0.0, 0.0], [1.0, 2.0], [0.0, 0.0]], [True, True, False])
    torch.testing.assert_close(waypoint_loss(plan, driven), torch.tensor(3.5))


def test_ego_motion_loss_is_the_mean_displacement_of_the_corners() -> None:
    """Two items: 3 m too far to the left, and 60 degrees too far round."""
    spec = VoxelSpec(lower_m=(0.0, 0.0, 0.0), voxel_m=1.0, shape_zyx=(1, 10, 10))
    yaw = torch.tensor([0.4, -1.2], dtype=torch.float64)
    then = matrix_from_yaw(
        torch.tensor([0.3, 0.5]).double(), torch.tensor([[4.0, 1.0, 0.2], [2.0, 0.0, 0.0]]).double()
    )
    T_world_now = matrix_from_yaw(yaw, torch.tensor([[70.0, -20.0, 1.0], [5.0, 9.0, 2.0]]).double())
    left = matrix_from_yaw(torch.zeros(1).double(), torch.tensor([[0.0, 3.0, 0.0]]).double())[0]
    turned = matrix_from_yaw(torch.full((1,), math.pi / 3).double(), torch.zeros(1, 3).double())[0]
    predicted = torch.stack([left @ then[0], then[1] @ turned]).float()
    error_m = ego_motion_loss(predicted, T_world_now, T_world_now @ then, spec)
    # A corner at distance r moves by 2 r sin 30° = r: mean of 0, 10, 10, 10√2 (twice, for two heights).
    assert error_m.item() == pytest.approx((3.0 + (20.0 + 10.0 * math.sqrt(2.0)) / 4) / 2, abs=1e-5)


def test_ego_motion_loss_has_a_gradient_at_zero_error() -> None:
    spec = VoxelSpec(lower_m=(0.0, 0.0, 0.0), voxel_m=1.0, shape_zyx=(1, 2, 2))
    predicted = torch.eye(4).repeat(2, 1, 1).requires_grad_()
    pose = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    ego_motion_loss(predicted, pose, pose, spec).backward()
    assert predicted.grad is not None
    assert predicted.grad.isfinite().all()


def test_waypoint_loss_has_a_gradient_at_zero_error() -> None:
    plan = trajectory([[0.0, 0.0]], [True])
    plan.xy.requires_grad_()
    waypoint_loss(plan, trajectory([[0.0, 0.0]], [True])).backward()
    assert plan.xy.grad is not None
    assert plan.xy.grad.isfinite().all()


def test_invalid_images_do_not_count() -> None:
    truth = torch.zeros(2, 3, 4, 4)
    predicted = torch.stack([torch.full((3, 4, 4), 0.25), torch.ones(3, 4, 4)])
    loss = l1_loss(predicted, truth, torch.tensor([True, False]))
    torch.testing.assert_close(loss, torch.tensor(0.25))
    assert l1_loss(predicted, truth, torch.tensor([False, False])).item() == 0


def test_perceptual_loss_sums_layers_of_valid_images() -> None:
    truth = torch.zeros(2, 3, 4, 4)
    predicted = torch.stack([torch.full((3, 4, 4), 0.5), torch.ones(3, 4, 4)])
    loss = perceptual_loss(predicted, truth, torch.tensor([True, False]), lambda rgb: (rgb, 2 * rgb))
    torch.testing.assert_close(loss, torch.tensor(0.5 + 1.0))
