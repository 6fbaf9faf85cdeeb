"""Frames of KITTI's object benchmark: a made one with known answers, real ones against their labels."""

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
from foredrive.geometry.boxes import box_corners, points_in_boxes
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.scene import Category

CALIBRATION = """P0: 100 0 32 0 0 100 16 0 0 0 1 0
P2: 100 0 32 6 0 100 16 0 0 0 1 0
P3: 100 0 32 -48 0 100 16 0 0 0 1 0
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0
Tr_imu_to_velo: 1 0 0 -0.8 0 1 0 0.32 0 0 1 -0.8

"""
LABELS = """Car 0 0 0 0 0 0 0 1.5 1.8 4.0 2.0 1.7 10.0 -1.5707963 0
DontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10
Person_sitting 0 0 0 0 0 0 0 1.2 0.6 0.8 -3.0 1.7 5.0 0.0 0
"""


@pytest.fixture
def made(tmp_path: Path) -> Path:
    """A camera at the lidar, which is 0.8 m ahead of the IMU, 0.32 m to its right and 0.8 m above it."""
    folder = tmp_path / "kitti" / "training"
    for kind in ("image_2", "velodyne", "calib", "label_2"):
        (folder / kind).mkdir(parents=True)
    Image.new("RGB", (64, 32), (10, 200, 30)).save(folder / "image_2" / "000007.png")
    points = np.array([[10.0, -2.0, -1.0, 0.5], [0.0, 5.0, -1.73, 1.0]], dtype=np.float32)
    points.tofile(folder / "velodyne" / "000007.bin")
    (folder / "calib" / "000007.txt").write_text(CALIBRATION)
    (folder / "label_2" / "000007.txt").write_text(LABELS)
    for junk in ("._000007.png", "Thumbs.db", ".DS_Store"):  # as file browsers leave them
        (folder / "image_2" / junk).write_bytes(b"junk")
    return folder.parent


def test_a_made_frame_lies_where_it_should(made: Path, tmp_path: Path) -> None:
    (path,) = convert(made, "kitti-object", tmp_path / "out")
    assert path.folder.parts[-2:] == ("kitti_train", "000007")
    log = Log(path)
    assert len(log) == 1
    # The ego frame: on the ground, 0.9 m below the IMU; at the rear axle, 0.05 m ahead, 0.32 m right of it.
    ahead_m, up_m = 0.8 - 0.05, 0.8 + 0.9
    boxes = read_boxes(log, 0)
    assert boxes.category.tolist() == [Category.CAR, Category.PEDESTRIAN]
    middle = torch.tensor([[10.0 + ahead_m, -2.0, up_m - 1.7 + 0.75], [5.0 + ahead_m, 3.0, up_m - 1.7 + 0.6]])
    torch.testing.assert_close(boxes.centre, middle, atol=1e-4, rtol=0)
    torch.testing.assert_close(boxes.size_lwh, torch.tensor([[4.0, 1.8, 1.5], [0.8, 0.6, 1.2]]))
    torch.testing.assert_close(boxes.yaw, torch.tensor([0.0, -np.pi / 2]), atol=1e-4, rtol=0)
    sweep, misses_known = read_sweep(log, 0)
    assert not misses_known
    points = torch.tensor([[10.0 + ahead_m, -2.0, up_m - 1.0], [ahead_m, 5.0, up_m - 1.73]])
    torch.testing.assert_close(sweep.points_ego, points, atol=1e-4, rtol=0)
    torch.testing.assert_close(sweep.intensity, torch.tensor([128 / 255, 1.0]))

    cameras = pinhole_cameras(log)
    assert set(cameras) == {"image_2"}
    camera = read_camera(log, 0, cameras["image_2"], (32, 64), with_image=True)
    # Camera 2 lies 6 / 100 m to the left of camera 0.
    torch.testing.assert_close(
        camera.T_ego_cam[:3, 3], torch.tensor([ahead_m, 0.06, up_m]), atol=1e-4, rtol=0
    )
    assert camera.image.float().mean((1, 2)).tolist() == pytest.approx([10, 200, 30], abs=2)


def test_what_is_not_labelled_has_no_boxes(made: Path, tmp_path: Path) -> None:
    (made / "training" / "label_2" / "000007.txt").unlink()
    (made / "training").rename(made / "testing")
    (path,) = convert(made, "kitti-object", tmp_path / "out")
    assert path.folder.parent.name == "kitti_test"
    assert read_boxes(Log(path), 0) is None


def test_a_damaged_frame_is_named(made: Path, tmp_path: Path) -> None:
    calibration = made / "training" / "calib" / "000007.txt"
    calibration.write_text(CALIBRATION.replace("Tr_velo_to_cam", "other"))
    with pytest.raises(InputError, match=r"training: cannot read the raw log.*in calib/000007.txt"):
        convert(made, "kitti-object", tmp_path / "out")
    assert not list((tmp_path / "out").rglob("*.arrow"))


def test_rows_that_are_no_labels_cost_themselves_alone(made: Path, tmp_path: Path) -> None:
    """Byte order mark, CRLF, blank lines, a cut row, a row of the tracking benchmark, an unknown class."""
    row = LABELS.splitlines()[0]
    rows = [
        row,
        "",
        row[:30],
        f"0 3 {row}",
        row.replace("Car", "Lorry"),
        row.replace("Car", "Zeppelin"),
        "",
        "",
    ]
    label = made / "training" / "label_2" / "000007.txt"
    label.write_bytes(b"\xef\xbb\xbf" + "\r\n".join(rows).encode())
    (path,) = convert(made, "kitti-object", tmp_path / "out")
    boxes = read_boxes(Log(path), 0)
    assert boxes.category.tolist() == [Category.CAR, Category.TRUCK, Category.OTHER]
    rows_left_out, unknown = read_notices(path.folder)
    assert rows_left_out.startswith(
        "label_2/000007.txt: unreadable rows, left out: 2 (line 3: not 15 columns"
    )
    assert unknown == "label_2/000007.txt: boxes of unknown classes, read as OTHER: 1 ('Zeppelin')"


def test_labels_without_any_readable_row_are_refused(made: Path, tmp_path: Path) -> None:
    (made / "training" / "label_2" / "000007.txt").write_text("0 3 " + LABELS.splitlines()[0])
    with pytest.raises(
        InputError, match=r"label_2/000007.txt: none of its rows can be read; line 1: not 15 col"
    ):
        convert(made, "kitti-object", tmp_path / "out")


@pytest.mark.parametrize("columns", [3, 5, 6])
def test_points_of_other_columns_are_refused(columns: int, made: Path, tmp_path: Path) -> None:
    """The number of rows is one at which the size alone would fit four columns."""
    rng = np.random.default_rng(0)
    rows = np.zeros((60, columns), np.float32)
    rows[:, :3] = rng.uniform(-40, 40, (60, 3))
    rows[:, 3:4] = rng.uniform(0, 1, (60, 1)) if columns > 3 else 0
    rows[:, 4:5] = np.arange(60)[:, None] % 32 if columns > 4 else 0
    rows.tofile(made / "training" / "velodyne" / "000007.bin")
    with pytest.raises(InputError, match=rf"not rows of 4 columns .*; {columns} columns would fit"):
        convert(made, "kitti-object", tmp_path / "out")


def test_intensities_of_another_scale_are_divided_and_noted(made: Path, tmp_path: Path) -> None:
    points = np.array([[10.0, -2.0, -1.0, 51.0], [0.0, 5.0, -1.73, 204.0]], dtype=np.float32)
    points.tofile(made / "training" / "velodyne" / "000007.bin")
    (path,) = convert(made, "kitti-object", tmp_path / "out")
    assert read_sweep(Log(path), 0)[0].intensity.tolist() == pytest.approx([0.2, 0.8])
    assert read_notices(path.folder) == ["velodyne/000007.bin: intensities up to 204 were divided by 255"]


def test_an_export_without_imu_and_second_camera(made: Path, tmp_path: Path) -> None:
    """Its image is a JPEG. The ego frame is 1.73 m below the lidar, with the same axes."""
    folder = made / "training"
    lines = [line for line in CALIBRATION.splitlines() if not line.startswith(("P3", "Tr_imu"))]
    (folder / "calib" / "000007.txt").write_text("\n".join(lines))
    with Image.open(folder / "image_2" / "000007.png") as image:
        image.save(folder / "image_2" / "000007.jpg")
    (folder / "image_2" / "000007.png").unlink()
    (path,) = convert(made, "kitti-object", tmp_path / "out")
    log = Log(path)
    points = torch.tensor([[10.0, -2.0, 0.73], [0.0, 5.0, 0.0]])
    torch.testing.assert_close(read_sweep(log, 0)[0].points_ego, points, atol=1e-4, rtol=0)
    camera = read_camera(log, 0, pinhole_cameras(log)["image_2"], (32, 64), with_image=True)
    assert camera.image.float().mean((1, 2)).tolist() == pytest.approx([10, 200, 30], abs=3)
    (notice,) = read_notices(path.folder)
    assert notice.startswith("calib/000007.txt: no Tr_imu_to_velo; the ego frame is taken to be 1.73 m below")


def test_a_frame_without_lidar_has_its_image_and_boxes(made: Path, tmp_path: Path) -> None:
    (made / "training" / "velodyne" / "000007.bin").unlink()
    (path,) = convert(made, "kitti-object", tmp_path / "out")
    log = Log(path)
    assert read_sweep(log, 0) is None
    assert len(read_boxes(log, 0).category) == 2
    assert read_camera(log, 0, pinhole_cameras(log)["image_2"], (32, 64), with_image=True).image is not None


@pytest.mark.real
def test_real_boxes_project_onto_their_labels(real_data: Path, tmp_path: Path) -> None:
    for path in convert(real_data / "kitti", "kitti-object", tmp_path):
        label = real_data / "kitti" / "training" / "label_2" / f"{path.folder.name}.txt"
        rows = [line.split() for line in label.read_text().splitlines() if not line.startswith("DontCare")]
        log = Log(path)
        boxes = read_boxes(log, 0)
        metadata = pinhole_cameras(log)["image_2"]
        size_hw = (metadata.height, metadata.width)
        camera = read_camera(log, 0, metadata, size_hw, with_image=False)
        corners = box_corners(boxes.centre, boxes.size_lwh, boxes.yaw)
        for n, row in enumerate(rows):
            corners_cam = transform_points(inverse_se3(camera.T_ego_cam), corners[n])
            uv, _, _ = project(corners_cam, camera.K, camera.dist, size_hw)
            given = torch.tensor([float(word) for word in row[4:8]])
            torch.testing.assert_close(torch.cat([uv.amin(0), uv.amax(0)]), given, atol=12.0, rtol=0)
        points = read_sweep(log, 0)[0].points_ego
        near = boxes.centre.norm(dim=-1) < 50
        held = points_in_boxes(points, boxes.centre, boxes.size_lwh, boxes.yaw).sum(0)
        assert (held[near] > 10).all()
        beside = points[(points[:, 0].abs() < 6) & (points[:, 1].abs() < 4) & (points[:, 2] < 0.5)]
        assert abs(float(beside[:, 2].quantile(0.1))) < 0.25
