"""Occupancy losses."""

import math

import torch

from foredrive.heads.occupancy_losses import (
    motion_emphasis,
    occupancy_bce,
    occupancy_loss,
    scene_class_affinity,
)


def grid(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float32).view(1, 1, 1, -1)


def test_bce_ignores_unknown_voxels_by_hand() -> None:
    logit = grid(0.0, 0.0, 50.0)
    loss = occupancy_bce(logit, grid(1, 0, 0), grid(1, 1, 0).bool())
    torch.testing.assert_close(loss, torch.tensor(math.log(2)))


def test_occupied_voxels_weigh_more_where_asked() -> None:
    logit, occupied, known = grid(0.0, 0.0), grid(1, 0), grid(1, 1).bool()
    loss = occupancy_bce(logit, occupied, known, occupied_weight=3.0)
    torch.testing.assert_close(loss, torch.tensor(2 * math.log(2)))  # (3 + 1) / 2


def test_what_moves_and_its_neighbours_weigh_more() -> None:
    # Two clips of 1 x 3 x 5 cells: the first has a car at 5 m/s in a corner, the second one that stands, and
    # one that moves where the flow is not known
    flow_mps, known = torch.zeros(2, 3, 1, 3, 5), torch.ones(2, 1, 3, 5, dtype=torch.bool)
    flow_mps[0, :2, 0, 0, 0] = torch.tensor([3.0, -4.0])
    flow_mps[1, 0, 0, 1, 1], flow_mps[1, 1, 0, 2, 4] = 0.3, 5.0
    known[1, 0, 2, 4] = False
    emphasis = motion_emphasis(flow_mps, known, 4.0)
    first = torch.ones(3, 5)
    first[:2, :2] = 4.0
    torch.testing.assert_close(emphasis, torch.stack([first, torch.ones(3, 5)])[:, None])
    loss = occupancy_bce(torch.zeros(2, 1, 3, 5), known.float(), known, emphasis=emphasis)
    torch.testing.assert_close(loss, torch.tensor(math.log(2) * (4 * 4 + 25) / 29))


def test_affinity_by_hand() -> None:
    p = torch.tensor([0.8, 0.6, 0.1, 0.9])  # the last voxel is unknown
    y = grid(1, 0, 0, 0)
    loss = scene_class_affinity(torch.logit(p).view(1, 1, 1, -1), y, grid(1, 1, 1, 0).bool())
    precision, recall, specificity = 0.8 / 1.5, 0.8, (0.4 + 0.9) / 2
    expected = -math.log(precision) - math.log(recall) - math.log(specificity)
    torch.testing.assert_close(loss, torch.tensor(expected), atol=1e-4, rtol=0)


def test_affinity_is_finite_without_any_occupied_voxel() -> None:
    logit = torch.zeros(1, 2, 2, 2, requires_grad=True)
    loss = scene_class_affinity(logit, torch.zeros(1, 2, 2, 2), torch.ones(1, 2, 2, 2, dtype=torch.bool))
    loss.backward()
    torch.testing.assert_close(loss.detach(), torch.tensor(math.log(2)), atol=1e-4, rtol=0)  # specificity ½
    assert logit.grad is not None
    assert logit.grad.isfinite().all()


def test_nothing_known_costs_nothing() -> None:
    unknown = torch.zeros(1, 2, 2, 2, dtype=torch.bool)
    loss = occupancy_loss(
        torch.randn(1, 2, 2, 2), torch.zeros(1, 2, 2, 2), unknown, scal_weight=10.0, bce_weight=1.0
    )
    assert loss.item() == 0


def test_a_perfect_prediction_costs_almost_nothing() -> None:
    occupied = (torch.rand(1, 4, 4, 4, generator=torch.Generator().manual_seed(0)) > 0.7).float()
    known = torch.ones(1, 4, 4, 4, dtype=torch.bool)
    loss = occupancy_loss(40 * (occupied - 0.5), occupied, known, scal_weight=10.0, bce_weight=1.0)
    assert loss.item() < 1e-3
