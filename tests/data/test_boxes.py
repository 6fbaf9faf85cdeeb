"""Boxes: categories of every data set, velocities from tracks, the ego vehicle's own box."""

import shutil
from pathlib import Path

import numpy as np
import py123d.parser.registry as registry
import pytest
import synthetic_log as world
import torch
from arrow_surgery import rewrite_column, rewrite_metadata
from py123d.datatypes.detections.box_detection_label import BOX_DETECTION_LABEL_REGISTRY

from foredrive.data.boxes import category_of, read_boxes
from foredrive.data.log_check import check_log
from foredrive.data.log_paths import LogPath, find_logs
from foredrive.data.logs import Log
from foredrive.data.written_boxes import LABEL_OF_CATEGORY
from foredrive.errors import InputError
from foredrive.scene import Category

BOXES = "box_detections_se3"


def copy_of(folder: Path, tmp_path: Path) -> LogPath:
    target = tmp_path / "logs" / "flat_train" / "copy"
    shutil.copytree(folder, target)
    return LogPath(target, tmp_path / "maps")


def test_boxes_are_in_the_ego_frame_of_their_frame(flat_log: Path) -> None:
    boxes = read_boxes(Log(find_logs(flat_log)[0]), 20)
    truth = world.boxes(2.0)
    torch.testing.assert_close(boxes.centre, truth.centre, atol=1e-4, rtol=0)
    torch.testing.assert_close(boxes.size_lwh, truth.size_lwh)
    torch.testing.assert_close(boxes.velocity, truth.velocity, atol=1e-5, rtol=0)
    assert boxes.track_id.tolist() == [7, 11]
    assert boxes.category.tolist() == [Category.CAR, Category.TRUCK]


def test_a_log_without_a_single_box_has_no_boxes_at_any_frame(flat_log: Path, tmp_path: Path) -> None:
    path = copy_of(flat_log, tmp_path)
    file = path.folder / f"{BOXES}.arrow"
    for column in ("bounding_box_se3", "track_token", "label", "velocity_3d", "num_lidar_points"):
        rewrite_column(file, f"{BOXES}.{column}", lambda rows: [[] for _ in rows])
    boxes = read_boxes(Log(path), 20)
    assert boxes is not None
    assert boxes.centre.shape == (0, 3)
    assert boxes.category.tolist() == []


def test_headings_and_velocities_turn_with_the_ego_vehicle(flat_log: Path, tmp_path: Path) -> None:
    path = copy_of(flat_log, tmp_path)
    quarter_left = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    turn = lambda rows: [[*row[:3], *quarter_left] for row in rows]  # noqa: E731
    rewrite_column(path.folder / "ego_state_se3.arrow", "ego_state_se3.imu_se3", turn)
    boxes = read_boxes(Log(path), 0)
    assert boxes.yaw.tolist() == pytest.approx([-np.pi / 2] * 2)
    parked, moving = world.PARKED["centre"], world.MOVING
    assert boxes.centre[0].tolist() == pytest.approx([parked[1], -parked[0], parked[2]], abs=1e-4)
    assert boxes.velocity[1].tolist() == pytest.approx([0, -moving["speed"]], abs=1e-5)


@pytest.mark.parametrize("logged", [None, [0.0, 0.0, 0.0]])
def test_velocity_comes_from_the_track_where_it_is_not_logged(
    flat_log: Path, tmp_path: Path, logged: list[float] | None
) -> None:
    path = copy_of(flat_log, tmp_path)
    file = path.folder / f"{BOXES}.arrow"
    rewrite_column(file, f"{BOXES}.velocity_3d", lambda rows: [[logged, logged] for _ in rows])
    once = lambda rows: [["7", "only-here" if i == 30 else "11"] for i in range(len(rows))]  # noqa: E731
    rewrite_column(file, f"{BOXES}.track_token", once)
    # another data set's zeros are what py123d writes for want of a velocity
    rewrite_metadata(path.folder / "sync.arrow", lambda metadata: metadata | {"dataset": "other"})
    log = Log(path)
    for frame in (0, 20, 50):
        torch.testing.assert_close(
            read_boxes(log, frame).velocity, world.boxes(0.0).velocity, atol=1e-4, rtol=0
        )
    assert read_boxes(log, 30).velocity[1].isnan().all()
    assert len(set(read_boxes(log, 30).track_id.tolist() + read_boxes(log, 31).track_id.tolist())) == 3


def test_a_track_with_a_long_gap_has_no_velocity_across_it(flat_log: Path, tmp_path: Path) -> None:
    path = copy_of(flat_log, tmp_path)
    file = path.folder / f"{BOXES}.arrow"
    rewrite_column(file, f"{BOXES}.velocity_3d", lambda rows: [[None, None] for _ in rows])
    seen = (10, 30, 40)
    rare = lambda rows: [["7", "11" if i in seen else f"x{i}"] for i in range(len(rows))]  # noqa: E731
    rewrite_column(file, f"{BOXES}.track_token", rare)
    log = Log(path)
    assert read_boxes(log, 10).velocity[1].isnan().all()  # 2 s to the next sighting
    assert read_boxes(log, 30).velocity[1].tolist() == pytest.approx([3.0, 0.0], abs=1e-4)  # one-sided


def test_the_ego_vehicles_own_box_is_left_out(flat_log: Path, tmp_path: Path) -> None:
    path = copy_of(flat_log, tmp_path)
    own = lambda rows: [["ego_vehicle", "11"] for _ in rows]  # noqa: E731
    rewrite_column(path.folder / f"{BOXES}.arrow", f"{BOXES}.track_token", own)
    assert len(read_boxes(Log(path), 5).centre) == 1


def test_boxes_without_size_are_left_out_and_counted(flat_log: Path, tmp_path: Path) -> None:
    """One of two boxes has no height at one of the frames: its attributes stay those of the other."""
    path = copy_of(flat_log, tmp_path)

    def flattened(rows: list) -> list:
        rows[20][0][9] = 0.0
        return rows

    rewrite_column(path.folder / f"{BOXES}.arrow", f"{BOXES}.bounding_box_se3", flattened)
    log = Log(path)
    assert [read_boxes(log, frame).track_id.tolist() for frame in (19, 20)] == [[7, 11], [11]]
    (finding,) = [each for each in check_log(path).findings if each.subject == "boxes"]
    count = 2 * len(log)
    assert finding.text == f"1 of {count} have no length, width or height, and are left out"
    assert finding.level == "note"


def test_no_boxes_and_no_annotation_are_two_things(tmp_path: Path) -> None:
    path = find_logs(world.write(tmp_path, frames=2))[0]
    for column in ("bounding_box_se3", "track_token", "label", "velocity_3d", "num_lidar_points"):
        rewrite_column(path.folder / f"{BOXES}.arrow", f"{BOXES}.{column}", lambda rows: [[], *rows[1:]])
    log = Log(path)
    assert read_boxes(log, 0).centre.shape == (0, 3)
    assert read_boxes(log, 1).centre.shape == (2, 3)
    (path.folder / f"{BOXES}.arrow").unlink()
    assert read_boxes(log, 0) is None


def test_a_box_that_is_not_finite_is_named(flat_log: Path, tmp_path: Path) -> None:
    path = copy_of(flat_log, tmp_path)
    spoil = lambda rows: [[[np.nan] * 10] * 2 if i == 4 else row for i, row in enumerate(rows)]  # noqa: E731
    rewrite_column(path.folder / f"{BOXES}.arrow", f"{BOXES}.bounding_box_se3", spoil)
    with pytest.raises(InputError, match=r"box_detections_se3\.arrow: a box in row 4 is not finite"):
        read_boxes(Log(path), 0)


def test_categories_survive_writing_and_reading() -> None:
    assert {category_of(label): category for category, label in LABEL_OF_CATEGORY.items()} == {
        category: category for category in Category
    }


@pytest.mark.parametrize(
    ("label", "category"),
    [
        (registry.NuScenesBoxDetectionLabel.VEHICLE_BUS_BENDY, Category.BUS),
        (registry.NuScenesBoxDetectionLabel.VEHICLE_EMERGENCY_POLICE, Category.CAR),
        (registry.NuScenesBoxDetectionLabel.HUMAN_PEDESTRIAN_CHILD, Category.PEDESTRIAN),
        (registry.NuScenesBoxDetectionLabel.STATIC_OBJECT_BICYCLE_RACK, Category.OTHER),
        (registry.PandasetBoxDetectionLabel.PICKUP_TRUCK, Category.CAR),
        (registry.PandasetBoxDetectionLabel.SEMI_TRUCK, Category.TRUCK),
        (
            registry.PandasetBoxDetectionLabel.OTHER_VEHICLE_CONSTRUCTION_VEHICLE,
            Category.CONSTRUCTION_VEHICLE,
        ),
        (registry.PandasetBoxDetectionLabel.MOTORIZED_SCOOTER, Category.MOTORCYCLE),
        (registry.PandasetBoxDetectionLabel.PYLONS, Category.TRAFFIC_CONE),
        (registry.AV2SensorBoxDetectionLabel.VEHICULAR_TRAILER, Category.TRAILER),
        (registry.AV2SensorBoxDetectionLabel.BICYCLIST, Category.PEDESTRIAN),
        (registry.AV2SensorBoxDetectionLabel.STOP_SIGN, Category.OTHER),
        (registry.NuPlanBoxDetectionLabel.VEHICLE, Category.CAR),
        (registry.WODPerceptionBoxDetectionLabel.TYPE_CYCLIST, Category.BICYCLE),
        (registry.KITTI360BoxDetectionLabel.CARAVAN, Category.TRAILER),
    ],
)
def test_native_labels_become_categories(label: registry.BoxDetectionLabel, category: Category) -> None:
    assert category_of(label) is category


def test_every_label_of_every_data_set_has_a_category() -> None:
    labels = [label for labels in BOX_DETECTION_LABEL_REGISTRY.values() for label in labels]
    assert len(labels) > 150
    named = {label.name for label in labels if {"BUS", "BENDY"} & set(label.name.split("_"))}
    assert {label.name for label in labels if category_of(label) is Category.BUS} >= named
