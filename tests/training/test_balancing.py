"""Balanced sampling: what a plan does, by hand, and how often each kind is drawn."""

import itertools

import pytest
import torch

from foredrive.training.balancing import Manoeuvre, balanced_weights, manoeuvres
from foredrive.training.loop import batch_order

DT_S = 0.5


def plan(speeds: list[float], aside_m: float = 0.0) -> torch.Tensor:
    along = DT_S * torch.tensor(speeds).cumsum(0)
    return torch.stack([along, torch.linspace(0, aside_m, len(speeds))], dim=-1)


def test_manoeuvres_by_hand() -> None:
    cases = [
        (0.0, plan([0.0] * 6), Manoeuvre.WAITS),
        (0.0, plan([0.0, 0.5, 1.0, 2.0, 3.0, 4.0]), Manoeuvre.STARTS),
        (8.0, plan([6.0, 4.0, 2.0, 1.0, 0.2, 0.0]), Manoeuvre.STOPS),
        (8.0, plan([7.0, 6.0, 5.0, 4.0, 4.0, 4.0]), Manoeuvre.BRAKES),
        (6.0, plan([6.0] * 6, aside_m=5.0), Manoeuvre.TURNS),
        (4.0, plan([5.0, 6.0, 7.0, 8.0, 8.0, 8.0]), Manoeuvre.SPEEDS_UP),
        (8.0, plan([8.0] * 6), Manoeuvre.CRUISES),
    ]
    speed = torch.tensor([speed for speed, *_ in cases])
    xy = torch.stack([path for _, path, _ in cases])
    valid = torch.ones(xy.shape[:2], dtype=torch.bool)
    assert manoeuvres(speed, xy, valid, DT_S).tolist() == [int(kind) for *_, kind in cases]
    assert (manoeuvres(speed, xy, ~valid, DT_S) == Manoeuvre.CRUISES).all()
    cut = valid.clone()
    cut[2, 2:] = False  # only the steps at 6 and 4 m/s are known
    assert manoeuvres(speed, xy, cut, DT_S)[2] == Manoeuvre.BRAKES


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0])
def test_rare_kinds_are_drawn_more_often(power: float) -> None:
    kind = torch.tensor([0] * 900 + [3] * 100)
    weights = balanced_weights(kind, power)
    assert weights.mean() == pytest.approx(1.0, abs=1e-5)
    drawn = list(itertools.chain(*itertools.islice(batch_order(1000, 10, 0, weights), 600)))
    share = sum(index >= 900 for index in drawn) / len(drawn)
    assert share == pytest.approx(100 ** (1 - power) / (100 ** (1 - power) + 900 ** (1 - power)), abs=0.02)
    again = list(itertools.chain(*itertools.islice(batch_order(1000, 10, 0, weights), 600)))
    assert again == drawn
