"""Equation 9 by hand, and walks."""

import math

import pytest
import torch

from foredrive.methods.splatad import Gaussians
from foredrive.methods.splatad.relocation import random_walk_m, split_evenly


def test_one_alone_stays_as_it_is() -> None:
    opacity, scale = split_evenly(torch.tensor([0.3, 0.9]), torch.tensor([1, 1]))
    assert torch.allclose(opacity, torch.tensor([0.3, 0.9]))
    assert torch.allclose(scale, torch.ones(2))


def test_two_that_share() -> None:
    opacity, scale = split_evenly(torch.tensor([0.75]), torch.tensor([2]))
    assert float(opacity) == pytest.approx(0.5)
    assert float(scale) == pytest.approx(0.75 / (0.5 + 0.5 - 0.25 / math.sqrt(2)))


def test_as_many_as_can_be_stay_sound() -> None:
    opacity, scale = split_evenly(torch.tensor([0.999999, 0.01]), torch.tensor([51, 51]))
    assert opacity.isfinite().all()
    assert ((scale > 0) & (scale < 1.5)).all()


def test_faint_ones_walk_within_their_shape_and_opaque_ones_stay() -> None:
    count = 4000
    gaussians = Gaussians(
        mean_m=torch.zeros(count, 3),
        quaternion=torch.tensor([[math.sqrt(0.5), 0, 0, math.sqrt(0.5)]]).repeat(count, 1),
        log_scale=torch.tensor([[1.0, 0.1, 0.5]]).log().repeat(count, 1),
        opacity_logit=torch.tensor([0.001, 0.5]).logit().repeat(count // 2),
        feature=torch.zeros(count, 3),
    )
    walk = random_walk_m(gaussians, 2.0, torch.Generator().manual_seed(0))
    free = 1 / (1 + math.exp(-0.4))
    # turned by 90° about z: what was the long axis is y now; noise goes with the covariance
    expected = 2.0 * free * torch.tensor([0.01, 1.0, 0.25])
    assert torch.allclose(walk[::2].std(0), expected, rtol=0.06)
    assert float(walk[1::2].abs().max()) < 1e-12


def test_the_kernel_walks_as_plain_pytorch_does() -> None:
    """Plain PyTorch computes in 64 bits; both draw the same noise."""
    rng, count = torch.Generator().manual_seed(1), 5000
    gaussians = Gaussians(
        mean_m=torch.zeros(count, 3),
        quaternion=3 * torch.randn(count, 4, generator=rng),
        log_scale=torch.randn(count, 3, generator=rng),
        opacity_logit=torch.randn(count, generator=rng) - 3,
        feature=torch.zeros(count, 3),
    )
    exact = Gaussians(
        **{name: getattr(gaussians, name).double() for name in ("mean_m", "quaternion", "log_scale")},
        opacity_logit=gaussians.opacity_logit.double(),
        feature=gaussians.feature,
    )
    found = random_walk_m(gaussians, 2.0, torch.Generator().manual_seed(0))
    expected = random_walk_m(exact, 2.0, torch.Generator().manual_seed(0))
    assert 0.2 < float((expected.abs().sum(1) > 0).float().mean()) < 0.95
    torch.testing.assert_close(found.double(), expected, rtol=1e-3, atol=1e-4)
