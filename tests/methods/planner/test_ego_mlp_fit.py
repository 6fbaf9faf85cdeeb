"""Fitting the ego MLP."""

import dataclasses

import pytest
import torch
from small_drives import drives

from foredrive.errors import InputError
from foredrive.methods.planner.baselines import ConstantVelocity
from foredrive.methods.planner.ego_mlp import EgoMLP, EgoMLPConfig
from foredrive.methods.planner.ego_mlp_fit import EgoMLPFit, StatusDemonstrations, fit_ego_mlp, read_status


def fitted(
    data: StatusDemonstrations, *, steps: int, past_frames: int = 2, seed: int = 0, rates: bool = False
) -> EgoMLP:
    fit = EgoMLPFit(steps=steps, seed=seed)
    return fit_ego_mlp(EgoMLPConfig(rates=rates), data, fit, past_frames=past_frames, dt_s=0.5)


@pytest.mark.parametrize("rates", [False, True])
def test_the_ego_mlp_learns_what_the_status_gives_away(rates: bool) -> None:
    # Vehicles on circles: the past says exactly what comes next.
    data = read_status([drives(*range(100)).clip], past_frames=2, rates=rates)
    model = fitted(data, steps=300, rates=rates)
    test = drives(*range(200, 240))
    observed, driven = test.clip.observed(), test.clip.future.xy
    error_m = (model.act(observed).xy - driven).norm(dim=-1).mean()
    straight_m = (ConstantVelocity(6, 0.5).act(observed).xy - driven).norm(dim=-1).mean()
    assert error_m < 0.5 * straight_m
    again = fitted(data, steps=300, rates=rates)
    other = fitted(data, steps=300, seed=1, rates=rates)
    assert torch.equal(again.act(observed).xy, model.act(observed).xy)
    assert not torch.equal(other.act(observed).xy, model.act(observed).xy)


def test_steps_that_were_not_driven_teach_nothing() -> None:
    data = read_status([drives(*range(20)).clip], past_frames=2)
    valid = data.valid.clone()
    valid[::2, 3:] = False
    spoilt = torch.where(valid[..., None], data.driven, torch.full_like(data.driven, 1e6))
    kept = torch.where(valid[..., None], data.driven, torch.zeros_like(data.driven))
    plans = [
        fitted(dataclasses.replace(data, driven=driven, valid=valid), steps=5)(data.status)
        for driven in (spoilt, kept)
    ]
    assert torch.equal(*plans)


def test_one_clip_is_enough_to_train_on() -> None:
    data = read_status([drives(0).clip], past_frames=1)
    model = fitted(data, steps=3, past_frames=1)
    assert isinstance(model, EgoMLP)
    assert model.act(drives(1).clip.observed()).xy.isfinite().all()
    with pytest.raises(InputError, match="empty"):
        read_status([], past_frames=1)
