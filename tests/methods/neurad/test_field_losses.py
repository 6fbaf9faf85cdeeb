"""Losses of neural fields: cases worked out by hand and brute force beside the fast sums."""

import torch
from torch import Tensor

from foredrive.methods.neurad.losses import (
    beam_depth_loss,
    carving_loss,
    distortion_loss,
    hit_loss,
    interlevel_loss,
)


def histogram(seed: int, rays: int, count: int) -> tuple[Tensor, Tensor]:
    rng = torch.Generator().manual_seed(seed)
    border = torch.rand(rays, count + 1, generator=rng).sort(dim=-1).values
    border[:, 0], border[:, -1] = 0, 1
    weight = torch.rand(rays, count, generator=rng)
    return border, 0.9 * weight / weight.sum(-1, keepdim=True)


def test_distortion_is_the_double_sum() -> None:
    border, weight = histogram(0, 5, 7)
    middle = (border[:, 1:] + border[:, :-1]) / 2
    apart = (middle[:, :, None] - middle[:, None]).abs()
    double = (weight[:, :, None] * weight[:, None] * apart).sum((1, 2))
    within = (weight**2 * border.diff(dim=-1)).sum(-1) / 3
    torch.testing.assert_close(distortion_loss(border, weight), (double + within).mean())


def test_a_proposal_that_covers_the_field_costs_nothing_and_one_that_misses_it_costs() -> None:
    border = torch.tensor([[0.0, 0.4, 0.5, 1.0]])
    weight = torch.tensor([[0.0, 1.0, 0.0]])
    wide = torch.tensor([[0.0, 0.3, 0.6, 1.0]])
    covers = interlevel_loss(border, weight, wide, torch.tensor([[0.0, 1.0, 0.0]]), pulse=0.05)
    assert covers < 1e-6
    beside = torch.tensor([[0.9, 0.1, 0.0]])
    missed = interlevel_loss(border, weight, wide, beside, pulse=0.05)
    torch.testing.assert_close(missed, torch.tensor(0.9**2 / 0.1), rtol=1e-3, atol=0)


def test_the_blurred_histogram_has_the_shares_of_a_sampled_one() -> None:
    """The blur moves each sample by up to the pulse at random; a proposal of 0 shows the share."""
    border, weight = histogram(1, 3, 4)
    weight = weight / weight.sum(-1, keepdim=True)
    proposal_border, _ = histogram(2, 3, 5)
    rng, pulse, count = torch.Generator().manual_seed(0), 0.07, 200_000
    share = []
    for ray in range(3):
        chosen = torch.multinomial(weight[ray], count, replacement=True, generator=rng)
        part = torch.rand(count, generator=rng)
        place = border[ray, chosen] + part * (border[ray, chosen + 1] - border[ray, chosen])
        place = place + pulse * (2 * torch.rand(count, generator=rng) - 1)
        share.append(torch.histogram(place, proposal_border[ray])[0] / count)
    expected = torch.stack(share)
    for k in range(5):  # the proposal has its share everywhere but in one interval
        held = expected.clone() + 1
        held[:, k] = 0
        found = interlevel_loss(border, weight, proposal_border, held, pulse)
        torch.testing.assert_close(
            (found * 1e-5).sqrt(), (expected[:, k] ** 2).mean().sqrt(), rtol=0.02, atol=2e-3
        )


def test_only_the_proposal_learns_from_the_interlevel_loss() -> None:
    border, weight = histogram(3, 4, 6)
    proposal_border, proposal_weight = histogram(4, 4, 9)
    weight.requires_grad_(), proposal_weight.requires_grad_()
    interlevel_loss(border, weight, proposal_border, proposal_weight, 0.03).backward()
    assert weight.grad is None
    assert proposal_weight.grad is not None
    assert bool((proposal_weight.grad <= 0).all())
    assert bool(proposal_weight.grad.any())


def test_carving_by_hand() -> None:
    """Near a return at 10 m, 10.05 m counts as surface. Of a lost beam, all up to 150 m are wrong."""
    middle = torch.tensor([[5.0, 10.05, 12.0], [5.0, 149.0, 151.0]])
    weight = torch.tensor([[0.1, 0.7, 0.2], [0.3, 0.4, 0.3]])
    loss = carving_loss(
        middle, weight, torch.tensor([10.0, 0.0]), torch.tensor([True, False]), margin_m=0.1, free_m=150.0
    )
    torch.testing.assert_close(loss, torch.tensor((0.1**2 + 0.2**2 + 0.3**2 + 0.4**2) / 2))


def test_depth_of_lost_beams_is_pulled_out_to_where_they_are_free() -> None:
    depth = torch.tensor([12.0, 50.0, 170.0], requires_grad=True)
    loss = beam_depth_loss(
        depth, torch.tensor([10.0, 0, 0]), torch.tensor([True, False, False]), free_m=150.0, lost_weight=0.1
    )
    torch.testing.assert_close(loss, torch.tensor((2 + 0.1 * 100 + 0) / 3))
    loss.backward()
    assert depth.grad is not None
    assert depth.grad.sign().tolist() == [1, -1, 0]


def test_the_worst_errors_are_left_out() -> None:
    depth, real = torch.arange(10.0) ** 2, torch.zeros(10)
    returned = torch.ones(10, dtype=torch.bool)
    loss = beam_depth_loss(depth, real, returned, 150.0, 0.1, quantile=0.8)
    torch.testing.assert_close(loss, (torch.arange(8.0) ** 2).mean())


def test_a_hit_is_the_share_of_a_beam_near_its_return() -> None:
    """Of the interval from 9 to 11 m, half lies within 0.5 m of 10 m. A mean of 10 m does not count."""
    border = torch.tensor([[0.0, 9, 11, 20], [0, 9, 11, 20], [0, 9, 11, 20]])
    weight = torch.tensor([[0.1, 0.8, 0.1], [0.5, 0.0, 0.5], [0.3, 0.3, 0.3]], requires_grad=True)
    returned = torch.tensor([True, True, False])
    loss = hit_loss(border, weight, torch.full((3,), 10.0), returned, near_m=0.5)
    expected = -(torch.tensor([0.4, 0.0]) + 0.01).log().mean()
    torch.testing.assert_close(loss, expected)
    loss.backward()
    assert weight.grad is not None
    assert (weight.grad != 0).int().tolist() == [[0, 1, 0], [0, 1, 0], [0, 0, 0]]
    assert hit_loss(border, weight, torch.full((3,), 10.0), ~returned & False, 0.5) == 0
