"""Contrast that knows which texts are true of other images."""

import math

import pytest
import torch

from foredrive.methods.lidarclip.alignment import info_nce, is_true


def test_a_text_is_true_of_what_holds_all_it_says() -> None:
    stated = torch.tensor([[1, 0, 0], [1, 1, 0], [0, 0, 0]]).bool()
    holds = torch.tensor([[1, 0, 1], [1, 1, 0]]).bool()
    assert is_true(stated, holds).tolist() == [[True, False, True], [True, True, True]]


def test_contrast_by_hand() -> None:
    logits = torch.tensor([[2.0, 0.5, 1.0], [0.0, 1.0, 0.3], [3.0, -1.0, 2.0]])
    plain, share = info_nce(logits, torch.eye(3).bool())
    rows = [math.log(sum(math.exp(v) for v in row)) - row[i] for i, row in enumerate(logits.tolist())]
    columns = [math.log(sum(math.exp(v) for v in row)) - row[i] for i, row in enumerate(logits.T.tolist())]
    assert sum(rows) != pytest.approx(sum(columns), rel=1e-2)
    assert float(plain) == pytest.approx((sum(rows) + sum(columns)) / 6, rel=1e-5)
    assert float(share) == pytest.approx(2 / 3)


def test_the_same_caption_twice_is_no_negative() -> None:
    logits = torch.tensor([[2.0, 5.0, 1.0], [5.0, 1.0, 0.0], [3.0, 0.0, 2.0]])
    true = torch.tensor([[1, 1, 0], [1, 1, 0], [0, 0, 1]]).bool()
    loss, share = info_nce(logits, true)
    others = logits.clone()
    others[0, 1] = others[1, 0] = -50.0
    assert float(loss) == pytest.approx(float(info_nce(others, torch.eye(3).bool())[0]), rel=1e-5)
    assert float(share) == pytest.approx(2 / 3)
    logits.requires_grad_(True)
    info_nce(logits, true)[0].backward()
    assert logits.grad is not None
    assert logits.grad[0, 1] == logits.grad[1, 0] == 0


def test_where_all_is_true_of_all_nothing_is_to_learn() -> None:
    loss, _ = info_nce(torch.randn(4, 4, generator=torch.Generator().manual_seed(0)), torch.ones(4, 4).bool())
    assert float(loss) == 0
