"""The training loop on a real module and data set, small."""

import itertools
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from lightning_fabric import Fabric
from torch import nn
from torch.utils.data import Dataset

from foredrive.engine.checkpoints import latest_checkpoint
from foredrive.engine.fabric import make_fabric
from foredrive.engine.loop import Schedule, batch_order, train
from foredrive.engine.metrics_log import read_metrics
from foredrive.errors import InputError
from foredrive.scene import Example, VoxelSpec

SPEC = VoxelSpec(lower_m=(-2.0, -2.0, -1.0), voxel_m=1.0, shape_zyx=(2, 4, 4))


class Items(Dataset[Example]):
    def __init__(self, make_example: Callable[..., Example], count: int) -> None:
        self.items = [make_example(spec=SPEC, batch=1, seed=seed) for seed in range(count)]

    def __len__(self) -> int:
        return len(self.items)

    def __getitem__(self, index: int) -> Example:
        return self.items[index]


class Prior(nn.Module):
    """Learns the occupancy of a voxel; dropout and the generator make its losses depend on random numbers."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.logit = nn.Parameter(torch.randn(32))
        self.dropout = nn.Dropout(0.2)
        self.stop_at: int | None = None
        self.calls = 0

    def forward(self, example: Example, generator: torch.Generator) -> dict[str, torch.Tensor]:
        self.calls += 1
        if self.calls == self.stop_at:
            raise KeyboardInterrupt
        target = example.occupancy.values[:, 0].flatten(1) + 0.1 * torch.rand(1, generator=generator)
        return {"loss": ((self.dropout(self.logit).sigmoid() - target) ** 2).mean()}


def collate(items: list[Example]) -> Example:
    return items[0]


def losses(folder: Path) -> list[float]:
    return [line["loss"] for line in read_metrics(folder / "metrics.jsonl")]


SCHEDULE = Schedule(batch_size=1, lr=0.1, steps=12, warmup_steps=3, checkpoint_every=5)


def run(make_example: Callable[..., Example], folder: Path, *, stop_at: int | None = None) -> Prior:
    model = Prior()
    model.stop_at = stop_at
    fabric = Fabric(accelerator="cpu", devices=1)
    train(model, Items(make_example, 5), collate, SCHEDULE, folder, fabric)
    return model


def test_an_interrupted_run_goes_on_exactly(make_example: Callable[..., Example], tmp_path: Path) -> None:
    straight = run(make_example, tmp_path / "straight")
    with pytest.raises(KeyboardInterrupt):
        run(make_example, tmp_path / "resumed", stop_at=8)
    assert len(losses(tmp_path / "resumed")) == 7
    resumed = run(make_example, tmp_path / "resumed")
    assert losses(tmp_path / "resumed") == losses(tmp_path / "straight")
    torch.testing.assert_close(resumed.logit, straight.logit, rtol=0, atol=0)


def test_a_run_killed_between_checkpoints_drops_what_it_had_not_saved(
    make_example: Callable[..., Example], tmp_path: Path
) -> None:
    run(make_example, tmp_path / "straight")
    with pytest.raises(KeyboardInterrupt):
        run(make_example, tmp_path / "killed", stop_at=8)
    with (tmp_path / "killed" / "metrics.jsonl").open("a") as file:  # a line past the checkpoint, one cut off
        file.write(json.dumps({"step": 8, "loss": 99.0}) + '\n{"step": 9, "lo')
    run(make_example, tmp_path / "killed")
    assert losses(tmp_path / "killed") == losses(tmp_path / "straight")


@pytest.mark.parametrize("is_known", [True, False])
def test_mixed_precision_rounds_no_inputs(
    make_example: Callable[..., Example], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_known: bool
) -> None:
    """And is none on CPUs that would take longer in bfloat16."""
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"amx_bf16": is_known}, raising=False)
    seen = {}

    class Looks(Prior):
        def forward(self, example: Example, generator: torch.Generator) -> dict[str, torch.Tensor]:
            rig = example.clip.rig
            seen["product"] = (rig.K @ rig.T_ego_cam[..., :3, :3]).dtype
            seen["inputs"] = (rig.K.dtype, example.clip.T_world_ego.dtype)
            return super().forward(example, generator)

    train(Looks(), Items(make_example, 1), collate, SCHEDULE, tmp_path, make_fabric("bf16-mixed"))
    product = torch.bfloat16 if is_known else torch.float32
    assert seen == {"product": product, "inputs": (torch.float32, torch.float64)}
    assert losses(tmp_path)[-1] < losses(tmp_path)[0]
    conditions = json.loads((tmp_path / "conditions.json").read_text())
    precision = "bfloat16" if is_known else "float32"
    assert conditions == {"device": "cpu", "precision": precision, "processes": 1, "parts": 1}


def test_a_finished_run_is_left_alone(make_example: Callable[..., Example], tmp_path: Path) -> None:
    run(make_example, tmp_path)
    before = (tmp_path / "metrics.jsonl").read_text()
    assert run(make_example, tmp_path).calls == 0
    assert (tmp_path / "metrics.jsonl").read_text() == before


def test_only_the_newest_checkpoint_stays(make_example: Callable[..., Example], tmp_path: Path) -> None:
    run(make_example, tmp_path)
    kept = [path.name for path in (tmp_path / "checkpoints").iterdir()]
    assert kept == ["step_0000012"]


def test_nan_stops_and_names_the_batch(make_example: Callable[..., Example], tmp_path: Path) -> None:
    items = Items(make_example, 1)
    items.items[0].occupancy.values[0, 0] = float("nan")
    with pytest.raises(InputError, match=r"step 1: loss is not finite .*log_0@0.0s"):
        train(Prior(), items, collate, SCHEDULE, tmp_path, Fabric(accelerator="cpu", devices=1))
    assert latest_checkpoint(tmp_path / "checkpoints") is None


def test_no_data_is_an_error(make_example: Callable[..., Example], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="data set is empty"):
        train(
            Prior(), Items(make_example, 0), collate, SCHEDULE, tmp_path, Fabric(accelerator="cpu", devices=1)
        )


def test_a_broken_checkpoint_is_named(make_example: Callable[..., Example], tmp_path: Path) -> None:
    run(make_example, tmp_path)
    weights = tmp_path / "checkpoints" / "step_0000012" / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:40])
    with pytest.raises(InputError, match=r"model\.safetensors"):
        run(make_example, tmp_path)


def test_every_item_once_an_epoch_in_an_order_of_its_own() -> None:
    order = batch_order(7, 3, seed=1)
    first = [next(order) for _ in range(3)]
    second = [next(order) for _ in range(3)]
    for epoch in (first, second):
        assert sorted(itertools.chain(*epoch)) == list(range(7))
    assert [len(batch) for batch in first] == [3, 3, 1]
    assert first != second
    other = batch_order(7, 3, seed=2)
    assert [next(other) for _ in range(3)] != first


def test_items_are_drawn_in_proportion_to_their_weights() -> None:
    weights = torch.tensor([1.0] * 900 + [4.0] * 100)
    drawn = list(itertools.chain(*itertools.islice(batch_order(1000, 10, 0, weights), 600)))
    assert sum(index >= 900 for index in drawn) / len(drawn) == pytest.approx(400 / 1300, abs=0.02)
    assert list(itertools.chain(*itertools.islice(batch_order(1000, 10, 0, weights), 600))) == drawn


def test_learning_rate_by_hand() -> None:
    schedule = Schedule(batch_size=1, lr=1.0, steps=10, warmup_steps=2, final_lr_fraction=0.1)
    assert [schedule.lr_at(step, 10) for step in (0, 1, 2)] == [0.5, 1.0, 1.0]
    assert schedule.lr_at(6, 10) == pytest.approx(0.1 + 0.9 * 0.5)
    assert Schedule(batch_size=4, lr=1.0, epochs=3).total_steps(9) == 9
    with pytest.raises(InputError, match="either"):
        Schedule(batch_size=4, lr=1.0).total_steps(9)
