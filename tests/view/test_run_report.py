"""The report of a run: what its notes say and how its examples are named."""

import dataclasses
import json
from pathlib import Path

from foredrive.data import LogPath
from foredrive.runs import Run
from foredrive.runs.recipes.known import find_recipe
from foredrive.scene import Example
from foredrive.tasks.evaluation.run import Failure
from foredrive.view.example_panel import example_title
from foredrive.view.run_report import report_on_run

SUMMARY = {"command": "foredrive evaluate a", "commit": None, "machine.cpu": "CPU", "machine.cores": 2}


def make_run(folder: Path, perceptual: float) -> Run:
    (folder / "pretrain").mkdir(parents=True)
    line = {"step": 1, "loss": 2.0, "perc": perceptual}
    (folder / "pretrain" / "metrics.jsonl").write_text(json.dumps(line) + "\n")
    logs = (LogPath(folder / "logs" / "a_train" / "one", folder),)
    return Run(folder, find_recipe("nemo_tiny"), logs, folder / "cache")


def test_testing_on_training_logs_is_said(tmp_path: Path) -> None:
    run = make_run(tmp_path, perceptual=0.3)
    other = LogPath(tmp_path / "logs" / "a_test" / "two", tmp_path)
    fair = report_on_run(run, [other], SUMMARY, [])
    unfair = report_on_run(run, [*run.logs, other], SUMMARY, [])
    assert fair.notes == []
    assert unfair.notes[0].startswith("1 of the 2 evaluated logs were trained on")
    assert fair.title == "nemo_tiny on a_test/two"
    assert fair.provenance.commit == "not a git checkout"
    assert fair.losses["pretrain"][0]["loss"] == 2.0
    assert list(fair.losses["finetune"]) == []


def test_a_perceptual_loss_that_was_off_and_failures_are_said(tmp_path: Path) -> None:
    run = make_run(tmp_path, perceptual=0.0)
    failures = tuple(Failure(f"log@{i}", "not finite") for i in range(9))
    report = report_on_run(run, [], SUMMARY, [], failures)
    assert "perceptual loss was off" in report.notes[0]
    assert report.notes[1] == "Failed: log@0: not finite"
    assert len(report.notes) == 1 + 5


def test_an_example_is_named_by_log_and_time(example: Example) -> None:
    named = dataclasses.replace(example, key=("town_test/Town05_seed3@1577836802250000",))
    assert example_title(named) == "town_test/Town05_seed3 at 2020-01-01 00:00:02.25 UTC"
