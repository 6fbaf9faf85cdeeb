"""Ego status: what a vehicle knows of itself."""

import dataclasses
import math

import pytest
import torch
from small_drives import drives

from foredrive.errors import InputError
from foredrive.methods.planner.ego_mlp import ego_motion, ego_speeds, ego_status, motion_rates
from foredrive.scene import Command
from foredrive.scene.clip import TARGET


def test_the_ego_status_by_hand() -> None:
    example = drives(3)
    clip = example.clip
    clip.ego_speed_mps[:] = torch.arange(clip.t_s.shape[1])[None].float()
    clip.ego_speed_valid[0, clip.now - 1] = False
    clip.command[:] = int(Command.STRAIGHT)
    status = ego_status(clip, past_frames=2)[0]
    assert status.shape == (2 * 3 + 3 + 3,)
    # Two poses before now, in the ego frame at now: behind it.
    assert status[0] < status[3] < 0
    way_m = clip.T_world_ego[0, clip.now - 1, :3, 3] - clip.T_world_ego[0, clip.now - 2, :3, 3]
    estimate = way_m.norm().item() / (clip.t_s[0, clip.now - 1] - clip.t_s[0, clip.now - 2]).item()
    assert estimate > 1.0
    assert status[6:9].tolist() == pytest.approx([0.0, estimate, 2.0])  # the unknown one follows from poses
    assert status[9:].tolist() == [0.0, 0.0, 1.0]  # left, right, straight
    clip.command_valid[:] = False
    assert ego_status(clip, past_frames=2)[0, 9:].tolist() == [0.0, 0.0, 0.0]
    torch.testing.assert_close(ego_status(clip, 2), ego_status(clip.observed(), 2))
    clip.route_xy[:, TARGET], clip.route_valid[:] = torch.tensor([19.0, -4.0]), True
    assert ego_status(clip, past_frames=0, target=True)[0].tolist() == [2.0, 0.0, 0.0, 0.0, 19.0, -4.0, 1.0]
    clip.route_valid[:] = False
    assert ego_status(clip, past_frames=0, target=True)[0].tolist() == [2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    with pytest.raises(InputError, match="needs 5 frames before now"):
        ego_status(clip, past_frames=5)


def test_rates_by_hand() -> None:
    """A left curve that is driven faster and faster, and a vehicle that stands and whose pose trembles."""
    poses = torch.tensor([[[-4.0, 0.3, -0.2], [-2.0, 0.1, -0.1]], [[-0.01, 0.0, 0.0], [-0.01, 0.0, 0.02]]])
    speeds = torch.tensor([[3.0, 4.0, 5.0], [0.0, 0.0, 0.0]])
    curvature = 0.1 / math.hypot(2.0, 0.1)
    curve, stands = motion_rates(poses, speeds)
    expected = torch.tensor([1.0, 1.0, 0.1, 0.1, curvature, 25.0, 5.0, 5 * curvature])
    torch.testing.assert_close(curve, expected)
    torch.testing.assert_close(stands, torch.tensor([0.0, 0.0, 0.02, -0.02, 0.0, 0.0, 0.0, 0.0]))
    clip = drives(1).clip
    status = ego_status(clip, 2, rates=True)
    torch.testing.assert_close(status[:, -8:], motion_rates(*ego_motion(clip, 2)))
    torch.testing.assert_close(status[:, :-8], ego_status(clip, 2))


def test_the_status_does_not_depend_on_where_in_the_world_one_is() -> None:
    clip = drives(1).clip
    moved = dataclasses.replace(
        clip, T_world_ego=clip.T_world_ego[:, 0].inverse()[:, None] @ clip.T_world_ego
    )
    torch.testing.assert_close(ego_status(clip, 2), ego_status(moved, 2), atol=1e-4, rtol=0)


def test_unknown_speeds_follow_from_poses_that_may_be_seen() -> None:
    clip = drives(1).clip
    clip.T_world_ego[:, :, :3, 3] = 0.0
    clip.T_world_ego[:, :, 0, 3] = torch.arange(clip.t_s.shape[1]).cumsum(0)
    clip.ego_speed_valid[:] = False
    clip.ego_speed_mps[:] = torch.nan
    assert ego_speeds(clip)[0, :4].tolist() == pytest.approx(
        [2.0, 2.0, 4.0, 6.0]
    )  # 0, 1, 3, 6 m, 0.5 s apart
    clip.ego_speed_valid[:, 2], clip.ego_speed_mps[:, 2] = True, 4.5
    assert ego_speeds(clip)[0, :4].tolist() == pytest.approx([2.0, 2.0, 4.5, 6.0])
    assert ego_speeds(clip.frames(slice(0, 1)))[0].tolist() == [0.0]
