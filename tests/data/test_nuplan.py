"""nuPlan: a made data base of its schema becomes a log, by nuplan-devkit or stand-ins of its queries."""

import pickle
from pathlib import Path

import numpy as np
import pytest
import raw_nuplan as raw
from nuplan_devkit import devkit
from py123d.datatypes import CameraID, TrafficLightStatus
from test_raw_pandaset import Intruder

from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.formats.convert import convert
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.data.recorded import read_traffic_lights
from foredrive.errors import InputError
from foredrive.scene import Category

GROUND_M = 1.777 / 2 - 0.45
"""Of the rear axle above the ground, by py123d's measures of the vehicle."""


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    folder = tmp_path_factory.mktemp("nuplan")
    with devkit():
        raw.write(folder / "raw")
        (path,) = convert(folder / "raw", "nuplan", folder / "out")
    assert path.name == f"nuplan-mini_train/{raw.LOG}"
    return Log(path)


def test_frames_are_the_sweeps_that_images_are_nearest_to(log: Log) -> None:
    """Sweeps are at 20 Hz, images at 10 Hz near the second, fourth, … of them."""
    assert (log.t_us - raw.START_US).tolist() == list(range(50_000, 1_200_000, 100_000))
    expected = np.stack([raw.pose(t_us) for t_us in log.t_us.tolist()])
    expected[:, 2, 3] -= GROUND_M
    np.testing.assert_allclose(log.T_world_ego, expected, atol=1e-6)
    assert log.speed_mps == pytest.approx(np.full(12, 10.0))


def test_boxes_and_lights(log: Log) -> None:
    boxes = read_boxes(log, 1)
    assert boxes is not None
    T_ego_world = np.linalg.inv(log.T_world_ego[1])
    east = np.add(raw.ORIGIN, (12, 0.6, 0.5))
    np.testing.assert_allclose(boxes.centre[0], T_ego_world[:3, :3] @ east + T_ego_world[:3, 3], atol=1e-4)
    assert boxes.centre[0, 1] < -8, "the bicycle in the east is to the right of a car that drives north-east"
    assert boxes.size_lwh[0].tolist() == pytest.approx([1.8, 0.7, 1.7])
    assert boxes.yaw.tolist() == pytest.approx([np.pi / 4 - 0.2 * 0.15], abs=1e-5)
    assert boxes.velocity[0].tolist() == pytest.approx((T_ego_world[:2, 1] * 4).tolist(), abs=1e-4)
    assert boxes.category.tolist() == [Category.BICYCLE]
    shown = [read_traffic_lights(log, frame) for frame in (0, 11)]
    assert shown == [{4711: TrafficLightStatus.RED}, {4711: TrafficLightStatus.GREEN}]


def test_points_are_those_of_the_vehicle_and_beams_begin_at_the_rear_axle(log: Log) -> None:
    """nuPlan does not publish where its five lidars are."""
    read = read_sweep(log, 0)
    assert read is not None
    sweep = read[0]
    np.testing.assert_allclose(sweep.points_ego, [[10, 2, 0], [3, -4, 1 + GROUND_M]], atol=1e-5)
    np.testing.assert_allclose(sweep.origin_ego, [[0, 0, GROUND_M]] * 2, atol=1e-5)
    assert sweep.intensity.tolist() == pytest.approx([51 / 255, 1.0])
    assert sweep.beam.tolist() == [7, 1]


def test_camera_is_where_the_vehicle_is_in_the_middle_of_the_shutter(log: Log) -> None:
    (camera,) = pinhole_cameras(log).values()
    assert camera.camera_id == CameraID.PCAM_F0
    shown = read_camera(log, 1, camera, (48, 64), with_image=True)
    np.testing.assert_allclose(shown.K, [[40, 0, 30], [0, 42, 25], [0, 0, 1]])
    assert shown.dist.tolist() == pytest.approx([-0.3, 0.1, 0.001, 0.002, -0.05])
    assert shown.image is not None
    assert shown.image.float().mean((1, 2)).tolist() == pytest.approx([200, 100, 30], abs=2)
    exposed = raw.pose(raw.START_US + 150_000 + raw.LATE_US + 16_667)
    T_axle_cam = np.array([[0, 0, 1, 1.6], [-1, 0, 0, 0.1], [0, -1, 0, 1.5], [0, 0, 0, 1]])
    T_ego_cam = np.linalg.inv(log.T_world_ego[1]) @ exposed @ T_axle_cam
    np.testing.assert_allclose(shown.T_ego_cam, T_ego_cam, atol=1e-4)


def test_columns_are_unpickled_as_plain_data_only(tmp_path: Path) -> None:
    with devkit():
        raw.write(tmp_path / "raw", pickle.dumps(Intruder(f"touch {tmp_path / 'touched'}")))
        with pytest.raises(InputError, match=r"posix\.system, which plain data do not need"):
            convert(tmp_path / "raw", "nuplan", tmp_path / "out")
    assert not (tmp_path / "touched").exists()
