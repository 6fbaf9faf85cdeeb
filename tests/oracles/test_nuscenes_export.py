"""Exported logs as nuscenes-devkit itself reads them: `make test-oracles`."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_log as world
import test_maps
from miniature import write_log

from foredrive.cli.main import main
from foredrive.data.logs import Log
from foredrive.tasks.objects.object_rows import DETECTION_CLASSES

pytestmark = [pytest.mark.oracle, pytest.mark.filterwarnings("ignore")]


@pytest.fixture(scope="module")
def nusc(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The devkit's data set of a log."""
    log = Log(write_log(tmp_path_factory.mktemp("data"), frames=21))
    return exported(log, tmp_path_factory.mktemp("nuscenes"))


def exported(log: Log, out: Path) -> Any:
    from nuscenes import NuScenes

    assert main(["export", "nuscenes", str(log.path.folder), "--out", str(out)]) == 0
    return NuScenes("v1.0-foredrive", str(out), verbose=False)


def samples(nusc: Any) -> list[Any]:
    found, token = [], nusc.scene[0]["first_sample_token"]
    while token:
        found.append(nusc.get("sample", token))
        token = found[-1]["next"]
    return found


def test_velocities(nusc: Any) -> None:
    for annotation in nusc.sample_annotation:
        speed = world.MOVING["speed"] if annotation["category_name"] == "vehicle.truck" else 0.0
        assert nusc.box_velocity(annotation["token"]) == pytest.approx([speed, 0, 0], abs=1e-6)


def test_points_and_boxes(nusc: Any) -> None:
    """The points lie on the boxes' surfaces: inside of slightly larger boxes, outside of smaller ones."""
    from nuscenes.utils.data_classes import LidarPointCloud
    from nuscenes.utils.geometry_utils import points_in_box

    for sample in samples(nusc):
        path, boxes, _ = nusc.get_sample_data(sample["data"]["LIDAR_TOP"])
        points = LidarPointCloud.from_file(path).points[:3]
        assert len(boxes) == 2
        for box in boxes:
            counted = nusc.get("sample_annotation", box.token)["num_lidar_pts"]
            assert 0 < counted <= points_in_box(box, points, 1.001).sum()
            assert points_in_box(box, points, 0.999).sum() == 0


def test_boxes_between_samples_are_interpolated(nusc: Any) -> None:
    reading = nusc.get("sample_data", samples(nusc)[0]["data"]["LIDAR_TOP"])
    for frame in range(21):
        t_s = (reading["timestamp"] - world.START_US) * 1e-6
        assert t_s == pytest.approx(0.1 * frame)
        (box,) = [box for box in nusc.get_boxes(reading["token"]) if box.name == "vehicle.truck"]
        pose = nusc.get("ego_pose", reading["ego_pose_token"])
        seen = box.center - pose["translation"]
        expected = world.MOVING["centre"] + [world.MOVING["speed"] * t_s, 0, 0] - world.driven(t_s)
        assert seen == pytest.approx(expected, abs=1e-6)
        if reading["next"]:
            reading = nusc.get("sample_data", reading["next"])


def test_sweeps_are_joined(nusc: Any) -> None:
    """Points of five sweeps lie together on the car that stands still."""
    from nuscenes.utils.data_classes import LidarPointCloud

    sample = samples(nusc)[2]
    cloud, ages_s = LidarPointCloud.from_file_multisweep(nusc, sample, "LIDAR_TOP", "LIDAR_TOP", nsweeps=5)
    assert np.unique(ages_s).round(3).tolist() == [0.0, 0.1, 0.2, 0.3, 0.4]
    parked = cloud.points[:3, cloud.points[3] == 128]
    ahead, left = parked[1] + world.LIDAR_EGO_M[0], -parked[0]
    centre = world.PARKED["centre"] - world.driven(1.0)
    assert ahead.min() == pytest.approx(centre[0] - 2, abs=0.01)
    assert left.min() == pytest.approx(centre[1] - 1, abs=0.01)


def test_the_map_is_below_the_vehicle(tmp_path: Path) -> None:
    nusc = exported(test_maps.write_with_map(tmp_path / "data"), tmp_path / "out")
    mask = nusc.map[0]["mask"]
    at = np.array([pose["translation"] for pose in nusc.ego_pose])
    assert mask.is_on_mask(at[:, 0], at[:, 1]).all()
    assert not mask.is_on_mask(at[:, 0], at[:, 1] + 2.0).any()  # the lane is 3.5 m wide


def test_truth_of_detection(nusc: Any) -> None:
    """The devkit's loader of truth takes the split of `splits.json`."""
    from nuscenes.eval.common.loaders import load_gt_of_sample_tokens
    from nuscenes.eval.detection.data_classes import DetectionBox
    from nuscenes.utils.splits import get_scenes_of_split

    assert get_scenes_of_split("flat_train", nusc) == ["flat_train-flat"]
    tokens = [sample["token"] for sample in samples(nusc)]
    truth = load_gt_of_sample_tokens(nusc, tokens, DetectionBox, verbose=False)
    boxes = [box for token in tokens for box in truth[token]]
    assert len(boxes) == 10
    assert {box.detection_name for box in boxes} <= set(DETECTION_CLASSES)
    assert min(box.num_pts for box in boxes) > 0
