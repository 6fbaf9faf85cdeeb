"""PhysicalAI-Autonomous-Vehicles: a made tree by its published columns becomes a log with F-theta lenses."""

from pathlib import Path

import numpy as np
import pytest
import raw_physical_ai as raw
from py123d.datatypes import Camera, CameraID, ModalityType
from py123d.datatypes.sensors.ftheta_camera import FThetaCameraMetadata

from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import pinhole_cameras, rig_of_log
from foredrive.data.formats.convert import convert
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.scene import Category


@pytest.fixture
def log(tmp_path: Path) -> Log:
    """The clip that was downloaded, of two whose calibration is there."""
    raw.write(tmp_path / "raw")
    raw.write_boxes(tmp_path / "raw")
    (path,) = convert(tmp_path / "raw", "physical-ai-av", tmp_path / "out")
    assert path.name == f"physical-ai-av_val/{raw.CLIP}"
    return Log(path)


def test_poses_are_those_of_the_rig_on_the_ground(log: Log) -> None:
    assert log.t_us.tolist() == raw.SPINS_US  # the first is before the clip's zero
    np.testing.assert_allclose(log.T_world_ego, [raw.pose(t_us) for t_us in raw.SPINS_US], atol=1e-12)
    assert log.speed_mps == pytest.approx(np.full(3, 125**0.5))
    centre, size = log.ego_box
    assert [*centre, *size] == pytest.approx([1.4, 0, 0.75, 5.0, 2.0, 1.5])


def test_points_have_place_intensity_and_time(log: Log) -> None:
    """The lidar looks to the left, so 8 m ahead of it is 8 m to the left of the car."""
    read = read_sweep(log, 1)
    assert read is not None
    sweep = read[0]
    np.testing.assert_allclose(sweep.points_ego, [[0.2, 8.0, 0.0], [1.2, 4.0, 1.9]], atol=1e-4)
    assert sweep.intensity.tolist() == pytest.approx([51 / 255, 1.0])
    assert sweep.dt_s.tolist() == pytest.approx([0.05, 0.0], abs=1e-5)
    # 50 ms later, the lidar is 0.56 m on its way
    T = np.linalg.inv(raw.pose(80_000)) @ raw.pose(130_000)
    np.testing.assert_allclose(sweep.origin_ego[0], T[:3, :3] @ [1.2, 0, 1.9] + T[:3, 3], atol=2e-3)


def test_boxes_stand_where_the_rig_is_at_the_end_of_the_spin(log: Log) -> None:
    """That is py123d's reading of them, whatever the time of the box within the spin."""
    boxes = read_boxes(log, 1)
    assert boxes is not None
    T = np.linalg.inv(raw.pose(80_000)) @ raw.pose(180_000)
    expected = np.array([[12, 3, 0.8], [6, -2, 0.9]]) @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(boxes.centre, expected, atol=1e-4)
    assert boxes.yaw.tolist() == pytest.approx([0.3 + 0.1] * 2, abs=1e-5)
    assert boxes.size_lwh[0].tolist() == pytest.approx([4.5, 1.9, 1.6])
    assert boxes.category.tolist() == [Category.CAR, Category.BICYCLE]
    # There are no velocities in the labels: from the track, or unknown
    moved = (raw.pose(180_000) - raw.pose(80_000)) @ [12, 3, 0.8, 1] / 0.1
    over_ground = raw.pose(80_000)[:3, :3].T @ moved[:3]
    assert boxes.velocity[0].tolist() == pytest.approx(over_ground[:2], abs=1e-3)
    assert boxes.velocity[1].isnan().all()
    empty = read_boxes(log, 2)
    assert empty is not None
    assert len(empty.centre) == 0


def test_lenses_are_kept_as_f_theta_which_no_method_takes(log: Log, caplog: pytest.LogCaptureFixture) -> None:
    assert pinhole_cameras(log) == {}
    assert "camera.ftcam_f0 is not a pinhole camera and is left out" in caplog.text
    with pytest.raises(InputError, match="no pinhole cameras"):
        rig_of_log(log)
    # The images are in the log: the nearest one, where its camera was
    image = log.scene.get_modality_at_iteration(log.iteration(1), ModalityType.CAMERA, CameraID.FTCAM_F0)
    assert isinstance(image, Camera)
    assert isinstance(image.metadata, FThetaCameraMetadata)
    assert image.metadata.intrinsics is not None
    assert image.metadata.intrinsics.cx == 32.5
    assert image.timestamp.time_us == 89_999
    assert image.image.mean() == pytest.approx(30 + 20 * 3, abs=3)
    T_rig_cam = np.linalg.inv(raw.pose(90_000)) @ image.camera_to_global_se3.transformation_matrix
    forward = [[0, 0, 1, 1.7], [-1, 0, 0, 0.1], [0, -1, 0, 1.4], [0, 0, 0, 1]]
    np.testing.assert_allclose(T_rig_cam, forward, atol=1e-9)


def test_a_clip_without_labels_has_unknown_boxes(tmp_path: Path) -> None:
    raw.write(tmp_path / "raw")
    (path,) = convert(tmp_path / "raw", "physical-ai-av", tmp_path / "out")
    assert read_boxes(Log(path), 0) is None


def test_clips_that_are_still_packed_are_no_logs(tmp_path: Path) -> None:
    raw.write(tmp_path / "raw")
    (tmp_path / f"raw/lidar/lidar_top_360fov/{raw.CLIP}.lidar_top_360fov.parquet").unlink()
    with pytest.raises(InputError, match=r"no physical-ai-av log here \(looked for .*unpacked"):
        convert(tmp_path / "raw", "physical-ai-av", tmp_path / "out")
