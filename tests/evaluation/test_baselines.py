"""Planners that see nothing."""

import dataclasses
from collections.abc import Callable

import pytest
import torch

from foredrive.errors import InputError
from foredrive.evaluation import ConstantVelocity, StandStill, fit_ego_mlp, read_training_set
from foredrive.models.ego_mlp import EgoMLP, ego_status
from foredrive.scene import Command, Example

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
    with pytest.raises(InputError, match="earlier pose"):
        ConstantVelocity(1, 0.5).act(clip.frames([now]))


def test_the_ego_status_by_hand(make_example: MakeExample) -> None:
    example = make_example(3)
    clip = example.clip
    clip.ego_speed_mps[:] = torch.arange(clip.t_s.shape[1])[None].float()
    clip.ego_speed_valid[0, clip.now - 1] = False
    clip.command[:] = int(Command.STRAIGHT)
    status = ego_status(clip, past_frames=2)[0]
    assert status.shape == (2 * 3 + 3 + 3,)
    # Two poses before now, in the ego frame at now: behind it.
    assert status[0] < status[3] < 0
    assert status[6:9].tolist() == [0.0, 0.0, 2.0]  # speeds, the unknown one 0
    assert status[9:].tolist() == [0.0, 0.0, 1.0]  # left, right, straight
    clip.command_valid[:] = False
    assert ego_status(clip, past_frames=2)[0, 9:].tolist() == [0.0, 0.0, 0.0]
    torch.testing.assert_close(ego_status(clip, 2), ego_status(clip.observed(), 2))
    clip.target_xy[:], clip.target_valid[:] = torch.tensor([19.0, -4.0]), True
    assert ego_status(clip, past_frames=0, target=True)[0].tolist() == [2.0, 0.0, 0.0, 0.0, 19.0, -4.0, 1.0]
    clip.target_valid[:] = False
    assert ego_status(clip, past_frames=0, target=True)[0].tolist() == [2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    with pytest.raises(InputError, match="needs 5 frames before now"):
        ego_status(clip, past_frames=5)


def test_the_status_does_not_depend_on_where_in_the_world_one_is(make_example: MakeExample) -> None:
    clip = make_example(1).clip
    moved = dataclasses.replace(
        clip, T_world_ego=clip.T_world_ego[:, 0].inverse()[:, None] @ clip.T_world_ego
    )
    torch.testing.assert_close(ego_status(clip, 2), ego_status(moved, 2), atol=1e-4, rtol=0)


def test_the_ego_mlp_learns_what_the_status_gives_away(make_example: MakeExample) -> None:
    # Vehicles on circles: the past says exactly what comes next.
    _, data = read_training_set([make_example(*range(100))], frames=3, past_frames=2)
    model = fit_ego_mlp(data, past_frames=2, dt_s=0.5, seed=0, steps=300)
    test = make_example(*range(200, 240))
    observed, driven = test.clip.observed(), test.clip.future.xy
    error_m = (model.act(observed).xy - driven).norm(dim=-1).mean()
    straight_m = (ConstantVelocity(6, 0.5).act(observed).xy - driven).norm(dim=-1).mean()
    assert error_m < 0.5 * straight_m
    again = fit_ego_mlp(data, past_frames=2, dt_s=0.5, seed=0, steps=300)
    other = fit_ego_mlp(data, past_frames=2, dt_s=0.5, seed=1, steps=300)
    assert torch.equal(again.act(observed).xy, model.act(observed).xy)
    assert not torch.equal(other.act(observed).xy, model.act(observed).xy)


def test_steps_that_were_not_driven_teach_nothing(make_example: MakeExample) -> None:
    _, data = read_training_set([make_example(*range(20))], frames=1, past_frames=2)
    valid = data.valid.clone()
    valid[::2, 3:] = False
    spoilt = torch.where(valid[..., None], data.driven, torch.full_like(data.driven, 1e6))
    kept = torch.where(valid[..., None], data.driven, torch.zeros_like(data.driven))
    plans = [
        fit_ego_mlp(
            dataclasses.replace(data, driven=driven, valid=valid), past_frames=2, dt_s=0.5, seed=0, steps=5
        )(data.status)
        for driven in (spoilt, kept)
    ]
    assert torch.equal(*plans)


def test_one_clip_is_enough_to_train_on(make_example: MakeExample) -> None:
    prior, data = read_training_set([make_example(0)], frames=2, past_frames=1)
    model = fit_ego_mlp(data, past_frames=1, dt_s=0.5, seed=0, steps=3)
    assert isinstance(model, EgoMLP)
    assert model.act(make_example(1).clip.observed()).xy.isfinite().all()
    assert prior.known.max() == 1
    with pytest.raises(InputError, match="empty"):
        read_training_set([], frames=1, past_frames=1)


def test_the_prior_counts_the_frames_from_now_on(make_example: MakeExample) -> None:
    example = make_example(0, 1, 2)
    prior, _ = read_training_set([example, make_example(3)], frames=2, past_frames=1)
    now = example.clip.now
    expected = (
        example.occupancy.known[:, now : now + 2].sum(dim=0)
        + make_example(3).occupancy.known[0, now : now + 2]
    )
    assert torch.equal(prior.known, expected.int())
