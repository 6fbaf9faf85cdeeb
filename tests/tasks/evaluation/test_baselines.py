"""Planners that see nothing."""

import dataclasses
from collections.abc import Callable

import pytest
import torch

from foredrive.errors import InputError
from foredrive.methods.planner.baselines import ConstantVelocity, StandStill
from foredrive.scene import Example

MakeExample = Callable[..., Example]


def test_stand_still(make_example: MakeExample) -> None:
    plan = StandStill(6, 0.5).act(make_example(0, 1).clip.observed())
    assert plan.xy.shape == (2, 1, 6, 2)
    assert not plan.xy.any()
    assert plan.valid.all()


def test_constant_velocity_by_hand(make_example: MakeExample) -> None:
    clip = make_example(0, 1).clip.observed()
    clip.ego_speed_mps[:] = torch.tensor([[4.0], [10.0]])
    plan = ConstantVelocity(3, 0.5).act(clip)
    assert plan.xy[:, 0, :, 0].tolist() == [[2.0, 4.0, 6.0], [5.0, 10.0, 15.0]]
    assert not plan.xy[..., 1].any()
    assert not plan.yaw.any()
    # Without a speed, poses tell: one item travelled 2.5 m in the last half second.
    clip.ego_speed_valid[1] = False
    now = clip.now
    clip.T_world_ego[1, now, :3, 3] = clip.T_world_ego[1, now - 1, :3, 3] + torch.tensor([1.5, 2.0, 0.0])
    torch.testing.assert_close(ConstantVelocity(1, 0.5).act(clip).xy[:, 0, 0, 0], torch.tensor([2.0, 2.5]))
    quicker = dataclasses.replace(clip, t_s=0.5 * clip.t_s)  # 2.5 m in a quarter of a second
    torch.testing.assert_close(ConstantVelocity(1, 0.5).act(quicker).xy[:, 0, 0, 0], torch.tensor([2.0, 5.0]))
    with pytest.raises(InputError, match="earlier pose"):
        ConstantVelocity(1, 0.5).act(clip.frames([now]))
