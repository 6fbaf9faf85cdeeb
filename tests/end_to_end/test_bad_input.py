"""What a user reads who trains on bad input or evaluates on it: one line that names it, and exit code 2."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import synthetic_log
from arrow_surgery import rewrite_column

from foredrive.data import LogPath
from foredrive.engine.summary import read_summary
from foredrive.runs import Run

EGO, CAMERA = "ego_state_se3", "camera.pcam_f0"
NO_IMAGE = b"no image at all"
Damage = Callable[[Path], None]
Program = Callable[..., tuple[int, str]]


def copy_of(log: LogPath, root: Path) -> Path:
    return Path(shutil.copytree(log.folder, root / "logs" / "flat_train" / "damaged"))


def spoil_images(folder: Path, *frames: int) -> None:
    rewrite_column(
        folder / f"{CAMERA}.arrow",
        f"{CAMERA}.data",
        lambda rows: [NO_IMAGE if i in frames else row for i, row in enumerate(rows)],
    )


def no_log(folder: Path) -> None:
    for file in folder.iterdir():
        file.unlink()
    (folder / "notes.txt").write_text("the log was here")


def truncated_images(folder: Path) -> None:
    file = folder / f"{CAMERA}.arrow"
    file.write_bytes(file.read_bytes()[:-1000])


def nan_pose(folder: Path) -> None:
    nan = lambda rows: [[np.nan] * 7 if i == 7 else row for i, row in enumerate(rows)]  # noqa: E731
    rewrite_column(folder / f"{EGO}.arrow", f"{EGO}.imu_se3", nan)


def time_backwards(folder: Path) -> None:
    rewrite_column(folder / f"{EGO}.arrow", f"{EGO}.timestamp_us", lambda t: [*t[:7], t[0], *t[8:]])


def no_camera(folder: Path) -> None:
    for file in folder.glob("camera.*"):
        file.unlink()


def no_ego(folder: Path) -> None:
    (folder / f"{EGO}.arrow").unlink()


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (no_log, "{log}: no 123D log here (a log is a folder with a sync.arrow)"),
        (truncated_images, "{log}/camera.pcam_f0.arrow: cannot read it as an Arrow file"),
        (nan_pose, "{log}/ego_state_se3.arrow: the ego pose of row 7 is not a finite pose"),
        (time_backwards, "{log}/ego_state_se3.arrow: time runs backwards at row 7"),
        (no_camera, "{log}: no pinhole camera"),
        (no_ego, "{log}: a log without ego poses"),
    ],
)
@pytest.mark.parametrize("verb", ["train", "evaluate"])
def test_a_log_that_cannot_be_used_is_named(
    verb: str, damage: Damage, said: str, log: LogPath, trained: Run, foredrive: Program, tmp_path: Path
) -> None:
    folder, out = copy_of(log, tmp_path), tmp_path / "out"
    damage(folder)
    subject = "miniature" if verb == "train" else trained.folder
    code, err = foredrive(verb, subject, "--logs", folder, "--out", out)
    assert code == 2
    assert err.startswith(f"foredrive: {said.format(log=folder)}")
    assert err.count("\n") == 1
    assert not out.exists()


def test_a_corrupt_image_stops_training(log: LogPath, foredrive: Program, tmp_path: Path) -> None:
    folder = copy_of(log, tmp_path)
    spoil_images(folder, *range(51))
    code, err = foredrive("train", "miniature", "--logs", folder, "--out", tmp_path / "run")
    assert code == 2
    reason = f"these {len(NO_IMAGE)} bytes are not an image"
    assert err.startswith(f"foredrive: {folder}/{CAMERA}.arrow: cannot read the image at frame ")
    assert err.endswith(f": {reason}\n")
    assert err.count("\n") == 1
    assert not list((tmp_path / "run").rglob("*.safetensors"))


@pytest.mark.parametrize("batch_size", [1, 3])
def test_evaluation_counts_corrupt_images_as_failed(
    batch_size: int, log: LogPath, trained: Run, foredrive: Program, tmp_path: Path
) -> None:
    """Each of the four clips is seen at its now (frames 5, 10, 15 and 20) and half a second before it."""
    folder, out = copy_of(log, tmp_path), tmp_path / "out"
    spoil_images(folder, 0, 20)
    options = ("--batch-size", str(batch_size), "--examples", "1")
    assert foredrive("evaluate", trained.folder, "--logs", folder, "--out", out, *options) == (0, "")
    summary = read_summary(out / "summary.json")
    assert (summary["items"], summary["failed"]) == (4, 2)
    assert summary["planning.uniad.frames_counted"] == 2
    report = (out / "report.html").read_text()
    assert "Failed clips of this model: 2." in report
    assert f"{CAMERA}.arrow: cannot read the image at frame 20" in report


def test_evaluation_of_nothing_but_corrupt_images_is_one_line(
    log: LogPath, trained: Run, foredrive: Program, tmp_path: Path
) -> None:
    folder = copy_of(log, tmp_path)
    spoil_images(folder, *range(51))
    code, err = foredrive("evaluate", trained.folder, "--logs", folder, "--out", tmp_path / "out")
    assert code == 2
    assert err.startswith("foredrive: there is nothing to evaluate: all 4 items failed, ")
    assert f"{CAMERA}.arrow: cannot read the image at frame" in err
    assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_sweeps_without_points_leave_occupancy_unknown_and_the_rest_judged(
    trained: Run, foredrive: Program, tmp_path: Path
) -> None:
    folder = synthetic_log.write(tmp_path, empty_sweeps=True)
    run, out = tmp_path / "run", tmp_path / "out"
    assert foredrive("train", "miniature", "--logs", folder, "--out", run) == (0, "")
    assert foredrive("evaluate", trained.folder, "--logs", folder, "--out", out, "--examples", "0") == (0, "")
    summary = read_summary(out / "summary.json")
    assert summary["failed"] == 0
    assert summary["occupancy.iou_now"] is None
    assert isinstance(summary["planning.uniad.l2_avg_m"], float)


def test_a_log_without_cameras_beside_one_with_them_is_masked(
    log: LogPath, trained: Run, foredrive: Program, tmp_path: Path
) -> None:
    blind = copy_of(log, tmp_path)
    no_camera(blind)
    out = tmp_path / "out"
    both = ("--logs", blind, log.folder)
    assert foredrive("train", "miniature", *both, "--out", tmp_path / "run") == (0, "")
    assert foredrive("evaluate", trained.folder, *both, "--out", out, "--examples", "0") == (0, "")
    assert read_summary(out / "summary.json")["items"] == 8


def test_a_log_without_cameras_can_be_looked_at(log: LogPath, foredrive: Program, tmp_path: Path) -> None:
    blind = copy_of(log, tmp_path)
    no_camera(blind)
    assert foredrive("view", blind, "--save", tmp_path / "blind.png") == (0, "")
    assert (tmp_path / "blind.png").stat().st_size > 1000


def test_weights_that_cannot_be_read_are_named(
    log: LogPath, trained: Run, foredrive: Program, tmp_path: Path
) -> None:
    run = Path(shutil.copytree(trained.folder, tmp_path / "run"))
    weights = run / "finetune" / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    code, err = foredrive("evaluate", run, "--logs", log.folder, "--out", tmp_path / "out")
    assert code == 2
    assert err.startswith(f"foredrive: {weights}: weights cannot be read")
    assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_logs_that_are_gone_are_named(log: LogPath, foredrive: Program, tmp_path: Path) -> None:
    folder = copy_of(log, tmp_path)
    assert foredrive("train", "miniature", "--logs", folder, "--out", tmp_path / "run") == (0, "")
    shutil.rmtree(folder)
    code, err = foredrive("evaluate", tmp_path / "run")
    assert code == 2
    assert err.startswith(f"foredrive: {folder}")
    assert err.count("\n") == 1


@pytest.mark.parametrize("size", ["0", "-1"])
def test_a_batch_of_nothing_is_refused(size: str, trained: Run, foredrive: Program, tmp_path: Path) -> None:
    code, err = foredrive("evaluate", trained.folder, "--out", tmp_path / "out", "--batch-size", size)
    assert code == 2
    assert err == f"foredrive: the batch size must be at least 1, got {size}\n"


def test_the_report_says_where_its_figures_come_from(
    log: LogPath, trained: Run, foredrive: Program, tmp_path: Path
) -> None:
    assert foredrive("evaluate", trained.folder, "--out", tmp_path, "--examples", "1") == (0, "")
    report, summary = (tmp_path / "report.html").read_text(), read_summary(tmp_path / "summary.json")
    assert f"of {summary['machine.cpu']}" in report
    assert str(summary["commit"]) in report
    assert "None" not in report.partition("<img")[0]
