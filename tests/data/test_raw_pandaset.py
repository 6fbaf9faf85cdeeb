"""Raw PandaSet: whole logs convert, and what its pickles ask for is never run."""

import os
from pathlib import Path

import numpy as np
import pytest
import raw_pandaset

from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import pinhole_cameras
from foredrive.data.formats.convert import convert
from foredrive.data.lidar import read_sweep
from foredrive.data.log_check import check_log
from foredrive.data.logs import Log
from foredrive.data.notices import read_notices
from foredrive.errors import InputError

PICKLES = (raw_pandaset.CUBOIDS, raw_pandaset.SEMSEG, raw_pandaset.LIDAR)


class Intruder:
    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self) -> tuple:
        return os.system, (self.command,)


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    raw_pandaset.write(tmp_path / "raw")
    return tmp_path / "raw"


def test_a_whole_log_converts(raw: Path, tmp_path: Path) -> None:
    log = Log(convert(raw, "pandaset", tmp_path / "out")[0])
    boxes = read_boxes(log, 0)
    assert boxes is not None
    assert boxes.size_lwh[0].tolist() == pytest.approx([4.7, 1.9, 1.6])
    sweep = read_sweep(log, 0)
    assert sweep is not None
    assert len(sweep[0].range_m) == 3
    assert sweep[0].intensity[0].item() == pytest.approx(7 / 255)


@pytest.mark.parametrize("file", PICKLES)
def test_what_a_pickle_asks_for_is_not_run(file: str, raw: Path, tmp_path: Path) -> None:
    ran = tmp_path / "ran"
    raw_pandaset.write_pickle(raw / file, raw_pandaset.table({"x": [Intruder(f"touch {ran}")]}))
    with pytest.raises(InputError, match=rf"{file}: .*posix\.system") as refusal:
        convert(raw, "pandaset", tmp_path / "out")
    assert "\n" not in str(refusal.value)
    assert not ran.exists()
    assert not list((tmp_path / "out").glob("logs/*/*"))


@pytest.mark.parametrize("file", PICKLES)
def test_a_file_that_was_cut_short_is_named(file: str, raw: Path, tmp_path: Path) -> None:
    whole = (raw / file).read_bytes()
    (raw / file).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=file):
        convert(raw, "pandaset", tmp_path / "out")


def test_a_pickle_that_is_no_table_is_refused(raw: Path, tmp_path: Path) -> None:
    raw_pandaset.write_pickle(raw / raw_pandaset.CUBOIDS, [1, 2])
    with pytest.raises(InputError, match="not a table but a list"):
        convert(raw, "pandaset", tmp_path / "out")


def sweeps_at(log: Log) -> list[int]:
    return [frame for frame in range(len(log)) if read_sweep(log, frame) is not None]


def test_missing_files_cost_what_is_in_them(tmp_path: Path) -> None:
    raw = tmp_path / "raw"
    raw_pandaset.write_drive(raw, 8)
    for number in (2, 3, 4, 5):
        (raw / f"lidar/{number:02d}.pkl.gz").unlink()
    (raw / "camera/left_camera/06.jpg").unlink()
    (raw / "annotations/cuboids/07.pkl.gz").unlink()
    log = Log(convert(raw, "pandaset", tmp_path / "out")[0])
    assert len(log) == 8
    assert sweeps_at(log) == [0, 1, 6, 7]
    images = {name: log.rows(camera.modality_key)[0] for name, camera in pinhole_cameras(log).items()}
    assert images["left_camera"].tolist() == [0, 1, 2, 3, 4, 5, 7]
    assert all(len(frames) == 8 for name, frames in images.items() if name != "left_camera")
    assert [read_boxes(log, frame) is not None for frame in range(8)] == [True] * 7 + [False]
    notices = read_notices(log.path.folder)
    assert "lidar: missing sweeps: 4 (02; 03; 04; 1 more)" in notices
    assert "left_camera: missing images: 1 (06)" in notices
    assert "annotations/cuboids: frames without boxes: 1 (07)" in notices
    findings = [finding.text for finding in check_log(log.path).findings]
    assert "lidar: missing sweeps: 4 (02; 03; 04; 1 more)" in findings


def test_a_part_of_a_log_keeps_the_poses_of_its_frames(tmp_path: Path) -> None:
    raw_pandaset.write_drive(tmp_path / "raw", 3, first=20)
    log = Log(convert(tmp_path / "raw", "pandaset", tmp_path / "out")[0])
    assert np.linalg.norm(np.diff(log.T_world_ego[:, :3, 3], axis=0), axis=-1).tolist() == pytest.approx(
        [1, 1]
    )
    ahead_m = [read_sweep(log, frame)[0].points_ego for frame in range(3)]  # each 5 m ahead of its lidar
    for points in ahead_m[1:]:
        np.testing.assert_allclose(points, ahead_m[0], atol=0.02)


def test_a_part_of_a_log_whose_lists_are_whole(tmp_path: Path) -> None:
    raw = tmp_path / "raw"
    raw_pandaset.write_drive(raw, 6)
    for file in (*raw.glob("*/0[01].*"), *raw.glob("*/*/0[01].*")):
        file.unlink()
    log = Log(convert(raw, "pandaset", tmp_path / "out")[0])
    assert ((log.t_us - log.t_us[0]) * 1e-6).tolist() == pytest.approx([0, 0.1, 0.2, 0.3])
    assert log.t_us[0] * 1e-6 == pytest.approx(100.2)
    assert read_notices(log.path.folder) == []


def test_lists_that_fit_no_frames_are_refused(tmp_path: Path) -> None:
    raw = tmp_path / "raw"
    raw_pandaset.write_drive(raw, 3, first=20)
    (raw / "meta/timestamps.json").write_text("[100.1, 100.2]")
    with pytest.raises(InputError, match=r"meta/timestamps\.json: 2 entries for the frames 20 to 22"):
        convert(raw, "pandaset", tmp_path / "out")


def test_without_the_poses_of_the_vehicle_the_file_is_named(tmp_path: Path) -> None:
    raw = tmp_path / "raw"
    raw_pandaset.write_drive(raw, 2)
    (raw / "camera/front_camera/poses.json").unlink()
    with pytest.raises(InputError, match="no poses of front_camera"):
        convert(raw, "pandaset", tmp_path / "out")
