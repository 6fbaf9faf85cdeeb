"""Files of detections: what is read, and what a wrong record is told."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from tasks.files_of_detections import box, write_coco_truth, write_list, write_nuscenes

from foredrive.data.boxes import read_boxes
from foredrive.data.log_paths import LogPath
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.scene import Category
from foredrive.tasks.detection.files import read_detections


def test_nuscenes_boxes_around_the_ego_vehicle(tmp_path: Path) -> None:
    truth = write_nuscenes(
        tmp_path / "gt.json",
        {
            "a": [box(1003.0, 504.0, yaw=3.0, ego_translation=[3.0, 4.0, 0.5], num_pts=7, scene_token="s")],
            "b": [],
        },
    )
    said = box(1004.0, 504.0, yaw=-3.0, detection_score=0.5, covariance=[0.1] * 6, yaw_std=0.5)
    results = write_nuscenes(tmp_path / "found.json", {"a": [said]})
    read = read_detections(results, truth)
    assert read.is_3d
    assert read.classes == ["car"]
    assert read.counts == {
        "frames_without_detections": 1,
        "boxes_without_covariance": 0,
        "frames_without_ego": 1,  # the empty one
        "boxes_without_size_left_out": 0,
        "true_boxes_without_size_left_out": 0,
    }
    frame, empty = read.frames
    assert (frame.name, frame.sequence, empty.name) == ("a", "s", "b")
    expected = [3.0, 4.0, 0.5, math.log(4), math.log(2), math.log(1.5)]
    np.testing.assert_allclose(frame.objects.state.numpy(), [expected])
    np.testing.assert_allclose(frame.detected.boxes.mean.numpy(), [[4.0, *expected[1:]]])
    np.testing.assert_allclose(frame.detected.boxes.chol.numpy()[0], np.eye(6) * math.sqrt(0.1))
    assert frame.detected.boxes.yaw is not None
    assert frame.detected.boxes.concentration is not None
    assert frame.detected.boxes.yaw.item() == pytest.approx(-3.0)
    assert frame.detected.boxes.concentration.item() == pytest.approx(4.0)
    assert frame.range_m is not None
    assert frame.range_m.tolist() == pytest.approx([5.0])
    assert frame.visibility is not None
    assert frame.visibility.tolist() == [7.0]
    assert len(empty.detected.log_existence) == len(empty.objects.label) == 0


def test_the_truth_may_be_logs(log: LogPath, tmp_path: Path) -> None:
    """Frames have the names of clips, so that their scores go into an index of search."""
    opened = Log(log)
    frames = {f"{log.name}@{opened.t_us[k]}": k for k in (3, 12)}
    results = {name: [box(*opened.T_world_ego[k, :2, 3], detection_score=0.5)] for name, k in frames.items()}
    read = read_detections(write_nuscenes(tmp_path / "found.json", results), log.folder)
    assert [frame.name for frame in read.frames] == list(frames)
    for frame, k in zip(read.frames, frames.values(), strict=True):
        boxes = read_boxes(opened, k)
        assert boxes is not None
        boxes = boxes[boxes.valid]
        assert frame.sequence == log.name
        # Turned into the axes of the world, about the ego vehicle, which is where the detection is
        R_world_ego = torch.from_numpy(opened.T_world_ego[k, :3, :3])
        torch.testing.assert_close(frame.objects.state[:, :3], boxes.centre.double() @ R_world_ego.T)
        torch.testing.assert_close(frame.objects.state[:, 3:], boxes.size_lwh.double().log())
        ahead = torch.stack([boxes.yaw.cos(), boxes.yaw.sin(), torch.zeros_like(boxes.yaw)], -1).double()
        turned = ahead @ R_world_ego.T
        assert frame.objects.yaw is not None
        torch.testing.assert_close(frame.objects.yaw.cos(), turned[:, 0], atol=1e-3, rtol=0)
        assert [read.classes[n] for n in frame.objects.label.tolist()] == [
            Category(kind).name.lower() for kind in boxes.category.tolist()
        ]
        assert abs(frame.detected.boxes.mean[0, :2]).max() < 1e-6
    unlike = write_nuscenes(tmp_path / "other.json", {f"{log.name}@1": []})
    with pytest.raises(InputError, match="none of its 1 frames is in"):
        read_detections(unlike, log.folder)
    with pytest.raises(InputError, match="a truth of logs needs an object of boxes by sample"):
        read_detections(write_list(tmp_path / "coco.json", []), log.folder)


def test_files_as_the_devkit_serialises_boxes(tmp_path: Path) -> None:
    """No `results` key, and zeros where nobody computed the boxes' place beside the ego vehicle."""
    unset = {"ego_translation": [0.0, 0.0, 0.0], "num_pts": -1, "attribute_name": "", "velocity": [0.0, 0.0]}
    content = {"a": [box(1003.0, 504.0, detection_score=-1.0, sample_token="a", **unset)], "b": []}
    (tmp_path / "gt.json").write_text(json.dumps(content))
    results = write_nuscenes(tmp_path / "found.json", {"a": [box(1003.0, 504.0, detection_score=0.5)]})
    read = read_detections(results, tmp_path / "gt.json")
    assert [frame.name for frame in read.frames] == ["a", "b"]
    assert read.counts["frames_without_ego"] == 2
    assert read.frames[0].objects.state[0, :2].tolist() == [0.0, 0.0]  # around the frame's boxes


def test_nuscenes_boxes_without_size_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The first true box, which tells where the ego vehicle is, has no height."""
    flat = box(1001.0, 500.0, ego_translation=[1.0, 0.0, 1.0], size=[2.0, 4.0, 0.0])
    truth = write_nuscenes(tmp_path / "gt.json", {"a": [flat, box(1003.0, 504.0)], "b": []})
    said = [box(1003.0, 504.0, detection_score=0.5), box(1009.0, 504.0, detection_score=0.4, size=[0, 0, 0])]
    read = read_detections(write_nuscenes(tmp_path / "found.json", {"a": said}), truth)
    assert read.frames[0].objects.state[:, :2].tolist() == [[3.0, 4.0]]
    assert read.frames[0].detected.boxes.mean[:, :2].tolist() == [[3.0, 4.0]]
    assert read.counts["boxes_without_size_left_out"] == read.counts["true_boxes_without_size_left_out"] == 1
    assert caplog.messages == [
        f"{tmp_path / name}: left out of 2: 1 boxes without size" for name in ("found.json", "gt.json")
    ]


def test_coco_boxes_and_class_probabilities(tmp_path: Path) -> None:
    truth = write_coco_truth(
        tmp_path / "gt.json",
        [
            {"image_id": 2, "category_id": 7, "bbox": [10, 20, 30, 40]},
            {"image_id": 2, "category_id": 7, "bbox": [0, 0, 1, 1], "iscrowd": 1},
        ],
    )
    record = {"image_id": 2, "category_id": 7, "bbox": [10, 20, 100, 40], "score": 1.0}
    record["class_probabilities"] = {"dog": 0.75, "car": 0.25}
    read = read_detections(write_list(tmp_path / "found.json", [record]), truth)
    assert not read.is_3d
    assert read.counts["crowds_left_out"] == read.counts["boxes_without_covariance"] == 1
    frame = read.frames[1]
    assert frame.objects.state.tolist() == [[10, 20, 40, 60]]
    assert frame.objects.label.tolist() == [1]
    np.testing.assert_allclose(frame.detected.log_class.exp().numpy(), [[0.25, 0.75]])
    std = [math.sqrt(side**2 + 1) for side in (5.0, 2.0, 5.0, 2.0)]
    np.testing.assert_allclose(frame.detected.boxes.chol.numpy()[0], np.diag(std))
    assert frame.detected.log_absence.exp().item() == pytest.approx(1e-6)  # not 0, whatever the rounding


def test_kitti_boxes_forward_left_up(tmp_path: Path) -> None:
    """A car 20 m ahead and 3 m to the right that heads away (rotation -π/2), and one that heads right (0)."""
    (tmp_path / "gt").mkdir()
    (tmp_path / "found").mkdir()
    (tmp_path / "gt" / "000001.txt").write_text(
        f"Car 0.00 2 0 1 2 3 4 1.5 2.0 4.0 3.0 1.7 20.0 {-math.pi / 2}\n"
        "DontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1 -1 -1 -1\n"
    )
    (tmp_path / "found" / "000001.txt").write_text("Car -1 -1 0 1 2 3 4 1.5 2.0 4.0 3.0 1.7 20.0 0.0 0.9\n")
    read = read_detections(tmp_path / "found", tmp_path / "gt")
    (frame,) = read.frames
    expected = [20.0, -3.0, -(1.7 - 0.75), math.log(4), math.log(2), math.log(1.5)]
    np.testing.assert_allclose(frame.objects.state.numpy(), [expected])
    assert frame.objects.yaw is not None
    assert frame.detected.boxes.yaw is not None
    assert frame.objects.yaw.item() == pytest.approx(0.0, abs=1e-12)
    assert frame.detected.boxes.yaw.item() == pytest.approx(-math.pi / 2)
    assert frame.visibility is not None
    assert frame.visibility.tolist() == [2.0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"size": [-2.0, 4.0, 1.5]}, r"frame a, box 1 has the size"),
        ({"size": [2.0, 4.0]}, r"box 1 has no size of 3"),
        ({"translation": [float("nan"), 0.0, 0.0]}, r"frame a, box 1: its translation is not finite"),
        ({"rotation": [0.0, 0.0, 0.0, 0.0]}, r"frame a, box 1 has the rotation"),
        ({"detection_score": 1.2}, r"box 1 has a score outside"),
        ({"detection_score": float("nan")}, r"box 1: its detection_score is not finite"),
        ({"covariance": [1, 1, 1, 1, 1, -1]}, r"box 1 has a covariance that is not positive"),
        ({"covariance": [1, 2]}, r"box 1: its covariance is neither"),
        ({"yaw_std": 0.0}, r"box 1 has a standard deviation of its heading"),
        ({"class_probabilities": {"moon": 1.0}}, r"box 1: class_probabilities"),
        ({"class_probabilities": {"car": "x"}}, r"box 1: class_probabilities must be numbers"),
        ({"covariance": ["x"] * 6}, r"box 1: its covariance is not made of numbers"),
        ({"class_probabilities": {"car": 0.4}}, r"box 1 has class probabilities"),
        ({"detection_name": None}, r"box 1 has no detection_name"),
        ({"translation": [1e200, 0.0, 0.0]}, r"box 1: its translation is beyond 1e\+12"),
        ({"size": [10**400, 4.0, 1.5]}, r"box 1 has no size of 3"),
        ({"yaw_std": 1e-200}, r"box 1 has a standard deviation of its heading below"),
    ],
)
def test_wrong_boxes_are_named(tmp_path: Path, change: dict, message: str) -> None:
    truth = write_nuscenes(tmp_path / "gt.json", {"a": [box(0.0, 0.0)]})
    good = box(0.0, 0.0, detection_score=0.5)
    results = write_nuscenes(tmp_path / "found.json", {"a": [good, {**good, **change}]})
    with pytest.raises(InputError, match=message):
        read_detections(results, truth)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"size": [-2.0, 4.0, 1.5]}, r"gt\.json: frame a, box 0 has the size"),
        ({"size": [0.0, 4.0, 1.5]}, r"left out of 1: 1 boxes without size: nothing remains"),
        ({"ego_translation": "x"}, r"gt\.json: frame a, box 0 has no ego_translation of 3"),
        (
            {"ego_translation": [1.0, math.nan, 0.0]},
            r"gt\.json: frame a, box 0: its ego_translation is not finite",
        ),
        ({"num_pts": math.nan}, r"gt\.json: frame a, box 0: its num_pts is not finite"),
        ({"relevance": -1.0}, r"gt\.json: frame a, box 0 has a relevance below 0"),
    ],
)
def test_wrong_truth_is_named(tmp_path: Path, change: dict, message: str) -> None:
    truth = write_nuscenes(tmp_path / "gt.json", {"a": [{**box(0.0, 0.0), **change}]})
    results = write_nuscenes(tmp_path / "found.json", {"a": [box(0.0, 0.0, detection_score=0.5)]})
    with pytest.raises(InputError, match=message):
        read_detections(results, truth)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"images": [{"id": 1, "width": 9, "height": 0}]}, r"image 1 has the size 9 x 0"),
        ({"images": [{"id": 1, "width": 9}]}, r"image 1 has no height: .* needs `width` and `height` \(px\)"),
        ({"images": [{"id": 1}, {"id": 1}]}, r"images 1 has the id 1 again"),
        ({"images": [{"id": [1]}]}, r"images 0 has no id"),
        ({"categories": [{"name": "car"}]}, r"categories 0 has no id"),
        ({"categories": [{"id": 3, "name": "car"}, {"id": 4, "name": "car"}]}, r"have the same name"),
        ({"annotations": None}, r"has no list of annotations"),
    ],
)
def test_wrong_image_truth_is_named(tmp_path: Path, change: dict, message: str) -> None:
    truth = write_coco_truth(tmp_path / "gt.json", [])
    truth.write_text(json.dumps(json.loads(truth.read_text()) | change))
    with pytest.raises(InputError, match=r"gt\.json.* " + message):
        read_detections(write_list(tmp_path / "found.json", []), truth)


def test_wrong_lines_are_named(tmp_path: Path) -> None:
    good = "Car 0 0 0 1 2 3 4 1.5 2 4 3 1.7 20 0.1"
    for name in ("gt", "found"):
        (tmp_path / name).mkdir()
    (tmp_path / "gt" / "0.txt").write_text(good)
    for line, message in (
        (good, "line 2 has 15 fields, not 16"),
        (f"{good} x", "line 2 has something that is not a number"),
        (f"{good} nan", "line 2 has a number that is not finite"),
        (f"{good} 3.5", "line 2 has a score outside"),
    ):
        (tmp_path / "found" / "0.txt").write_text(f"{good} 0.5\n{line}\n")
        with pytest.raises(InputError, match=rf"0\.txt: {message}"):
            read_detections(tmp_path / "found", tmp_path / "gt")


COCO_BOXES = [
    {"image_id": 1, "category_id": 3, "bbox": [10, 10, 20, 10], "score": 0.9},
    {"image_id": 1, "category_id": 3, "bbox": [30, 10, 20, 0.0], "score": 0.5},
    {"image_id": 2, "category_id": 91, "bbox": [10, 10, 20, 10], "score": 0.8},
    {"image_id": 2, "category_id": 7, "bbox": [50, 10, 20, 10], "score": 0.7, "covariance": None},
]


def test_other_categories_and_boxes_without_size_are_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    car = {"image_id": 1, "category_id": 3, "bbox": [10, 10, 20, 10], "relevance": None}
    truth = write_coco_truth(tmp_path / "gt.json", [car, {**car, "bbox": [0, 0, 0, 5]}])
    read = read_detections(write_list(tmp_path / "found.json", COCO_BOXES), truth)
    assert [len(frame.detected.log_existence) for frame in read.frames] == [1, 1]
    assert [len(frame.objects.label) for frame in read.frames] == [1, 0]
    assert read.frames[0].relevance is None
    assert read.counts["boxes_of_other_classes_left_out"] == 1
    assert read.counts["boxes_without_size_left_out"] == 1
    assert read.counts["true_boxes_without_size_left_out"] == 1
    assert caplog.messages == [
        f"{tmp_path / 'found.json'}: left out of 4: 1 boxes of other categories, 1 boxes without size",
        f"{tmp_path / 'gt.json'}: left out of 2: 1 boxes without size",
    ]


def test_coco_results_with_a_mark_or_under_annotations(tmp_path: Path) -> None:
    truth = write_coco_truth(tmp_path / "gt.json", [])
    file = tmp_path / "found.json"
    for text in (
        "\ufeff" + json.dumps(COCO_BOXES[:1]).replace(", ", ",\r\n"),
        json.dumps({"annotations": COCO_BOXES[:1]}),
    ):
        file.write_text(text, "utf-8")
        assert [len(frame.detected.log_existence) for frame in read_detections(file, truth).frames] == [1, 0]


def test_kitti_folders_as_other_tools_write_them(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """In data/, with a byte order mark, CRLF, and a line without a 3-D box."""
    good = "Car 0 0 0 1 2 3 4 1.5 2 4 3 1.7 20 0.1"
    (tmp_path / "gt").mkdir()
    (tmp_path / "gt" / "0.txt").write_text(good)
    data = tmp_path / "found" / "data"
    data.mkdir(parents=True)
    flat = good.replace("1.5 2 4", "-1 -1 -1")
    (data / "0.txt").write_bytes(f"\ufeff{good} 0.5\r\n{flat} 0.9\r\n".encode())
    read = read_detections(tmp_path / "found", tmp_path / "gt")
    assert len(read.frames[0].detected.log_existence) == 1
    assert read.counts["frames_without_detections"] == 0
    assert caplog.messages == [f"{data}: left out of 2: 1 boxes without size"]
    (data / "0.txt").rename(tmp_path / "found" / "7.txt")
    with pytest.raises(InputError, match=r"found: holds no results of the frames in .*gt, such as 0\.txt"):
        read_detections(tmp_path / "found", tmp_path / "gt")


def test_wrong_files_are_named(tmp_path: Path) -> None:
    truth = write_nuscenes(tmp_path / "gt.json", {"a": []})
    elsewhere = write_nuscenes(tmp_path / "found.json", {"z": []})
    with pytest.raises(InputError, match=r"frame z .* is not in"):
        read_detections(elsewhere, truth)
    (tmp_path / "empty.json").write_text("")
    with pytest.raises(InputError, match=r"empty\.json: not JSON"):
        read_detections(tmp_path / "empty.json", truth)
    (tmp_path / "deep.json").write_text("[" * 100_000)
    with pytest.raises(InputError, match=r"deep\.json: not JSON"):
        read_detections(tmp_path / "deep.json", truth)
    with pytest.raises(InputError, match=r"nowhere\.json: No such file"):
        read_detections(tmp_path / "nowhere.json", truth)
    with pytest.raises(InputError, match=r"list\.json: neither an object"):
        read_detections(truth, write_list(tmp_path / "list.json", []))
    with pytest.raises(InputError, match="holds any box"):
        read_detections(truth, truth)
    (tmp_path / "kitti").mkdir()
    (tmp_path / "kitti" / "0.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"0\.txt: not text"):
        read_detections(tmp_path / "kitti", tmp_path / "kitti")
    with pytest.raises(InputError, match="holds no frames"):
        read_detections(write_nuscenes(tmp_path / "none.json", {}), tmp_path / "none.json")
    coco = write_coco_truth(tmp_path / "coco.json", [])
    for record, message in (
        ({"image_id": 9, "category_id": 3}, "record 0 is of the unknown image 9"),
        ({"image_id": 1, "category_id": 8}, "left out of 1: 1 boxes of other categories: nothing remains"),
        (
            {"image_id": 1, "category_id": 3, "bbox": [1, 2, 0, 4], "score": 1},
            "left out of 1: 1 boxes without size: nothing remains",
        ),
        (
            {"image_id": 1, "category_id": 3, "bbox": [1, 2, -1, 4], "score": 1},
            "record 0 has a bbox of the size -1 x 4",
        ),
        ({"image_id": 1, "category_id": 3, "bbox": [1, 2, 3, 4]}, "record 0 has no score"),
        ({"image_id": [1], "category_id": 3}, "record 0 is of the unknown image None"),
        ({"image_id": 1, "category_id": [3]}, r"record 0 has the unknown category \[3\]"),
        (17, "record 0 is of the unknown image None"),
    ):
        with pytest.raises(InputError, match=message):
            read_detections(write_list(tmp_path / "list.json", [record]), coco)
    (tmp_path / "number.json").write_text(json.dumps(3))
    with pytest.raises(InputError, match="neither a list"):
        read_detections(tmp_path / "number.json", coco)
