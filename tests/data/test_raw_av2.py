"""Raw Argoverse 2 trees: whole logs convert, and what a tree lacks costs itself, named and counted."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import raw_av2
from pyarrow import feather

from foredrive.data.boxes import frames_with_boxes, read_boxes
from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.formats.convert import convert
from foredrive.data.lidar import frames_with_lidar
from foredrive.data.logs import Log
from foredrive.data.notices import read_notices
from foredrive.errors import InputError

FRAMES = 8
EGO_UP_M = 0.3
"""Height above ground of the data set's ego frame, by the vehicle's box."""
CENTRE, LEFT = raw_av2.CAMERAS


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    folder = tmp_path / "raw" / "val" / "0-1"
    raw_av2.write(folder, cameras=True, annotated=True, frames=FRAMES)
    return folder


def converted(raw: Path, tmp_path: Path) -> tuple[Log, list[str]]:
    """The log, and its notices without their places."""
    (path,) = convert(raw, "av2", tmp_path / "out")
    return Log(path), [notice.split(" (")[0] for notice in read_notices(path.folder)]


def images(log: Log, name: str) -> list[int]:
    """The frames with an image of a camera."""
    return log.rows(pinhole_cameras(log)[name].modality_key)[0].tolist()


def test_a_whole_log_converts(raw: Path, tmp_path: Path) -> None:
    """The image of a frame is the first after the start of its sweep, at the pose of its exposure."""
    log, notices = converted(raw, tmp_path)
    assert notices == []
    assert len(log) == len(frames_with_lidar(log)) == len(frames_with_boxes(log)) == FRAMES
    boxes = read_boxes(log, 2)
    assert boxes is not None
    assert boxes.centre[0].tolist() == pytest.approx([8.0, 0.0, 0.8 + EGO_UP_M])
    for name in raw_av2.CAMERAS:
        assert images(log, name) == list(range(FRAMES))
        camera = pinhole_cameras(log)[name]
        shown = read_camera(log, 2, camera, (16, 32), with_image=True)
        assert shown.exposed_dt_s == pytest.approx(0.005)
        assert shown.T_ego_cam[:, 3].tolist() == pytest.approx(
            [1.05, 0.0, 1.5 + EGO_UP_M, 1.0], abs=1e-4
        )  # 10 m/s


def test_missing_sweeps_images_and_a_camera_cost_themselves(raw: Path, tmp_path: Path) -> None:
    """A sweep, the two images of a frame, the last three images, and the folder of a camera."""
    sensors = raw / "sensors"
    (sensors / "lidar" / f"{raw_av2.times_ns(FRAMES)[3]}.feather").unlink()
    exposed = sorted((sensors / "cameras" / CENTRE).iterdir())
    for file in [*exposed[8:10], *exposed[-3:]]:
        file.unlink()
    shutil.rmtree(sensors / "cameras" / LEFT)
    log, notices = converted(raw, tmp_path)
    assert frames_with_lidar(log).tolist() == [0, 1, 2, 4, 5, 6, 7]
    assert frames_with_boxes(log).tolist() == list(range(FRAMES))
    assert images(log, CENTRE) == [0, 1, 2, 3, 5, 6]
    assert sorted(notices) == [
        "lidar: missing sweeps: 1",
        f"{CENTRE}: missing images: 3",
        f"{LEFT}: no images; sensors/cameras/{LEFT} is missing or empty",
    ]


def test_a_tree_without_annotations_has_no_boxes_and_names_its_gap(raw: Path, tmp_path: Path) -> None:
    """A frame of which nothing is left is missing; an image without a pose is left out."""
    (raw / "annotations.feather").unlink()
    (raw / "sensors" / "lidar" / f"{raw_av2.times_ns(FRAMES)[3]}.feather").unlink()
    poses = feather.read_table(raw / "city_SE3_egovehicle.feather")
    at_ns = poses["timestamp_ns"].to_numpy()
    feather.write_feather(
        poses.filter(at_ns != raw_av2.START_NS + 5_000_000), raw / "city_SE3_egovehicle.feather"
    )
    log, notices = converted(raw, tmp_path)
    assert np.diff(log.t_us).tolist() == [100_000, 100_000, 200_000, 100_000, 100_000, 100_000]
    assert read_boxes(log, 0) is None
    assert images(log, CENTRE) == list(range(1, FRAMES - 1))
    assert sorted(notices) == [
        "annotations: missing; the log has no boxes",
        "frames: missing: 1",
        *(f"{name}: images without a pose, left out: 1" for name in raw_av2.CAMERAS),
    ]


def test_frames_without_boxes_are_not_frames_of_no_boxes(raw: Path, tmp_path: Path) -> None:
    boxes = feather.read_table(raw / "annotations.feather")
    feather.write_feather(boxes.slice(0, 5), raw / "annotations.feather")
    log, notices = converted(raw, tmp_path)
    assert frames_with_boxes(log).tolist() == list(range(5))
    assert notices == ["annotations: frames without boxes: 3"]


@pytest.mark.parametrize("file", ["intrinsics.feather", "egovehicle_SE3_sensor.feather"])
def test_a_missing_calibration_costs_its_sensors(file: str, raw: Path, tmp_path: Path) -> None:
    (raw / "calibration" / file).unlink()
    log, notices = converted(raw, tmp_path)
    assert len(pinhole_cameras(log)) == 0
    assert f"cameras: left out; without calibration/{file}" in notices
    of_lidar = file.startswith("egovehicle")
    assert len(frames_with_lidar(log)) == (0 if of_lidar else FRAMES)
    assert (f"lidar: left out; calibration/{file} is missing" in notices) == of_lidar


def test_a_camera_of_damaged_images_is_refused(raw: Path, tmp_path: Path) -> None:
    for file in (raw / "sensors" / "cameras" / LEFT).iterdir():
        file.write_bytes(file.read_bytes()[:300])
    with pytest.raises(InputError, match=f"{LEFT}: none of its images can be read"):
        convert(raw, "av2", tmp_path / "out")
    assert not list((tmp_path / "out").glob("logs/*/*"))
