"""The planner's geometry."""

import math
from typing import Literal

import pytest
import torch

from foredrive.models.planner import FutureAttention, VolumePlanner, _headings


def test_headings_follow_the_path_and_hold_when_it_stops() -> None:
    xy = torch.tensor([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [2.0, 2.01], [2.0, 2.0], [1.0, 2.0]])
    yaw = _headings(xy[None, None])[0, 0]
    torch.testing.assert_close(yaw, torch.tensor([0, 0, math.pi / 2, math.pi / 2, math.pi / 2, math.pi]))


def test_attention_over_single_voxels_is_equation_13() -> None:
    """With blocks of one voxel the pooled form must be softmax(QKᵀ/√d)V ⊙ V_t exactly."""
    torch.manual_seed(0)
    attention = FutureAttention(4, (1, 1, 1))
    now, future = torch.randn(2, 1, 4, 2, 3, 3)
    tokens = future.flatten(2).transpose(1, 2)[0]
    q, k, v = attention.query(tokens), attention.key(tokens), attention.value(tokens)
    expected = (q @ k.T / math.sqrt(4)).softmax(-1) @ v
    expected = expected.T.view(1, 4, 2, 3, 3) * now
    torch.testing.assert_close(attention(now, future), expected)


@pytest.mark.parametrize("future", ["attention", "concatenation", "none"])
def test_the_next_volume_matters_where_it_is_looked_at(
    future: Literal["attention", "concatenation", "none"],
) -> None:
    torch.manual_seed(0)
    planner = VolumePlanner(
        channels=4,
        shape_zyx=(2, 8, 8),
        width=16,
        layers=1,
        heads=2,
        future=future,
        pool=(1, 2, 2),
        history=0,
        horizon_steps=6,
        dt_s=0.5,
    ).eval()
    now, one, other = torch.randn(3, 1, 4, 2, 8, 8)
    status = (torch.zeros(1, dtype=torch.int64), SEEN, torch.full((1,), 5.0), SEEN, torch.zeros(1, 0, 4))
    with torch.no_grad():
        same = torch.allclose(planner(now, one, *status).xy, planner(now, other, *status).xy)
    assert same == (future == "none") == (planner.looks_ahead == 0)
    if future != "none":
        with pytest.raises(ValueError, match="next volume"):
            planner(now, None, *status)


def test_where_nothing_is_learned_it_goes_straight_on() -> None:
    """With a last layer of zeros it is constant velocity, and standing still where the speed is unknown."""
    planner = VolumePlanner(
        channels=4,
        shape_zyx=(2, 8, 8),
        width=16,
        layers=1,
        heads=2,
        future="none",
        pool=(1, 2, 2),
        history=1,
        horizon_steps=3,
        dt_s=0.5,
    ).eval()
    torch.nn.init.zeros_(planner.waypoints[-1].weight)
    torch.nn.init.zeros_(planner.waypoints[-1].bias)
    volume, past = torch.randn(2, 4, 2, 8, 8), torch.randn(2, 1, 4)
    speed, known = torch.tensor([6.0, 6.0]), torch.tensor([True, False])
    plan = planner(volume, None, torch.zeros(2, dtype=torch.int64), known, speed, known, past)
    assert plan.xy[0, 0].tolist() == [[3.0, 0.0], [6.0, 0.0], [9.0, 0.0]]
    assert not plan.xy[1].any()
    assert not plan.yaw.any()


SEEN = torch.ones(1, dtype=torch.bool)
