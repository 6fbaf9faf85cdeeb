"""KITTI's raw recordings: a made drive whose points and images lie where they should."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.formats.convert import convert
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.data.notices import read_notices
from foredrive.errors import InputError

DRIVE = "2011_09_26_drive_0005_sync"
SPEED_MPS, PERIOD_S, LATITUDE = 10.0, 0.1, 49.0
STREAMS = ("image_02", "image_03", "velodyne_points", "oxts")
CALIBRATION = {
    "calib_imu_to_velo.txt": "calib_time: 25-May-2012 16:47:16\nR: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.32 -0.8\n",
    "calib_velo_to_cam.txt": "calib_time: x\nR: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n",
    "calib_cam_to_cam.txt": "R_rect_00: 1 0 0 0 1 0 0 0 1\n"
    "S_rect_02: 64 32\nP_rect_02: 100 0 32 6 0 100 16 0 0 0 1 0\n"
    "S_rect_03: 64 32\nP_rect_03: 100 0 32 -48 0 100 16 0 0 0 1 0\n",
}
AHEAD_M, UP_M = 0.8 - 0.05, 0.8 + 0.9
"""The lidar in the ego frame; the ego's axle is 0.05 m ahead and 0.32 m right of the IMU, 0.9 m below it."""
SEEN = np.array(
    [[10, 0.01, -1, 0.5], [0, 5, -1.73, 1], [5, -0.1, 0, 0], [3, 1, -1.7, 0.1], [-8, 0.1, -1, 0.2]],
    dtype=np.float32,
)
"""Ahead, left, ahead again; then, in the next row, to the left and behind."""


def write_times(file: Path, offset_s: float = 0.0) -> None:
    lines = [f"2011-09-26 13:04:{32.5 + k * PERIOD_S + offset_s:012.9f}" for k in range(4)]
    file.write_text("\n".join(lines) + "\n")


@pytest.fixture
def made(tmp_path: Path) -> Path:
    """Four frames at 10 m/s to the east; the last sweep is missing, and images are half as large."""
    day = tmp_path / "raw" / "2011_09_26"
    for stream in STREAMS:
        (day / DRIVE / stream / "data").mkdir(parents=True)
        write_times(day / DRIVE / stream / "timestamps.txt")
    for name, text in CALIBRATION.items():
        (day / name).write_text(text)
    metres = math.cos(math.radians(LATITUDE)) * 6_378_137 * math.radians(1)  # of a degree of longitude
    for frame in range(4):
        data = f"{frame:010d}"
        east = 8.4 + frame * PERIOD_S * SPEED_MPS / metres
        (day / DRIVE / "oxts" / "data" / f"{data}.txt").write_text(f"{LATITUDE} {east!r} 112.8 0 0 0 9 9\n")
        if frame < 3:
            SEEN.tofile(day / DRIVE / "velodyne_points" / "data" / f"{data}.bin")
        Image.new("RGB", (32, 16), (10, 200, 30)).save(day / DRIVE / "image_02" / "data" / f"{data}.png")
    for junk in (".DS_Store", "._0000000001.png", "Thumbs.db"):  # as file browsers leave them
        (day / DRIVE / "image_02" / "data" / junk).write_bytes(b"junk")
    return tmp_path / "raw"


@pytest.mark.parametrize("known", [False, True])
def test_points_lie_where_the_vehicle_was_at_their_times(made: Path, tmp_path: Path, known: bool) -> None:
    """A turn begins at the rear and goes round clockwise: what is left is seen a quarter turn before now."""
    turn_s = 0.1036
    if known:
        turn_s = 0.08
        for end, offset_s in (("start", -0.04), ("end", 0.04)):
            folder = made / "2011_09_26" / DRIVE / "velodyne_points"
            write_times(folder / f"timestamps_{end}.txt", offset_s)
    (path,) = convert(made, "kitti-raw", tmp_path / "out")
    assert path.folder.parts[-2:] == ("kitti-raw_train", DRIVE)
    log = Log(path)
    assert len(log) == 4
    assert np.diff(log.T_world_ego[:, :3, 3], axis=0) == pytest.approx(np.array([[1.0, 0, 0]] * 3), abs=1e-3)
    assert read_sweep(log, 3) is None
    assert read_notices(path.folder) == ["velodyne_points: missing sweeps: 1 (0000000003)"]
    sweep, misses_known = read_sweep(log, 1)
    assert not misses_known
    assert read_boxes(log, 1) is None
    assert sweep.beam.tolist() == [0, 0, 0, 1, 1]
    share = np.array([0.5 - math.atan2(y, x) / (2 * math.pi) for x, y, *_ in SEEN])
    dt_s = (share - 0.5) * turn_s
    assert dt_s[1] == pytest.approx(-0.25 * turn_s)
    torch.testing.assert_close(sweep.dt_s, torch.tensor(dt_s, dtype=torch.float32), atol=2e-6, rtol=0)
    origin = np.stack([AHEAD_M + SPEED_MPS * dt_s, 0 * dt_s, UP_M + 0 * dt_s], axis=-1)
    torch.testing.assert_close(sweep.origin_ego, torch.tensor(origin).float(), atol=1e-3, rtol=0)
    points = torch.tensor(origin + SEEN[:, :3]).float()
    torch.testing.assert_close(sweep.points_ego, points, atol=1e-3, rtol=0)
    assert sweep.intensity.tolist() == pytest.approx(SEEN[:, 3].tolist(), abs=0.003)


def test_a_shrunk_image_has_the_calibration_of_its_size(made: Path, tmp_path: Path) -> None:
    (path,) = convert(made / "2011_09_26" / DRIVE, "kitti-raw", tmp_path / "out")
    log = Log(path)
    cameras = pinhole_cameras(log)
    assert set(cameras) == {"image_02"}
    camera = read_camera(log, 1, cameras["image_02"], (16, 32), with_image=True)
    torch.testing.assert_close(camera.K, torch.tensor([[50.0, 0, 16], [0, 50, 8], [0, 0, 1]]))
    torch.testing.assert_close(
        camera.T_ego_cam[:3, 3], torch.tensor([AHEAD_M, 0.06, UP_M]), atol=1e-3, rtol=0
    )
    assert camera.image.float().mean((1, 2)).tolist() == pytest.approx([10, 200, 30], abs=2)


def test_a_turning_vehicle_turns_the_points_too(made: Path, tmp_path: Path) -> None:
    """It stands and turns by 1 rad/s: the point to the left is seen 25.9 ms, so 0.0259 rad, before."""
    for frame in range(4):
        file = made / "2011_09_26" / DRIVE / "oxts" / "data" / f"{frame:010d}.txt"
        file.write_text(f"{LATITUDE} 8.4 112.8 0 0 {frame * PERIOD_S}\n")
    (path,) = convert(made, "kitti-raw", tmp_path / "out")
    found = read_sweep(Log(path), 1)
    assert found is not None
    angle = -0.25 * 0.1036
    lidar_imu, seen = np.array([0.8, -0.32]), np.array([0.8, -0.32]) + SEEN[1, :2]
    c, s = math.cos(angle), math.sin(angle)
    turned = np.array([[c, -s], [s, c]]) @ seen - np.array([0.05, -0.32])
    assert found[0].points_ego[1, :2].tolist() == pytest.approx(turned.tolist(), abs=1e-3)
    turned = np.array([[c, -s], [s, c]]) @ lidar_imu - np.array([0.05, -0.32])
    assert found[0].origin_ego[1, :2].tolist() == pytest.approx(turned.tolist(), abs=1e-3)


def test_a_lost_sweep_has_an_empty_line_of_times(made: Path, tmp_path: Path) -> None:
    """As in 2011_09_26_drive_0009: the sweeps behind keep their own times."""
    folder = made / "2011_09_26" / DRIVE / "velodyne_points"
    (folder / "data" / f"{1:010d}.bin").unlink()
    lines = (folder / "timestamps.txt").read_text().split("\n")
    (folder / "timestamps.txt").write_text("\n".join([lines[0], "", *lines[2:]]))
    (path,) = convert(made, "kitti-raw", tmp_path / "out")
    log = Log(path)
    assert np.diff(log.t_us).tolist() == [100_000] * 3  # the image of that frame has a time
    assert [read_sweep(log, frame) is None for frame in range(4)] == [False, True, False, True]
    assert read_notices(path.folder) == ["velodyne_points: missing sweeps: 2 (0000000001; 0000000003)"]


def test_damaged_files_cost_themselves_alone(made: Path, tmp_path: Path) -> None:
    """A cut image, a cut sweep, a cut record of OXTS and a frame without any time."""
    drive = made / "2011_09_26" / DRIVE
    image = drive / "image_02" / "data" / f"{0:010d}.png"
    image.write_bytes(image.read_bytes()[:40])
    sweep = drive / "velodyne_points" / "data" / f"{1:010d}.bin"
    sweep.write_bytes(sweep.read_bytes()[:-3])
    (drive / "oxts" / "data" / f"{2:010d}.txt").write_text("49.0 8.4")
    for stream in ("image_02", "image_03", "velodyne_points"):
        lines = (drive / stream / "timestamps.txt").read_text().split("\n")
        (drive / stream / "timestamps.txt").write_text("\n".join([*lines[:3], "", *lines[4:]]))
    (path,) = convert(made, "kitti-raw", tmp_path / "out")
    log = Log(path)
    assert log.T_world_ego[:, 0, 3] - log.T_world_ego[0, 0, 3] == pytest.approx([0.0, 1.0, 2.0], abs=1e-3)
    camera = pinhole_cameras(log)["image_02"]
    images = [read_camera(log, frame, camera, (16, 32), with_image=True).image for frame in range(3)]
    assert [image is None for image in images] == [True, False, False]
    assert [read_sweep(log, frame) is None for frame in range(3)] == [False, True, False]
    notices = read_notices(path.folder)
    parts = (
        "oxts: unreadable rec",
        "image_02: unreadable f",
        "velodyne_points: unreadable f",
        f"{DRIVE}: frames w",
    )
    assert [notice.startswith(part) for notice, part in zip(notices, parts, strict=True)] == [True] * 4


def test_a_drive_whose_sweeps_are_all_damaged_is_refused(made: Path, tmp_path: Path) -> None:
    for sweep in (made / "2011_09_26" / DRIVE / "velodyne_points" / "data").iterdir():
        sweep.write_bytes(b"not points.")
    with pytest.raises(InputError, match=r"velodyne_points: none of its files can be read; 0000000000\.bin"):
        convert(made, "kitti-raw", tmp_path / "out")


def test_a_drive_of_one_record_stands_beside_it(made: Path, tmp_path: Path) -> None:
    """A frame more than a period later is left out: the vehicle may be anywhere."""
    for frame in range(1, 4):
        (made / "2011_09_26" / DRIVE / "oxts" / "data" / f"{frame:010d}.txt").unlink()
    (path,) = convert(made, "kitti-raw", tmp_path / "out")
    log = Log(path)
    assert len(log) == 2
    assert np.ptp(log.T_world_ego[:, :3, 3], axis=0).tolist() == [0.0, 0.0, 0.0]
    assert (
        f"{DRIVE}: frames without OXTS' records within 1 s around them, left out: 2 (0000000002; 00"
        in (read_notices(path.folder)[-1])
    )


def test_a_hole_in_the_records_costs_the_frames_in_it(made: Path, tmp_path: Path) -> None:
    """The times of the drive are stretched to 0.8 s a frame, and one record is lost."""
    drive = made / "2011_09_26" / DRIVE
    for stream in STREAMS:
        lines = [f"2011-09-26 13:04:{32.5 + k * 0.8:012.9f}" for k in range(4)]
        (drive / stream / "timestamps.txt").write_text("\n".join(lines) + "\n")
    (drive / "oxts" / "data" / f"{1:010d}.txt").unlink()
    (path,) = convert(made, "kitti-raw", tmp_path / "out")
    assert np.diff(Log(path).t_us).tolist() == [1_600_000, 800_000]
    assert any(notice.startswith(f"{DRIVE}: frames without OXTS'") for notice in read_notices(path.folder))


@pytest.mark.parametrize("size_wh", [(64, 28), (60, 32), (70, 44)])
def test_cut_and_unrectified_images_are_refused(made: Path, tmp_path: Path, size_wh: tuple[int, int]) -> None:
    for frame in range(4):
        file = made / "2011_09_26" / DRIVE / "image_02" / "data" / f"{frame:010d}.png"
        Image.new("RGB", size_wh).save(file)
    told = f"image_02: .*an image of {size_wh[0]} x {size_wh[1]} px is not one of 64 x 32 px that was shrunk"
    with pytest.raises(InputError, match=told):
        convert(made, "kitti-raw", tmp_path / "out")


@pytest.mark.parametrize("renamed", [True, False])
def test_an_unsynced_drive_is_refused(made: Path, tmp_path: Path, renamed: bool) -> None:
    drive = made / "2011_09_26" / DRIVE
    if renamed:
        drive.rename(drive.parent / DRIVE.replace("sync", "extract"))
    else:
        for sweep in (drive / "velodyne_points" / "data").iterdir():
            sweep.rename(sweep.with_suffix(".txt"))
    with pytest.raises(InputError, match="unsynced and unrectified recordings are not read") as refused:
        convert(made, "kitti-raw", tmp_path / "out")
    assert "\n" not in str(refused.value)


def test_a_missing_calibration_is_named(made: Path, tmp_path: Path) -> None:
    (made / "2011_09_26" / "calib_velo_to_cam.txt").unlink()
    with pytest.raises(InputError, match=f"{DRIVE}: cannot read the raw log") as refused:
        convert(made, "kitti-raw", tmp_path / "out")
    assert "calib_velo_to_cam" in str(refused.value)
