"""Compositing along rays: hand-computed cases, exactness at α = 0 and 1, stratified sampling."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from foredrive.ops.compositing import composite, stratified_depths


def test_three_samples_by_hand() -> None:
    alpha = torch.tensor([0.5, 0.5, 1.0])
    seen = composite(alpha, torch.tensor([2.0, 4.0, 8.0]))
    assert seen.weights.tolist() == [0.5, 0.25, 0.25]
    assert seen.expected_depth.item() == 4.0
    assert seen.transmittance.item() == 0.0


def test_empty_space_lets_all_light_pass_and_a_wall_none() -> None:
    alpha = torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.0, 0.3]])
    seen = composite(alpha, torch.tensor([1.0, 2.0, 3.0]).expand(2, 3))
    assert seen.transmittance.tolist() == [1, 0]
    assert seen.weights.tolist() == [[0, 0, 0], [0, 1, 0]]
    assert seen.expected_depth.tolist() == [0, 2]


def test_gradients_are_exact_at_the_ends_of_the_range() -> None:
    """∂w/∂α by hand: behind a wall nothing matters, but how solid the wall is does."""
    alpha = torch.tensor([0.0, 1.0, 0.5, 1.0], requires_grad=True)
    features = torch.tensor([3.0, 5.0, 7.0, 11.0])
    (composite(alpha, torch.ones(4)).weights @ features).backward()
    # V behind sample i: 11, then .5·7 + .5·11 = 9, then 5, then 5; gradient T_i (f_i - V_{i+1})
    assert alpha.grad is not None
    assert alpha.grad.tolist() == [3 - 5, 5 - 9, 0, 0]


def test_gradients_stay_finite_in_the_thick_of_it() -> None:
    alpha = torch.stack([torch.ones(48), torch.full((48,), 1 - 2**-24), torch.zeros(48)]).requires_grad_()
    seen = composite(alpha, torch.linspace(1, 40, 48).expand(3, 48))
    total = (seen.weights @ torch.randn(48)).sum() + seen.expected_depth.sum() + seen.transmittance.sum()
    (grad,) = torch.autograd.grad(total, alpha)
    assert grad.isfinite().all()


def test_gradients() -> None:
    rng = torch.Generator().manual_seed(0)
    alpha = torch.rand(2, 2, 5, generator=rng, dtype=torch.float64)
    alpha[0, 0, 1], alpha[0, 1, 3], alpha[1, 0, :3], alpha[1, 1] = 0, 1, 1, 0
    depth = torch.rand(2, 2, 5, generator=rng, dtype=torch.float64)
    assert torch.autograd.gradcheck(composite, [x.requires_grad_() for x in (alpha, depth)])


@given(st.lists(st.floats(0, 1, width=32), min_size=1, max_size=60))
def test_no_light_is_lost(alphas: list[float]) -> None:
    alpha = torch.tensor(alphas)
    seen = composite(alpha, torch.ones(len(alpha)))
    assert (seen.weights >= 0).all()
    assert seen.weights.sum().item() + seen.transmittance.item() == pytest.approx(1, abs=1e-5)
    assert seen.expected_depth.item() == pytest.approx(seen.weights.sum().item(), abs=1e-5)


def test_autocast_does_not_coarsen_depths() -> None:
    alpha = torch.rand(4, 9).bfloat16()
    depth = torch.linspace(1, 70, 9).expand(4, 9)
    with torch.autocast("cpu", torch.bfloat16):
        seen = composite(alpha, depth)
    expected = composite(alpha.float(), depth)
    assert all(torch.equal(a, b) for a, b in zip(seen, expected, strict=True))


def test_no_rays() -> None:
    seen = composite(torch.zeros(0, 5), torch.zeros(0, 5))
    assert [x.shape for x in seen] == [(0, 5), (0,), (0,)]


def test_depths_are_stratified() -> None:
    depth = stratified_depths(2.0, 10.0, 4, (1000,), torch.Generator().manual_seed(1))
    assert depth.shape == (1000, 4)
    edges = torch.tensor([2.0, 4.0, 6.0, 8.0, 10.0])
    assert ((depth >= edges[:-1]) & (depth <= edges[1:])).all()
    torch.testing.assert_close(depth.mean(0), edges[:-1] + 1, rtol=0, atol=0.1)
    assert depth.std(0).min() > 0.5  # uniform over 2 m: 0.577
    again = stratified_depths(2.0, 10.0, 4, (1000,), torch.Generator().manual_seed(1))
    assert torch.equal(depth, again)


def test_without_a_generator_depths_are_centres() -> None:
    assert stratified_depths(2.0, 10.0, 4, (), None).tolist() == [3, 5, 7, 9]
