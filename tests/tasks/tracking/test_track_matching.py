"""Matching over time by hand: carried queries keep their objects, new ones take the others."""

import torch

from foredrive.heads.agent_losses import NOBODY, held_objects, matching_beside, owners
from foredrive.heads.agents_head import AGENT_CLASSES
from foredrive.heads.detection_losses import MatchingLossConfig
from foredrive.heads.detection_network import BoxSet
from foredrive.sets import LabelledBoxes


def queries(x: list[float]) -> BoxSet:
    n = len(x)
    return BoxSet(
        logits=torch.zeros(n, len(AGENT_CLASSES) + 1),
        mean=torch.tensor([[at, 0.0, 0.0, 0.0, 0.0, 0.0] for at in x]),
        log_std=torch.zeros(n, 6),
        heading=torch.tensor([0.0, 1.0]).expand(n, 2),
        log_std_yaw=torch.zeros(n),
    )


def objects(x: list[float]) -> LabelledBoxes:
    state = torch.tensor([[at, 0.0, 0.0, 0.0, 0.0, 0.0] for at in x]).view(-1, 6)
    return LabelledBoxes(torch.zeros(len(x), dtype=torch.long), state, torch.zeros(len(x)))


def test_a_carried_query_keeps_its_object_though_another_is_nearer() -> None:
    """Query 0 carried on object 7, 1 an object that has left, 2 a query without an object."""
    owner = torch.tensor([7, NOBODY, 5])
    track_id = torch.tensor([9, 7])
    held = held_objects(torch.tensor([0, 2, 1, -1]), owner, track_id, torch.zeros(4, 2))
    assert held.query.tolist() == [0]
    assert held.match.tolist() == [1]
    assert held.bound.tolist() == [True, True, False, False]
    found, truth = queries([10.0, 0.0, 3.0, 0.5]), objects([0.0, 10.5])
    query, match = matching_beside(found, truth, held, MatchingLossConfig())
    assert dict(zip(query.tolist(), match.tolist(), strict=True)) == {0: 1, 3: 0}
    assert owners(query, match, track_id, 4).tolist() == [7, NOBODY, NOBODY, 9]


def test_without_carried_queries_it_is_the_best_matching() -> None:
    held = held_objects(
        torch.full((3,), -1), torch.full((3,), NOBODY), torch.tensor([4, 6]), torch.zeros(3, 2)
    )
    query, match = matching_beside(queries([5.0, 0.0, 9.0]), objects([0.2, 8.0]), held, MatchingLossConfig())
    assert sorted(zip(query.tolist(), match.tolist(), strict=True)) == [(1, 0), (2, 1)]


def test_frames_without_objects_hold_none() -> None:
    held = held_objects(
        torch.tensor([0, -1]), torch.tensor([3, NOBODY]), torch.zeros(0, dtype=torch.long), torch.zeros(2, 0)
    )
    query, match = matching_beside(queries([0.0, 1.0]), objects([]), held, MatchingLossConfig())
    assert len(query) == len(match) == 0
    assert owners(query, match, torch.zeros(0, dtype=torch.long), 2).tolist() == [NOBODY, NOBODY]


def test_a_query_that_has_lost_its_object_is_free_and_so_is_the_object() -> None:
    away_m = torch.tensor([[5.0, 0.0], [0.0, 9.0]])
    held = held_objects(torch.tensor([0, -1]), torch.tensor([7, NOBODY]), torch.tensor([7, 8]), away_m)
    assert held.query.tolist() == []
    assert held.bound.tolist() == [False, False]
