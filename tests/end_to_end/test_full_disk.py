"""A disk that takes no more in the middle of each verb: one line names the file, nothing half-written stays.

The disk is made full by the operating system: beyond a limit on the size of files every write fails.
"""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from full_disk import files_up_to
from torch._utils import ExceptionWrapper

from foredrive.cli import main as program
from foredrive.data import LogPath, find_logs
from foredrive.engine.metrics_log import read_metrics
from foredrive.files import atomic_path
from foredrive.runs import Run

Program = Callable[..., tuple[int, str]]
RECORD = ("record", "--town", "Town02", "--seconds", "1", "--rate", "2", "--image-size", "36", "64")
FULL = "larger than files may be here"


def all_files(folder: Path) -> set[str]:
    """Files by their path in the folder, scratch files included."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root with a recording; what is compiled and kept for that is on disk after it."""
    out = tmp_path_factory.mktemp("recorded")
    assert program.main([*RECORD, "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def evaluated(trained: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An evaluation; labels of the clips are kept after it."""
    out = tmp_path_factory.mktemp("evaluated")
    assert program.main(["evaluate", str(trained.folder), "--out", str(out), "--examples", "1"]) == 0
    return out


@pytest.mark.usefixtures("recorded")
def test_the_map_of_a_recording(foredrive: Program, tmp_path: Path) -> None:
    with files_up_to(100_000):
        code, err = foredrive(*RECORD, "--out", tmp_path)
    assert (code, err) == (2, f"foredrive: {tmp_path}/maps/foredrive/foredrive_Town02.arrow: {FULL}\n")
    assert all_files(tmp_path) == set()


def test_the_log_of_a_recording(recorded: Path, foredrive: Program, tmp_path: Path) -> None:
    shutil.copytree(recorded / "maps", tmp_path / "maps")
    before = all_files(tmp_path)
    with files_up_to(20_000):
        code, err = foredrive(*RECORD, "--out", tmp_path)
    assert (code, err) == (2, f"foredrive: {tmp_path}/logs/town_train/Town02_seed0: {FULL}\n")
    assert all_files(tmp_path) == before
    assert foredrive(*RECORD, "--out", tmp_path) == (0, "")
    assert all_files(tmp_path) == all_files(recorded)


def test_a_checkpoint_and_the_metrics_of_training(
    log: LogPath, trained: Run, foredrive: Program, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    arguments = ("train", "miniature", "--logs", log.folder, "--out", run, "--cache", trained.cache_dir)
    with files_up_to(20_000):
        code, err = foredrive(*arguments)
    assert (code, err) == (2, f"foredrive: {run}/pretrain/checkpoints/step_0000003: {FULL}\n")
    begun = {"config.yaml", "logs.json", "made_by.json", "rigs.yaml", ".lock"}
    assert all_files(run) == {*begun, "pretrain/metrics.jsonl", "pretrain/conditions.json"}
    with files_up_to(200):
        code, err = foredrive(*arguments)
    assert (code, err) == (2, f"foredrive: {run}/pretrain/metrics.jsonl: {FULL}\n")
    assert foredrive(*arguments) == (0, "")
    assert all_files(run) == {file for file in all_files(trained.folder) if not file.startswith("cache")}
    for stage in ("pretrain", "finetune"):
        found, expected = (
            [line["loss"] for line in read_metrics(folder / stage / "metrics.jsonl")]
            for folder in (run, trained.folder)
        )
        assert found == expected


def test_a_kept_label(log: LogPath, trained: Run, foredrive: Program, tmp_path: Path) -> None:
    """The first thing that training writes beyond the run's own few lines."""
    ignored = shutil.ignore_patterns("cache", "finetune")
    run = shutil.copytree(trained.folder, tmp_path / "run", ignore=ignored)
    with files_up_to(100):
        code, err = foredrive(
            "train", "miniature", "--logs", log.folder, "--out", run, "--cache", tmp_path / "cache"
        )
    assert code == 2
    assert err.startswith(f"foredrive: {tmp_path}/cache/labels/")
    assert err.endswith(f".labels: {FULL}\n")
    assert err.count("\n") == 1
    assert all_files(tmp_path / "cache") == set()


@pytest.mark.usefixtures("evaluated")
def test_the_summary_of_an_evaluation(trained: Run, foredrive: Program, tmp_path: Path) -> None:
    with files_up_to(10_000):
        code, err = foredrive("evaluate", trained.folder, "--out", tmp_path)
    assert (code, err) == (2, f"foredrive: {tmp_path}/summary.json: {FULL}\n")
    assert all_files(tmp_path) == set()


def test_the_report_of_an_evaluation(evaluated: Path, trained: Run, foredrive: Program) -> None:
    before = {name: (evaluated / name).read_bytes() for name in ("summary.json", "report.html")}
    with files_up_to(100_000):
        code, err = foredrive("evaluate", trained.folder, "--out", evaluated, "--examples", "1")
    assert (code, err) == (2, f"foredrive: {evaluated}/report.html: {FULL}\n")
    assert {name: (evaluated / name).read_bytes() for name in all_files(evaluated)} == before


def test_the_report_of_a_score(foredrive: Program, tmp_path: Path) -> None:
    """The figures and the scores of the frames, which would fit, do not appear without it."""
    label = "Car 0.00 0 0.0 0 0 50 50 1.6 1.8 4.2 2.00 1.70 20.00 0.0"
    for name, line in (("truth", label), ("results", f"{label} 0.9")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "000000.txt").write_text(f"{line}\n")
    arguments = ("score", tmp_path / "results", "--truth", tmp_path / "truth", "--out")
    assert foredrive(*arguments, tmp_path / "whole") == (0, "")  # numba keeps what it compiles
    with files_up_to(5_000):
        code, err = foredrive(*arguments, tmp_path / "out")
    assert (code, err) == (2, f"foredrive: {tmp_path}/out/report.html: {FULL}\n")
    assert not (tmp_path / "out").exists()
    assert all_files(tmp_path / "whole") == {"summary.json", "frames.jsonl", "report.html"}


@pytest.mark.usefixtures("evaluated")
def test_a_picture_of_a_log(log: LogPath, foredrive: Program, tmp_path: Path) -> None:
    picture = tmp_path / "log.png"
    assert foredrive("view", log.folder, "--save", picture) == (0, "")
    picture.unlink()
    with files_up_to(10_000):
        code, err = foredrive("view", log.folder, "--save", picture)
    assert (code, err) == (2, f"foredrive: {picture}: {FULL}\n")
    assert all_files(tmp_path) == set()


@pytest.mark.real
def test_a_converted_log(real_data: Path, foredrive: Program, tmp_path: Path) -> None:
    with files_up_to(100_000):
        code, err = foredrive("convert", "pandaset", real_data / "pandaset", "--out", tmp_path)
    assert code == 2
    assert err.startswith(f"foredrive: {tmp_path}/logs/pandaset_train/")
    assert err.endswith(f": {FULL}\n")
    assert err.count("\n") == 1
    assert all_files(tmp_path) == set()


def test_a_full_disk_met_by_a_worker_process_is_the_same_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    label = tmp_path / "labels" / "a.labels"

    def verb() -> None:
        try:
            with atomic_path(label):
                raise OSError(28, "No space left on device", "/scratch/name")
        except OSError:  # how torch's DataLoader carries an error over from a worker
            ExceptionWrapper(where="in DataLoader worker process 0").reraise()

    monkeypatch.setattr(program, "VERBS", {"try": verb, "other": lambda: None})
    assert program.main(["try"]) == 2
    assert capsys.readouterr().err == f"foredrive: {label}: no space left on the disk\n"


@pytest.mark.parametrize("verb", ["train", "evaluate", "record"])
def test_a_folder_that_is_a_file_is_named(
    verb: str, log: LogPath, trained: Run, foredrive: Program, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    out.write_text("something else")
    arguments = {
        "train": ("train", "miniature", "--logs", log.folder),
        "evaluate": ("evaluate", trained.folder, "--examples", "0"),
        "record": RECORD,
    }
    code, err = foredrive(*arguments[verb], "--out", out)
    assert code == 2
    assert err == f"foredrive: --out {out}: this is a file; a folder is needed\n"
    assert out.read_text() == "something else"


def test_a_picture_that_is_a_folder_is_named(log: LogPath, foredrive: Program, tmp_path: Path) -> None:
    code, err = foredrive("view", log.folder, "--save", tmp_path)
    assert (code, err) == (2, f"foredrive: {tmp_path}: there is a folder of that name\n")


def test_a_log_that_is_being_recorded_is_not_found_by_others(recorded: Path) -> None:
    assert [found.name for found in find_logs(recorded)] == ["town_train/Town02_seed0"]
