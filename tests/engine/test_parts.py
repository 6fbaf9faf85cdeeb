"""Steps in parts: what gradient accumulation and several processes must leave as it is."""

from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from lightning_fabric import Fabric
from torch import nn
from torch.utils.data import Dataset

from foredrive.engine.loop import Schedule, train
from foredrive.engine.metrics_log import read_metrics
from foredrive.engine.parts import StepBuffers, mean_losses, parts_of_step
from foredrive.errors import InputError


@given(st.lists(st.integers(), min_size=1, max_size=12), st.integers(1, 8))
def test_parts_hold_every_item_once(batch: list[int], count: int) -> None:
    parts = parts_of_step(batch, count)
    assert [part.number for part in parts] == list(range(count))
    assert sum(part.weight for part in parts) == pytest.approx(1.0)
    items = [item for part in parts for item in part.items]
    if len(batch) >= count:
        assert sorted(items) == sorted(batch)
    assert set(items) == set(batch)
    assert all(part.items for part in parts)


def test_losses_are_weighted_by_items() -> None:
    parts = [(0.75, {"loss": 1.0, "light": 4.0}), (0.25, {"loss": 5.0})]
    assert mean_losses(parts) == {"loss": 2.0, "light": 4.0}  # no light in the second


def test_statistics_are_the_mean_of_those_after_each_part() -> None:
    norm = nn.BatchNorm1d(1, momentum=0.5)
    buffers = StepBuffers(norm)
    buffers.begin()
    for number, part in enumerate((torch.tensor([[1.0], [3.0]]), torch.tensor([[8.0], [12.0]]))):
        norm(part)
        buffers.end_part(0.5, last=number == 1)
    buffers.end(processes=1)
    assert norm.running_mean is not None
    assert norm.running_var is not None
    assert norm.running_mean.item() == pytest.approx(0.5 * (0.5 * 2 + 0.5 * 10))
    assert norm.running_var.item() == pytest.approx(0.5 * 1 + 0.5 * 0.5 * (2 + 8))
    assert int(norm.num_batches_tracked) == 1  # type: ignore[arg-type]


class Numbers(Dataset["Batch"]):
    def __len__(self) -> int:
        return 7

    def __getitem__(self, index: int) -> "Batch":
        return Batch(torch.tensor([float(index)]))


class Batch:
    def __init__(self, values: torch.Tensor) -> None:
        self.values = values
        self.key = tuple(str(value) for value in values.tolist())


class Line(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.tensor([0.5]))

    def forward(self, batch: Batch, generator: torch.Generator) -> dict[str, torch.Tensor]:
        return {"loss": (self.weight * batch.values - 2.0).square().mean()}


def test_accumulated_steps_are_those_of_the_whole_batch(tmp_path: Path) -> None:
    """For a mean over items, also where parts differ in size: 3 items in 2 parts, 1 left in an epoch."""

    def losses(parts: int) -> list[float]:
        schedule = Schedule(batch_size=3, lr=0.05, steps=8, accumulate=parts)
        folder = tmp_path / str(parts)

        def joined(items: list[Batch]) -> Batch:
            return Batch(torch.cat([item.values for item in items]))

        train(Line(), Numbers(), joined, schedule, folder, Fabric(accelerator="cpu", devices=1))
        return [line["loss"] for line in read_metrics(folder / "metrics.jsonl")]

    whole = losses(1)
    assert losses(2) == pytest.approx(whole, rel=1e-5)
    assert losses(3) == pytest.approx(whole, rel=1e-5)
    assert whole[-1] != pytest.approx(whole[0])


def test_more_parts_than_items_are_refused() -> None:
    with pytest.raises(InputError, match=r"8 processes or parts share the 4 items .* batch_size .* to 8"):
        Schedule(batch_size=4, lr=0.1, steps=1).parts(processes=8)
    assert Schedule(batch_size=4, lr=0.1, steps=1, accumulate=2).parts(processes=1, begun_with=4) == 4
