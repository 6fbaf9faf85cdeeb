"""Clips of damaged and incomplete logs: errors name the file, what can be read is read."""

import contextlib
import struct
import zlib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest
import synthetic_log as world
import torch
from arrow_surgery import rewrite_column, rewrite_metadata
from PIL import Image
from py123d.datatypes import CameraID, FisheyeMEICameraMetadata
from py123d.geometry import PoseSE3
from test_clips import config, copy_of

from foredrive.data import ClipDataset, find_logs
from foredrive.errors import InputError


def test_a_corrupt_jpeg_is_named(flat_log: Path, tmp_path: Path) -> None:
    path = copy_of(flat_log, tmp_path)
    file = path.folder / "camera.pcam_f0.arrow"
    spoil = lambda rows: [row[: len(row) // 2] if i == 10 else row for i, row in enumerate(rows)]  # noqa: E731
    rewrite_column(file, "camera.pcam_f0.data", spoil)
    with pytest.raises(InputError, match=r"camera\.pcam_f0\.arrow: cannot read the image at frame 10"):
        ClipDataset([path], config(), None)[0]
    rewrite_column(file, "camera.pcam_f0.data", lambda rows: [b"no image" for _ in rows])
    with pytest.raises(InputError, match=r"camera\.pcam_f0\.arrow: cannot read the image at frame 0"):
        ClipDataset([copy_of(path.folder, tmp_path / "b")], config(), None)[0]


def test_an_image_that_claims_to_be_huge_is_named(flat_log: Path, tmp_path: Path) -> None:
    path = copy_of(flat_log, tmp_path)
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)),
        (b"IDAT", b""),
        (b"IEND", b""),
    ]
    written = [
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    ]
    bomb = b"\x89PNG\r\n\x1a\n" + b"".join(written)
    rewrite_column(
        path.folder / "camera.pcam_f0.arrow", "camera.pcam_f0.data", lambda rows: [bomb for _ in rows]
    )
    with pytest.raises(InputError, match=r"cannot read the image at frame 0: Image size \(3600000000 pixels"):
        ClipDataset([path], config(), None)[0]


@pytest.mark.parametrize("inside", [True, False])
def test_images_beside_a_log_are_inside_of_the_data_sets_folder(
    inside: bool, flat_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, root = copy_of(flat_log, tmp_path), tmp_path / "sensors"
    root.mkdir()
    for folder in (root, tmp_path):
        Image.new("RGB", (96, 48)).save(folder / "image.png")
    monkeypatch.setattr(
        "foredrive.data.cameras.get_dataset_paths", lambda: SimpleNamespace(get_sensor_root=lambda _: root)
    )
    named = "image.png" if inside else "../image.png"
    for file in path.folder.glob("camera.pcam_*.arrow"):
        rewrite_column(file, f"{file.stem}.data", lambda rows: [named] * len(rows), pa.string())
    outside = pytest.raises(InputError, match="is outside of the data set's folder")
    with contextlib.nullcontext() if inside else outside:
        ClipDataset([path], config(), None)[0]


def test_a_sweep_without_points_loads(flat_log: Path, tmp_path: Path) -> None:
    path = find_logs(world.write(tmp_path, frames=21, empty_sweeps=True))[0]
    example = ClipDataset([path], config(lidar=True), None)[0]
    assert example.clip.sweep_valid.all()
    assert not example.clip.sweeps.valid.any()
    assert not example.occupancy.known.any()


def test_a_log_too_short_for_a_clip_is_named(tmp_path: Path) -> None:
    logs = find_logs(world.write(tmp_path, frames=15, name="short"))
    with pytest.raises(
        InputError, match=r"short: too short for one clip: 5 frames 0\.5 s apart .* 15 frames"
    ):
        ClipDataset(logs, config(), None)
    with pytest.raises(InputError, match="at least one log"):
        ClipDataset([], config(), None)


def test_a_corrupt_sweep_is_named(flat_log: Path, tmp_path: Path) -> None:
    path = copy_of(flat_log, tmp_path)
    file = path.folder / "lidar.lidar_top.arrow"
    rewrite_column(file, "lidar.lidar_top.data", lambda rows: [row[:60] for row in rows])
    with pytest.raises(InputError, match=r"lidar\.lidar_top\.arrow: cannot read the sweep at frame 0"):
        ClipDataset([path], config(), None)[0]


def test_a_camera_pose_that_is_not_finite_is_named(flat_log: Path, tmp_path: Path) -> None:
    path = copy_of(flat_log, tmp_path)
    file = path.folder / "camera.pcam_l0.arrow"
    spoil = lambda rows: [[np.nan] * 7 if i == 10 else row for i, row in enumerate(rows)]  # noqa: E731
    rewrite_column(file, "camera.pcam_l0.camera_to_global_se3", spoil)
    with pytest.raises(InputError, match=r"camera\.pcam_l0\.arrow: the camera pose at frame 10"):
        ClipDataset([path], config(), None)[0]


def test_a_camera_without_logged_poses_follows_the_vehicle(flat_log: Path, tmp_path: Path) -> None:
    path = copy_of(flat_log, tmp_path)
    file = path.folder / "camera.pcam_f0.arrow"
    rewrite_column(file, "camera.pcam_f0.camera_to_global_se3", lambda rows: [None] * len(rows))
    late_us = 40_000
    rewrite_column(file, "camera.pcam_f0.timestamp_us", lambda rows: [row + late_us for row in rows])
    rig = ClipDataset([path], config(), None)[0].clip.rig
    static = torch.from_numpy(world.cameras()[0].T_ego_cam).float()
    moved = static[:3, 3] + torch.tensor([world.EGO_SPEED_MPS * late_us * 1e-6, 0, 0])
    torch.testing.assert_close(rig.T_ego_cam[2, 0, :3, :3], static[:3, :3], atol=1e-6, rtol=0)
    torch.testing.assert_close(rig.T_ego_cam[2, 0, :3, 3], moved, atol=1e-5, rtol=0)


def test_a_fisheye_camera_is_left_out_with_a_note(
    flat_log: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = copy_of(flat_log, tmp_path)
    fisheye = FisheyeMEICameraMetadata(
        camera_name="left",
        camera_id=CameraID.FMCAM_L,
        mirror_parameter=1.0,
        distortion=None,
        projection=None,
        width=96,
        height=48,
        camera_to_imu_se3=PoseSE3.identity(),
    )
    rewrite_metadata(path.folder / "camera.pcam_l0.arrow", lambda _: fisheye.to_dict())
    assert ClipDataset([path], config(), None).camera_names == ("ahead",)
    assert "camera.pcam_l0 is not a pinhole camera and is left out" in caplog.text
