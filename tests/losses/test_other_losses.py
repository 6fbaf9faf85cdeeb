"""Reconstruction and planning losses."""

import torch

from foredrive.losses import l1_loss, perceptual_loss, waypoint_loss
from foredrive.scene import Trajectory


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
