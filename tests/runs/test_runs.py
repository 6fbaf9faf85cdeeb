"""Runs as a whole, in miniature: what they leave on disk, how they go on, that they learn."""

import dataclasses
import logging
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from lightning_fabric import Fabric
from miniature import STEPS, miniature, with_steps, write_log
from safetensors.torch import load_file
from torch.utils.data import Dataset

from foredrive.data import ClipDataset, LogPath, collate
from foredrive.engine.loop import Schedule, train
from foredrive.engine.metrics_log import read_metrics
from foredrive.errors import InputError
from foredrive.methods.nemo.objective import NemoObjective
from foredrive.runs import Run, open_run, train_run
from foredrive.runs.build import build_agent, build_objective
from foredrive.scene import Example

STAGES = ("pretrain", "finetune")


def files(folder: Path) -> dict[str, bytes]:
    """Every file of a run but the cache's, by its path in the run."""
    found = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in found
        if path.relative_to(folder).parts[0] != "cache"
    }


def losses(run: Path, stage: str) -> list[dict[str, float | int]]:
    """The lines of a stage's metrics, without how long a step took."""
    lines = read_metrics(run / stage / "metrics.jsonl")
    return [
        {name: value for name, value in line.items() if name not in ("step_s", "cpu_s")} for line in lines
    ]


def test_what_training_leaves_on_disk(trained: Run) -> None:
    checkpoint = {
        f"checkpoints/step_{STEPS:07d}/{name}"
        for name in ("model.safetensors", "optimizer.safetensors", "progress.json")
    }
    of_a_stage = {"metrics.jsonl", "conditions.json", "model.safetensors"} | checkpoint
    expected = {"config.yaml", "logs.json", "made_by.json", "rigs.yaml", ".lock"}
    expected |= {f"{stage}/{name}" for stage in STAGES for name in of_a_stage}
    assert set(files(trained.folder)) == expected
    assert open_run(trained.folder) == trained
    assert trained.weights == trained.folder / "finetune" / "model.safetensors"
    for stage, own in zip(STAGES, (set(), {"wpts"}), strict=True):
        lines = losses(trained.folder, stage)
        assert [line["step"] for line in lines] == [1, 2, 3]
        assert set(lines[0]) == {"step", "loss", "occ", "l1", "perc"} | own


def test_a_finished_run_is_left_alone(trained: Run) -> None:
    before = files(trained.folder)
    assert train_run(trained.recipe, trained.logs, trained.folder) == trained
    assert files(trained.folder) == before


def test_a_run_opens_from_any_working_directory(
    log: LogPath, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its logs were named relative to the directory of training, which goes on from there too."""
    whole = with_steps(miniature(), 1, 1)
    recipe = dataclasses.replace(whole, pretrain=None)
    monkeypatch.chdir(log.folder.parent)
    relative = LogPath(Path(log.folder.name), Path(os.path.relpath(log.maps_dir)))
    train_run(recipe, [relative], tmp_path / "run")
    train_run(recipe, [relative], tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    assert open_run(Path("run")).logs[0].folder == log.folder


def test_pretraining_leaves_the_planner_alone_and_finetuning_does_not(trained: Run) -> None:
    torch.manual_seed(trained.recipe.pretrain.schedule.seed)
    fresh = build_agent(trained.recipe).state_dict()
    first, second = (load_file(trained.folder / stage / "model.safetensors") for stage in STAGES)
    planner = {name for name, value in fresh.items() if name.startswith("planner.") and value.dim() > 1}
    backbone = {name for name in fresh if name.startswith("world_model.backbone.lateral.")}
    assert all(torch.equal(first[name], fresh[name]) for name in planner)
    assert not any(torch.equal(second[name], first[name]) for name in planner - {"planner.command.weight"})
    for name in backbone:
        assert not torch.equal(first[name], fresh[name])
        assert not torch.equal(second[name], first[name])


def test_a_folder_holds_one_run(trained: Run, log: LogPath, tmp_path: Path) -> None:
    longer = with_steps(trained.recipe, pretrain=STEPS + 1, finetune=STEPS)
    other_log = write_log(tmp_path, name="other")
    before = files(trained.folder)
    with pytest.raises(InputError, match="holds a run with another recipe; choose another folder"):
        train_run(longer, trained.logs, trained.folder)
    with pytest.raises(InputError, match="holds a run with other logs"):
        train_run(trained.recipe, [log, other_log], trained.folder)
    assert files(trained.folder) == before


def test_fine_tuning_may_start_from_another_runs_pretraining(trained: Run, tmp_path: Path) -> None:
    """On the same logs and seed the weights come out as those of the run that did both."""
    run = train_run(trained.recipe, trained.logs, tmp_path / "few", start=trained.folder)
    assert open_run(run.folder) == run
    assert run.start == trained.folder
    assert not (run.folder / "pretrain").exists()
    mine, theirs = load_file(run.weights), load_file(trained.weights)
    assert all(torch.equal(mine[name], theirs[name]) for name in theirs)
    with pytest.raises(InputError, match="holds a run with another start"):
        train_run(trained.recipe, trained.logs, run.folder)
    with pytest.raises(InputError, match="no pre-trained weights"):
        train_run(trained.recipe, trained.logs, tmp_path / "other", start=run.folder)
    assert not (tmp_path / "other").exists()


def test_fine_tuning_may_start_from_the_last_weights_if_only_those_were_kept(
    trained: Run, tmp_path: Path
) -> None:
    """As in the models that come with the package."""
    kept = shutil.copytree(trained.folder, tmp_path / "kept", ignore=shutil.ignore_patterns("pretrain"))
    slow = dataclasses.replace(trained.recipe.finetune.schedule, steps=1, warmup_steps=0, lr=1e-9)
    recipe = dataclasses.replace(
        trained.recipe, finetune=dataclasses.replace(trained.recipe.finetune, schedule=slow)
    )
    run = train_run(recipe, trained.logs, tmp_path / "more", start=kept)
    mine, theirs = load_file(run.weights), load_file(trained.weights)
    of_world = [name for name in theirs if name.startswith("world_model.") and name.endswith("weight")]
    assert of_world
    assert all(torch.allclose(mine[name], theirs[name], atol=1e-6) for name in of_world)


def test_a_recipe_without_pretraining_starts_from_scratch(trained: Run, tmp_path: Path) -> None:
    recipe = dataclasses.replace(trained.recipe, pretrain=None)
    run = train_run(recipe, trained.logs, tmp_path)
    assert open_run(tmp_path) == run
    assert not (tmp_path / "pretrain").exists()
    assert losses(tmp_path, "finetune")[0]["wpts"] != losses(trained.folder, "finetune")[0]["wpts"]


def test_logs_without_anything_to_label_voxels_from_are_said(
    log: LogPath, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "logs" / "flat_train" / "less"
    folder.mkdir(parents=True)
    for file in log.folder.iterdir():
        if not file.name.startswith(("lidar", "custom.lidar")):
            shutil.copy(file, folder)
    recipe = with_steps(miniature(), 1, 1)
    with caplog.at_level(logging.WARNING):
        train_run(recipe, [log], tmp_path / "whole")
    assert "none of the logs has lidar" not in caplog.text
    with caplog.at_level(logging.WARNING):
        train_run(recipe, [LogPath(folder, log.maps_dir)], tmp_path / "less")
    assert "none of the logs has lidar" in caplog.text


def test_logs_that_cannot_be_read_make_no_run(tmp_path: Path) -> None:
    log = write_log(tmp_path)
    (log.folder / "sync.arrow").write_bytes(b"ARROW1")
    with pytest.raises(InputError, match=r"sync\.arrow"):
        train_run(miniature(), [log], tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("content", ["", "[]", '{"logs": [{}], "cache_dir": "a"}'])
def test_a_run_that_does_not_know_its_logs_is_named(content: str, trained: Run, tmp_path: Path) -> None:
    for name in ("config.yaml", "logs.json"):
        (tmp_path / name).write_bytes((trained.folder / name).read_bytes())
    (tmp_path / "logs.json").write_text(content)
    with pytest.raises(InputError, match=r"logs\.json: cannot be read as paths of logs"):
        open_run(tmp_path)


# --- going on -----------------------------------------------------------------------------------------------

Stop = Callable[[pytest.MonkeyPatch, int], None]


def stop_in_the_model(monkeypatch: pytest.MonkeyPatch, call: int) -> None:
    """Interrupt forward pass number `call` when it is done and has changed the batch norms' statistics."""
    forward, calls = NemoObjective.forward, iter(range(1, 100))

    def interrupted(self: NemoObjective, example: Example, generator: torch.Generator) -> dict:
        out = forward(self, example, generator)
        if next(calls) == call:
            raise KeyboardInterrupt
        return out

    monkeypatch.setattr(NemoObjective, "forward", interrupted)


def stop_in_the_optimizer(monkeypatch: pytest.MonkeyPatch, call: int) -> None:
    """Interrupt optimizer step number `call` when it has changed all weights."""
    step, calls = torch.optim.AdamW.step, iter(range(1, 100))

    def interrupted(self: torch.optim.AdamW, closure: None = None) -> None:
        step(self, closure)
        if next(calls) == call:
            raise KeyboardInterrupt

    monkeypatch.setattr(torch.optim.AdamW, "step", interrupted)


def stop_in_the_data(monkeypatch: pytest.MonkeyPatch, call: int) -> None:
    """Interrupt the reading of the last clip of batch number `call`."""
    read, calls = ClipDataset.__getitem__, iter(range(1, 100))

    def interrupted(self: ClipDataset, index: int) -> Example:
        item = read(self, index)
        if next(calls) == 2 * call:
            raise KeyboardInterrupt
        return item

    monkeypatch.setattr(ClipDataset, "__getitem__", interrupted)


def press_ctrl_c(monkeypatch: pytest.MonkeyPatch, call: int) -> None:
    """Send the signal in the middle of step number `call`, which is then to be finished."""
    forward, calls = NemoObjective.forward, iter(range(1, 100))

    def interrupted(self: NemoObjective, example: Example, generator: torch.Generator) -> dict:
        if next(calls) == call:
            signal.raise_signal(signal.SIGINT)
        return forward(self, example, generator)

    monkeypatch.setattr(NemoObjective, "forward", interrupted)


@pytest.mark.parametrize(
    ("stop", "step"),
    [
        (stop_in_the_data, 1),
        (stop_in_the_data, STEPS + 2),
        (stop_in_the_model, 2),
        (stop_in_the_model, STEPS + 1),
        (stop_in_the_optimizer, STEPS),
        (stop_in_the_optimizer, STEPS + 2),
        (press_ctrl_c, 1),
        (press_ctrl_c, STEPS + 2),
    ],
)
def test_an_interrupted_run_goes_on_exactly(
    stop: Stop, step: int, trained: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = (trained.recipe, trained.logs, tmp_path / "run", trained.cache_dir)
    with monkeypatch.context() as patches:
        stop(patches, step)
        with pytest.raises(KeyboardInterrupt):
            train_run(*arguments)
    done = sum(len(losses(tmp_path / "run", stage)) for stage in STAGES)
    if stop is press_ctrl_c:
        assert done == step
        stage = STAGES[(step - 1) // STEPS]
        assert list((tmp_path / "run" / stage).glob(f"checkpoints/step_{(step - 1) % STEPS + 1:07d}"))
    else:
        assert done == step - 1
    train_run(*arguments)
    for stage in STAGES:
        assert losses(tmp_path / "run", stage) == losses(trained.folder, stage)
        weights = load_file(tmp_path / "run" / stage / "model.safetensors")
        for name, straight in load_file(trained.folder / stage / "model.safetensors").items():
            assert torch.equal(weights[name], straight), f"{stage}: {name}"


def test_a_second_ctrl_c_does_not_wait(trained: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def twice(self: NemoObjective, example: Example, generator: torch.Generator) -> dict:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("went on")

    monkeypatch.setattr(NemoObjective, "forward", twice)
    with pytest.raises(KeyboardInterrupt):
        train_run(trained.recipe, trained.logs, tmp_path / "run", trained.cache_dir)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


# --- learning -----------------------------------------------------------------------------------------------


class OneClip(Dataset[Example]):
    """The same clip over and over."""

    def __init__(self, example: Example) -> None:
        self.example = example

    def __len__(self) -> int:
        return 1

    def __getitem__(self, index: int) -> Example:
        return self.example


@pytest.mark.parametrize(
    ("stage", "falls_to"),
    [
        ("pretrain", {"loss": 0.3, "occ": 0.3, "l1": 0.7}),
        ("finetune", {"loss": 0.3, "occ": 0.4, "wpts": 0.3}),
    ],
)
def test_training_trains(stage: str, falls_to: dict[str, float], trained: Run, tmp_path: Path) -> None:
    """The losses fall to a share of what they were on one clip that is seen again and again."""
    recipe = trained.recipe
    clip = OneClip(ClipDataset(trained.logs, recipe.clips, trained.cache_dir)[0])
    torch.manual_seed(0)
    agent = build_agent(recipe)
    schedule = Schedule(batch_size=1, lr=2e-2, steps=50, final_lr_fraction=1.0)
    objective = build_objective(recipe, getattr(recipe, stage), agent)
    train(objective, clip, collate, schedule, tmp_path, Fabric(accelerator="cpu", devices=1))
    lines = losses(tmp_path, ".")
    for name, share in falls_to.items():
        values = [float(line[name]) for line in lines]
        first, last = sum(values[:3]) / 3, sum(values[-5:]) / 5
        assert last < share * first, f"{name}: {first:.3f} -> {last:.3f}"
