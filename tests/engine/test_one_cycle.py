"""The 1cycle policy is that of PyTorch, step by step, and the training loop follows it."""

from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from torch.optim.lr_scheduler import OneCycleLR
from torch.utils.data import Dataset

from foredrive.engine.fabric import make_fabric
from foredrive.engine.loop import Schedule, train
from foredrive.engine.one_cycle import OneCycle
from foredrive.scene.record import Record

SCHEDULE = Schedule(batch_size=1, lr=1e-2, steps=12, weight_decay=0.0, one_cycle=OneCycle())


@dataclass(frozen=True)
class Number(Record):
    value: Tensor
    key: tuple[str, ...]


class Numbers(Dataset[Number]):
    def __len__(self) -> int:
        return 1

    def __getitem__(self, index: int) -> Number:
        return Number(torch.tensor(2.0), ("two",))


class Fit(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.tensor([1.0, -3.0]))

    def forward(self, batch: Number, _: torch.Generator) -> dict[str, Tensor]:
        return {"loss": (self.weight * batch.value).square().sum()}


@pytest.mark.parametrize("total", [7, 25, 40])
def test_learning_rate_and_momentum_are_those_of_pytorch(total: int) -> None:
    optimizer = torch.optim.Adam([nn.Parameter(torch.zeros(1))])
    scheduler = OneCycleLR(optimizer, 1e-2, total_steps=total, pct_start=0.1)
    for step in range(total):
        (group,) = optimizer.param_groups
        assert SCHEDULE.lr_at(step, total) == pytest.approx(group["lr"], rel=1e-6, abs=1e-12)
        assert OneCycle().at(step, total)[1] == pytest.approx(group["betas"][0])
        optimizer.step()
        scheduler.step()


def test_the_loop_steps_as_adam_with_the_scheduler(tmp_path: Path) -> None:
    ours, theirs = Fit(), Fit()
    train(ours, Numbers(), lambda items: items[0], SCHEDULE, tmp_path, make_fabric("32-true"))
    optimizer = torch.optim.Adam(theirs.parameters())
    scheduler = OneCycleLR(optimizer, SCHEDULE.lr, total_steps=12, pct_start=0.1)
    for _ in range(12):
        optimizer.zero_grad()
        theirs(Numbers()[0], torch.Generator())["loss"].backward()
        optimizer.step()
        scheduler.step()
    torch.testing.assert_close(ours.weight, theirs.weight, rtol=1e-6, atol=1e-6)
