"""Lidar points, attributes and visibility of boxes: written, read, counted, and unknown where nobody told."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import raw_pandaset
import synthetic_log as world
import torch
from arrow_surgery import rewrite_column
from nuscenes_keyframe import written_keyframe

from foredrive.data import ClipConfig, ClipDataset, LogPath, collate, find_logs
from foredrive.data.boxes import read_boxes, with_counted_points
from foredrive.data.formats.convert import convert
from foredrive.data.log_writer import LogWriter
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.scene import Attribute, Category, LidarSweep, Visibility, VoxelSpec
from foredrive.scene.actors import ActorState, boxes_in_ego_frame
from foredrive.scene.boxes import UNKNOWN

GRID = VoxelSpec((0.0, 0.0, 0.0), 1.0, (1, 2, 2))


def written(root: Path, shares: list[float], **labels: list[int]) -> Log:
    """The flat log of one frame with labels of its two boxes."""
    frame = world.frame(0, [])
    boxes = dataclasses.replace(
        frame.boxes, **{name: torch.tensor(values) for name, values in labels.items()}
    )
    with LogWriter(root, "flat_train", "log", [], None, None, None) as writer:
        writer.write(dataclasses.replace(frame, boxes=boxes, visibility=np.array(shares, np.float32)))
    return Log(find_logs(root)[0])


def test_labels_come_back_from_a_log(tmp_path: Path) -> None:
    attributes = [Attribute.VEHICLE_PARKED, UNKNOWN]
    boxes = read_boxes(written(tmp_path, [0.1, 1.0], num_points=[17, UNKNOWN], attribute=attributes), 0)
    assert boxes is not None
    assert boxes.num_points.tolist() == [17, UNKNOWN]
    assert boxes.attribute.tolist() == attributes
    assert boxes.visibility.tolist() == [Visibility.V0_40, Visibility.V80_100]


@pytest.mark.parametrize(
    ("share", "level"),
    [(0.0, 1), (0.398, 1), (0.402, 2), (0.598, 2), (0.602, 3), (0.798, 3), (0.802, 4), (1.0, 4)],
)
def test_levels_of_visibility_are_those_of_nuscenes(share: float, level: int, tmp_path: Path) -> None:
    boxes = read_boxes(written(tmp_path, [share, share]), 0)
    assert boxes is not None
    assert boxes.visibility.tolist() == [level, level]


def test_names_of_attributes_are_those_of_nuscenes() -> None:
    assert [attribute.label for attribute in Attribute] == [
        "vehicle.moving",
        "vehicle.parked",
        "vehicle.stopped",
        "cycle.with_rider",
        "cycle.without_rider",
        "pedestrian.moving",
        "pedestrian.standing",
        "pedestrian.sitting_lying_down",
    ]


def test_a_log_of_an_earlier_version_is_read_with_labels_unknown(flat_log: Path) -> None:
    boxes = read_boxes(Log(find_logs(flat_log)[0]), 3)
    assert boxes is not None
    for name in ("num_points", "attribute", "visibility"):
        assert getattr(boxes, name).tolist() == [UNKNOWN, UNKNOWN]


def test_labels_of_another_number_of_boxes_are_named(tmp_path: Path) -> None:
    log = written(tmp_path, [0.5, 0.5], attribute=[0, 1])
    file = log.path.folder / "box_detections_se3.arrow"
    for column in ("bounding_box_se3", "track_token", "label", "velocity_3d", "num_lidar_points"):
        rewrite_column(file, f"box_detections_se3.{column}", lambda rows: [row[:1] for row in rows])
    with pytest.raises(InputError, match="frame 0 has 1 boxes and 2 attributes"):
        read_boxes(Log(log.path), 0)


def test_points_are_counted_only_where_their_number_is_unknown() -> None:
    boxes = dataclasses.replace(world.boxes(0.0), num_points=torch.tensor([UNKNOWN, 5]))
    parked, moving = (
        torch.tensor(box["centre"], dtype=torch.float32) for box in (world.PARKED, world.MOVING)
    )
    inside = [parked, parked + torch.tensor([1.9, 0.9, 0.9]), moving]
    outside = [parked + torch.tensor([2.1, 0.0, 0.0]), parked + torch.tensor([0.0, 0.0, -1.1])]
    points = torch.stack(inside + outside)
    range_m = points.norm(dim=-1)
    count = len(points)
    sweep = LidarSweep(
        origin_ego=torch.zeros(count, 3),
        dir_ego=points / range_m[:, None],
        range_m=range_m,
        returned=torch.ones(count, dtype=torch.bool),
        intensity=torch.zeros(count),
        dt_s=torch.zeros(count),
        beam=torch.zeros(count, dtype=torch.int64),
        valid=torch.ones(count, dtype=torch.bool),
    )
    assert with_counted_points(boxes, sweep).num_points.tolist() == [2, 5]


def test_clips_have_counted_points_and_batches_pad_them_as_unknown(flat_log: Path, tmp_path: Path) -> None:
    log = find_logs(flat_log)[0]
    clips = ClipDataset([log], ClipConfig(0, 0, (8, 16), GRID), tmp_path)
    for _ in range(2):  # from the log, then from the cache
        boxes = clips[0].clip.boxes
        assert (boxes.num_points[0] > 5).all()
    bare = clips[0]
    none = dataclasses.replace(bare, clip=dataclasses.replace(bare.clip, boxes=boxes[:, :0]))
    padded = collate([bare, none]).clip.boxes
    for name in ("num_points", "attribute", "visibility"):
        assert getattr(padded, name)[1].tolist() == [[UNKNOWN, UNKNOWN]]


@pytest.mark.parametrize(
    ("category", "speed_mps", "parked", "attribute"),
    [
        (Category.CAR, 3.0, False, Attribute.VEHICLE_MOVING),
        (Category.BUS, 0.0, False, Attribute.VEHICLE_STOPPED),
        (Category.CAR, 0.0, True, Attribute.VEHICLE_PARKED),
        (Category.BICYCLE, 0.0, False, Attribute.CYCLE_WITH_RIDER),
        (Category.MOTORCYCLE, 0.0, True, Attribute.CYCLE_WITHOUT_RIDER),
        (Category.PEDESTRIAN, 1.2, False, Attribute.PEDESTRIAN_MOVING),
        (Category.PEDESTRIAN, 0.0, False, Attribute.PEDESTRIAN_STANDING),
        (Category.BARRIER, 0.0, False, UNKNOWN),
    ],
)
def test_actors_have_attributes(category: Category, speed_mps: float, parked: bool, attribute: int) -> None:
    velocity = np.array([0.0, speed_mps, 0.0])
    actor = ActorState(1, category, np.ones(3), 0.0, 0.0, np.ones(3), velocity, style=0, parked=parked)
    assert boxes_in_ego_frame([actor], np.eye(4)).attribute.tolist() == [attribute]


def test_attributes_of_pandaset(tmp_path: Path) -> None:
    raw_pandaset.write(tmp_path / "raw")
    nan, kinds = math.nan, ["Car", "Bicycle", "Pedestrian", "Pedestrian", "Car", "Cones"]
    count = len(kinds)
    cuboids = {
        "uuid": [f"box-{number}" for number in range(count)],
        "label": kinds,
        "yaw": [0.5] * count,
        "position.x": [5.0 * number for number in range(count)],
        "position.y": [10.0] * count,
        "position.z": [0.8] * count,
        "dimensions.x": [1.9] * count,
        "dimensions.y": [4.7] * count,
        "dimensions.z": [1.6] * count,
        "cuboids.sibling_id": ["-"] * count,
        "cuboids.sensor_id": [-1] * count,
        "attributes.object_motion": ["Stopped", "Moving", nan, nan, "Parked", nan],
        "attributes.rider_status": ["", "Without Rider", nan, nan, nan, nan],
        "attributes.pedestrian_behavior": ["", nan, "Walking", "Sitting", nan, nan],
    }
    file = tmp_path / "raw" / raw_pandaset.CUBOIDS
    raw_pandaset.write_pickle(file, raw_pandaset.table(cuboids))
    boxes = read_boxes(Log(convert(tmp_path / "raw", "pandaset", tmp_path / "out")[0]), 0)
    assert boxes is not None
    assert boxes.attribute.tolist() == [
        Attribute.VEHICLE_STOPPED,
        Attribute.CYCLE_WITHOUT_RIDER,
        Attribute.PEDESTRIAN_MOVING,
        Attribute.PEDESTRIAN_SITTING_LYING_DOWN,
        Attribute.VEHICLE_PARKED,
        UNKNOWN,
    ]


@pytest.mark.real
def test_real_logs_have_the_labels_that_they_tell(real_data: Path, tmp_path: Path) -> None:
    def clip_boxes(path: LogPath, cache: Path | None = None) -> dict[str, np.ndarray]:
        config = ClipConfig(0, 0, (64, 64), GRID)
        boxes = ClipDataset([path], config, cache)[0].clip.boxes[0]
        return {name: getattr(boxes, name).numpy() for name in ("num_points", "attribute", "visibility")}

    (pandaset,) = convert(real_data / "pandaset", "pandaset", tmp_path)
    found = clip_boxes(pandaset)
    assert (found["num_points"] > 0).mean() > 0.9
    assert set(found["attribute"].tolist()) >= {
        UNKNOWN,
        Attribute.VEHICLE_PARKED,
        Attribute.PEDESTRIAN_MOVING,
    }
    assert (found["visibility"] == UNKNOWN).all()
    found = clip_boxes(convert(real_data / "av2", "av2", tmp_path)[0])
    assert found["num_points"].min() >= 0
    assert found["num_points"].max() > 100
    assert (found["attribute"] == UNKNOWN).all()
    (keyframe,) = convert(written_keyframe(real_data, tmp_path), "nuscenes", tmp_path)
    assert clip_boxes(keyframe)["num_points"].min() >= 0
    kitti = convert(real_data / "kitti", "kitti-object", tmp_path)
    found = clip_boxes(kitti[1])
    assert found["attribute"].tolist() == [UNKNOWN, UNKNOWN, Attribute.CYCLE_WITH_RIDER]
    assert found["num_points"].min() >= 0


@pytest.mark.real
def test_a_table_of_annotations_tells_attributes_and_visibility(real_data: Path, tmp_path: Path) -> None:
    """The info file of the key frame has neither; these are made up for three of its boxes."""
    rows = json.loads(next((real_data / "nuscenes" / "keyframe").glob("v1.0-*/attribute.json")).read_text())
    token = {row["name"]: row["token"] for row in rows}
    labels = {
        0: {"attribute_tokens": [token["pedestrian.standing"]], "visibility_token": "1"},
        1: {"visibility_token": "4"},
        2: {"attribute_tokens": [token["vehicle.parked"]], "visibility_token": "3"},
    }
    raw = written_keyframe(real_data, tmp_path, labels)
    told = read_boxes(Log(convert(raw, "nuscenes", tmp_path / "out")[0]), 0)
    assert told is not None
    assert told.attribute[:3].tolist() == [Attribute.PEDESTRIAN_STANDING, UNKNOWN, Attribute.VEHICLE_PARKED]
    assert told.visibility[:3].tolist() == [Visibility.V0_40, Visibility.V80_100, Visibility.V60_80]
    assert (told.attribute[3:] == UNKNOWN).all()
    assert (told.visibility[3:] == UNKNOWN).all()
