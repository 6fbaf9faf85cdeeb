"""Frames of KITTI's object benchmark: a made one with known answers, real ones against their labels."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.convert import convert
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
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
    calibration.write_text(CALIBRATION.replace("Tr_imu_to_velo", "other"))
    with pytest.raises(InputError, match=r"training: cannot read the raw log.*in calib/000007.txt"):
        convert(made, "kitti-object", tmp_path / "out")
    assert not list((tmp_path / "out").rglob("*.arrow"))


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
