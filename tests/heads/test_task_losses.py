"""Losses of map elements, motion, semantic voxels and rasters, worked by hand."""

import math

import pytest
import torch

from foredrive.heads.agent_losses import motion_losses
from foredrive.heads.agents_head import AGENT_CLASSES, AgentSet
from foredrive.heads.detection_losses import matched_loss
from foredrive.heads.detection_network import BoxSet
from foredrive.heads.map_losses import equivalent_orders, map_element_losses, sigmoid_focal_loss
from foredrive.heads.semantic_losses import (
    class_weights,
    raster_loss,
    semantic_affinity,
    voxel_cross_entropy,
)
from foredrive.scene import Attribute
from foredrive.sets import LabelledBoxes

SQUARE = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]])
LINE = torch.tensor([[0.0, 0.0], [1.0, 0.0], [3.0, 0.0]])


def test_an_open_line_has_two_orders_and_a_closed_one_begins_anywhere() -> None:
    orders = {tuple(map(tuple, order.tolist())) for order in equivalent_orders(LINE)}
    assert orders == {((0, 0), (1, 0), (3, 0)), ((3, 0), (1, 0), (0, 0))}
    closed = equivalent_orders(SQUARE)
    assert len({tuple(map(tuple, order.tolist())) for order in closed}) == len(closed) == 8
    assert torch.equal(closed[:, 0], closed[:, -1])
    area = 0.5 * torch.stack([torch.det(closed[:, [i, i + 1]]) for i in range(4)]).sum(0)
    assert area.tolist() == [1] * 4 + [-1] * 4


def test_map_elements_may_be_found_in_any_order_of_their_points() -> None:
    """A reversed line and a square that begins elsewhere cost nothing; which query finds which is free."""
    lines = [LINE[[0, 1, 2, 2, 2]], SQUARE]
    orders = torch.stack([equivalent_orders(line) for line in lines])
    found = torch.stack([SQUARE[[2, 3, 0, 1, 2]], torch.full((5, 2), 9.0), lines[0].flip(0)])
    logits = torch.full((3, 2), -20.0)
    logits[0, 1] = logits[2, 0] = 20.0
    losses = map_element_losses(logits, found, torch.tensor([0, 1]), orders)
    assert losses.kind.item() == pytest.approx(0, abs=1e-6)
    assert losses.points.item() == pytest.approx(0, abs=1e-6)


def test_map_losses_by_hand() -> None:
    """One point of three is 2 m to the side: L1 is 2/3 m. The second edge turns by 45°."""
    orders = equivalent_orders(LINE)[None]
    found = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [3.0, 2.0]]])
    losses = map_element_losses(torch.zeros(1, 1), found, torch.tensor([0]), orders)
    assert losses.points.item() == pytest.approx(2 / 3)
    assert losses.direction.item() == pytest.approx((1 - math.sqrt(0.5)) / 2)
    assert losses.kind.item() == pytest.approx(0.25 * 0.25 * math.log(2))


def test_a_frame_without_elements_only_empties_the_queries() -> None:
    logits = torch.zeros(2, 3, requires_grad=True)
    points = torch.zeros(2, 3, 2, requires_grad=True)
    losses = map_element_losses(logits, points, torch.zeros(0).long(), torch.zeros(0, 4, 3, 2))
    assert losses.points.item() == losses.direction.item() == 0
    assert losses.kind.item() == pytest.approx(6 * 0.75 * 0.25 * math.log(2))


def test_focal_loss_by_hand() -> None:
    """p = .8 for a hit: .25 · .2² · -ln .8; for a miss: .75 · .8² · -ln .2."""
    logit = torch.tensor([math.log(4), math.log(4)])
    found = sigmoid_focal_loss(logit, torch.tensor([1.0, 0.0]))
    expected = [0.25 * 0.04 * -math.log(0.8), 0.75 * 0.64 * -math.log(0.2)]
    assert found.tolist() == pytest.approx(expected)


def test_only_the_nearest_mode_learns_the_path() -> None:
    """Mode 1 is 0.5 m off along x at the one valid step; smooth L1 of it is 0.125."""
    future = torch.tensor([[[[4.0, 0.0], [0.0, 0.0]], [[1.5, 0.0], [99.0, 0.0]]]], requires_grad=True)
    log_prob = torch.tensor([[0.25, 0.75]]).log()
    true = torch.tensor([[[1.0, 0.0], [7.0, 7.0]]])
    losses = motion_losses(future, log_prob, true, torch.tensor([[True, False]]))
    assert losses.distance.item() == pytest.approx(0.125)
    assert losses.mode.item() == pytest.approx(-math.log(0.75))
    losses.distance.backward()
    assert future.grad is not None
    assert future.grad.flatten(0, 1).any(-1).tolist() == [[False, False], [True, False]]


def test_agents_without_a_future_do_not_count() -> None:
    future, log_prob = torch.full((2, 3, 4, 2), 5.0), torch.full((2, 3), 1 / 3).log()
    nothing = motion_losses(future, log_prob, torch.zeros(2, 4, 2), torch.zeros(2, 4).bool())
    assert nothing.distance.item() == nothing.mode.item() == 0
    empty = motion_losses(future[:0], log_prob[:0], torch.zeros(0, 4, 2), torch.zeros(0, 4).bool())
    assert empty.distance.item() == empty.mode.item() == 0


def test_voxels_count_by_the_weight_of_their_class() -> None:
    """Two known voxels, weights 1 and 3: (1 · -ln .5 + 3 · -ln .25) / 4. Unknown ones do not count."""
    p = torch.tensor([[0.5, 0.5], [0.75, 0.25], [0.1, 0.9]])
    index, known = torch.tensor([[0, 1, 0]], dtype=torch.uint8), torch.tensor([[True, True, False]])
    loss = voxel_cross_entropy(p.log().T[None], index, known, torch.tensor([1.0, 3.0]))
    assert loss.item() == pytest.approx((math.log(2) + 3 * math.log(4)) / 4)
    nothing = voxel_cross_entropy(p.log().T[None], index, known & False, torch.ones(2))
    assert nothing.item() == 0


def test_affinity_of_a_class_is_that_of_its_precision_recall_and_specificity() -> None:
    """Two classes, probabilities of class 0: .8 (true 0) and .4 (true 1).

    Class 0: P = .8/1.2, R = .8, S = .6. Class 1: P = .6/.8, R = .6, S = .8. Class 2 is absent.
    """
    p = torch.tensor([[0.8, 0.2, 1e-9], [0.4, 0.6, 1e-9]])
    loss = semantic_affinity(p.log().T[None], torch.tensor([[0, 1]]), torch.ones(1, 2).bool())
    logs = [math.log(x) for x in (0.8 / 1.2, 0.8, 0.6, 0.75, 0.6, 0.8)]
    assert loss.item() == pytest.approx(-sum(logs) / 2, rel=1e-4)
    none = semantic_affinity(p.log().T[None], torch.tensor([[0, 1]]), torch.zeros(1, 2).bool())
    assert none.item() == 0


def test_rare_classes_weigh_more() -> None:
    weight = class_weights(torch.tensor([98, 2, 0]))
    assert weight.tolist() == pytest.approx([1 / math.log(2), 1 / math.log(1.04), 1 / math.log(1.02)])


def test_rasters_of_items_without_a_map_train_nothing() -> None:
    layers = torch.zeros(2, 2, 4, 4, dtype=torch.bool)
    layers[:, 0, 1] = True
    logits = torch.where(layers, 20.0, -20.0)
    both = torch.ones(2, dtype=torch.bool)
    assert raster_loss(logits, layers, both).item() == pytest.approx(0, abs=1e-6)
    wrong = torch.cat([logits[:1], -logits[1:]])
    assert raster_loss(wrong, layers, torch.tensor([True, False])).item() == pytest.approx(0, abs=1e-6)
    assert raster_loss(wrong, layers, both).item() > 1


def test_scores_are_the_odds_of_the_data() -> None:
    """A query that is a car in two of ten frames learns a score of 0.2, though empty queries weigh less."""
    logits = torch.zeros(1, len(AGENT_CLASSES) + 1, requires_grad=True)
    mean, heading = torch.zeros(1, 6), torch.tensor([[0.0, 1.0]])
    boxes = BoxSet(logits, mean, torch.zeros(1, 6), heading, torch.zeros(1))
    car = LabelledBoxes(torch.tensor([0]), mean.double(), torch.zeros(1).double())
    one = torch.tensor([0])
    optimizer = torch.optim.Adam([logits], lr=0.1)
    for _ in range(300):
        loss = sum(
            matched_loss(boxes, truth, row, row)
            for truth, row in [(car, one)] * 2 + [(car[one[:0]], one[:0])] * 8
        )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    agents = AgentSet(boxes, torch.zeros(1, 2), torch.zeros(1, len(Attribute)))
    score, label = agents.best_class()
    assert score.item() == pytest.approx(0.2, abs=0.01)
    assert label.item() == 0
