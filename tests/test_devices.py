"""The device of a process: `--device`, the GPUs of workers in turn, and what is refused."""

import multiprocessing
from types import SimpleNamespace

import pytest
import torch

from foredrive.cli.main import main
from foredrive.devices import DEVICE, chosen_device, take_device
from foredrive.errors import InputError


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(DEVICE, raising=False)


def cards(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)


def test_a_gpu_is_taken_where_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    cards(monkeypatch, 0)
    assert chosen_device() == "cpu"
    cards(monkeypatch, 1)
    assert chosen_device() == "cuda"


def test_workers_take_the_cards_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    cards(monkeypatch, 3)
    taken = []
    for name in ("MainProcess", "ForkServerProcess-1", "ForkServerProcess-2", "ForkServerProcess-6"):
        process = SimpleNamespace(name=name)
        monkeypatch.setattr(multiprocessing, "current_process", lambda process=process: process)
        taken.append(chosen_device())
    assert taken == ["cuda:0", "cuda:0", "cuda:1", "cuda:2"]


def test_a_device_that_is_named_is_taken_by_all(monkeypatch: pytest.MonkeyPatch) -> None:
    cards(monkeypatch, 2)
    for args in (["train", "--device", "cuda:1", "x"], ["train", "--device=cuda:1", "x"]):
        assert take_device(args) == ["train", "x"]
        assert chosen_device() == "cuda:1"
    assert take_device(["train", "--device", "cpu"]) == ["train"]
    assert chosen_device() == "cpu"
    take_device(["train"])  # Nothing is left of the command before
    assert chosen_device() == "cuda:0"


def test_a_gpu_that_is_not_here_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cards(monkeypatch, 1)
    take_device(["--device", "cuda:1"])
    with pytest.raises(InputError, match="--device cuda:1: this machine has 1 GPUs"):
        chosen_device()
    assert main(["models", "--device", "tpu"]) == 2
    assert "--device takes cpu, cuda or cuda:N, not 'tpu'" in capsys.readouterr().err
