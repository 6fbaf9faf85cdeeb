"""The dense map of centres: its target by hand, its loss near, far from and without centres."""

import math

import pytest
import torch

from foredrive.heads.agent_losses import centre_loss, centre_target
from foredrive.heads.plane import cell_middles

MIDDLE = cell_middles((0.0, 0.0), 2.0, (3, 4)).view(3, 4, 2)


def test_target_by_hand() -> None:
    """Two centres of one class in a row of cells of 2 m; the larger Gaussian counts in between."""
    xy = torch.tensor([[1.0, 3.5], [6.9, 3.0], [3.0, 1.0]])
    found = centre_target(xy, torch.tensor([1, 1, 0]), torch.tensor([1.0, 2.0, 1.0]), MIDDLE, 2.0, 3)
    assert found[1, 1, 0].item() == 1  # 0.5 m from the middle of its cell
    assert found[1, 1, 3].item() == 1
    assert found[1, 1, 2].item() == pytest.approx(math.exp(-0.5 * 1.9**2 / 4))
    assert found[1, 1, 1].item() == pytest.approx(math.exp(-0.5 * 3.9**2 / 4))
    assert (found[0] == 1).nonzero().tolist() == [[0, 1]]
    assert not found[2].any()


def test_loss_is_per_centre_and_lower_near_centres() -> None:
    """A wrong cell beside a centre costs less than one far away; two frames cost as much as one."""
    target = centre_target(torch.tensor([[3.0, 3.0]]), torch.tensor([0]), torch.tensor([1.5]), MIDDLE, 2.0, 1)
    near, far = torch.full((1, 3, 4), -6.0), torch.full((1, 3, 4), -6.0)
    near[0, 1, 1] = far[0, 1, 1] = 6.0
    right = centre_loss(near, target)
    near[0, 1, 2], far[0, 1, 3] = 3.0, 3.0
    assert right < 1e-3 < centre_loss(near, target) < centre_loss(far, target)
    twice = centre_loss(torch.stack([far, far]), torch.stack([target, target]))
    assert twice.item() == pytest.approx(centre_loss(far, target).item())


def test_loss_without_centres_is_finite() -> None:
    none = centre_target(torch.zeros(0, 2), torch.zeros(0).long(), torch.zeros(0), MIDDLE, 2.0, 2)
    logits = torch.zeros(2, 3, 4, requires_grad=True)
    centre_loss(logits, none).backward()
    assert (logits.grad > 0).all()  # descent makes centres rarer
