"""Output folders that another process writes to, that are read-only, or whose files are from the future."""

import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from foredrive.data import LogPath
from foredrive.engine.folder import held, held_for_results
from foredrive.engine.metrics_log import read_metrics
from foredrive.files import atomic_path
from foredrive.runs import Run

Program = Callable[..., tuple[int, str]]
RECORD = ("record", "--town", "Town02", "--seconds", "1", "--rate", "2", "--image-size", "36", "64")


@pytest.fixture
def read_only(tmp_path: Path) -> Iterator[Path]:
    """A folder on a read-only mount; permissions would not stop root."""
    folder = tmp_path / "read_only"
    folder.mkdir()
    (folder / "there").write_text("before")
    try:
        subprocess.run(["mount", "--bind", folder, folder], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("mounting is not allowed here")
    try:
        subprocess.run(["mount", "-o", "remount,bind,ro", folder], check=True, capture_output=True)
        yield folder
    finally:
        subprocess.run(["umount", folder], check=True)


def test_evaluations_into_one_folder(trained: Run, foredrive: Program, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with held_for_results(out):
        code, err = foredrive("evaluate", trained.folder, "--out", out, "--examples", "0")
    assert (code, err) == (
        2,
        f"foredrive: {out}: another process is writing results to it; wait for it or end it\n",
    )
    assert not out.exists()


def test_a_run_is_evaluated_while_it_is_being_trained(
    trained: Run, foredrive: Program, tmp_path: Path
) -> None:
    run = Path(shutil.copytree(trained.folder, tmp_path / "run", ignore=shutil.ignore_patterns("cache")))
    with held(run):
        assert foredrive("evaluate", run, "--examples", "0") == (0, "")
    assert not (run / ".results.lock").exists()
    assert (run / "summary.json").is_file()


def test_recordings_of_one_drive(foredrive: Program, tmp_path: Path) -> None:
    log = tmp_path / "logs/town_train/Town02_seed0"
    with atomic_path(log, alone=True) as temporary:
        code, err = foredrive(*RECORD, "--out", tmp_path)
        temporary.mkdir()
    assert code == 2
    assert err == f"foredrive: {log}: another process ({os.getpid()}) is writing it; wait for it or end it\n"
    assert log.is_dir()


@pytest.mark.parametrize("verb", ["train", "evaluate", "view"])
def test_a_read_only_folder_is_named(
    verb: str, read_only: Path, log: LogPath, trained: Run, foredrive: Program
) -> None:
    arguments = {
        "train": ("train", "miniature", "--logs", log.folder, "--out", read_only / "run"),
        "evaluate": ("evaluate", trained.folder, "--examples", "0", "--out", read_only),
        "view": ("view", log.folder, "--save", read_only / "log.png"),
    }
    code, err = foredrive(*arguments[verb])
    assert code == 2
    assert err.startswith(f"foredrive: {read_only}")
    assert err.endswith(": the disk is read-only\n")
    assert err.count("\n") == 1
    assert [path.name for path in read_only.iterdir()] == ["there"]


def test_training_goes_on_after_the_clock_has_gone_back(
    log: LogPath, trained: Run, foredrive: Program, tmp_path: Path
) -> None:
    """Files of the run are from the future then; what goes on must not follow from their times."""
    run = Path(shutil.copytree(trained.folder, tmp_path / "run"))
    shutil.rmtree(run / "finetune")
    tomorrow_s = time.time() + 86_400
    for path in run.rglob("*"):
        os.utime(path, (tomorrow_s, tomorrow_s))
    kept = {path: path.stat().st_mtime_ns for path in (run / "pretrain").rglob("*") if path.is_file()}
    arguments = ("train", "miniature", "--logs", log.folder, "--out", run, "--cache", trained.cache_dir)
    assert foredrive(*arguments) == (0, "")
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    found, expected = (
        [line["loss"] for line in read_metrics(folder / "finetune/metrics.jsonl")]
        for folder in (run, trained.folder)
    )
    assert found == expected
