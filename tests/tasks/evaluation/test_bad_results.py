"""Results that are wrong: one clear line that names the file and the entry, in every format."""

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from foredrive.errors import InputError
from foredrive.tasks.detection.kitti_boxes import score_kitti_boxes
from foredrive.tasks.maps.files import read_maps
from foredrive.tasks.motion.files import read_agents
from foredrive.tasks.objects.reading import read_objects
from foredrive.tasks.tracking.kitti_tracks import score_kitti_tracks

BOX = {
    "translation": [10.0, 0.0, 1.0],
    "size": [2.0, 4.0, 1.5],
    "rotation": [1.0, 0.0, 0.0, 0.0],
    "velocity": [1.0, 0.0],
    "ego_translation": [10.0, 0.0, 1.0],
}
PATH = [[10.0 + k, 0.0] for k in range(12)]
LINE = {"pts": [[0.0, 0.0], [9.0, 0.0]], "cls_name": "divider"}

Content = dict[str, Any]


def of_boxes(*boxes: Content) -> Content:
    return {"results": {"a": [dict(box) for box in boxes], "b": []}}


DETECTION = of_boxes(BOX | {"detection_name": "car", "detection_score": 0.5, "attribute_name": ""})
TRACK = BOX | {"tracking_name": "car", "tracking_score": 0.5, "tracking_id": "7"}
TRACKING = of_boxes(TRACK, TRACK | {"tracking_id": "8"})
MOTION = of_boxes(BOX | {"detection_name": "car", "detection_score": 0.5, "predict_traj": [PATH]})
MAPTR = {
    "results": [
        {"sample_token": "a", "vectors": [LINE | {"confidence_level": 0.5, "global_id": n} for n in (1, 2)]}
    ]
}
STREAM = {
    "results": {
        "a": {
            "vectors": [LINE["pts"], LINE["pts"]],
            "labels": [1, 1],
            "scores": [0.5, 0.5],
            "global_ids": [1, 2],
        }
    }
}
SAMPLES = {
    name: {"scene_token": "s", "timestamp": n, "ego_translation": [0.0, 0.0, 0.0]}
    for n, name in enumerate("ab")
}
POSE = {"translation": [0.0, 0.0, 0.0], "rotation": [1.0, 0.0, 0.0, 0.0]}
TRUTHS: dict[str, Content] = {
    "detection": of_boxes(BOX | {"detection_name": "car", "num_pts": 3}) | {"samples": SAMPLES},
    "tracking": of_boxes(BOX | {"tracking_name": "car", "tracking_id": "1"}) | {"samples": SAMPLES},
    "motion": of_boxes(BOX | {"detection_name": "car", "traj": PATH})
    | {"ego_poses": dict.fromkeys("ab", POSE)},
    "map": {"GTs": [{"sample_token": name, "vectors": [LINE]} for name in "ab"]},
}


def boxes(content: Content) -> list[Content]:
    found: list[Content] = content["results"]["a"]
    return found


def vectors(content: Content) -> list[Content]:
    found: list[Content] = content["results"][0]["vectors"]
    return found


def lists(content: Content) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = content["results"]["a"]
    return found


def rename(content: Content) -> None:
    content["results"]["else"] = content["results"].pop("a")
    content["results"].pop("b", None)


def add_frame(content: Content) -> None:
    content["results"]["c"] = content["results"]["a"]


def rename_frame(content: Content) -> None:
    content["results"][0]["sample_token"] = "else"


BOX_0, VECTOR_0 = "frame a, box 0", "frame a, vector 0"
WRONG: list[tuple[str, Content, Callable[[Content], object], str]] = [
    ("detection", DETECTION, lambda c: boxes(c)[0].update(detection_name="zebra"), f"{BOX_0} .*'zebra'"),
    ("detection", DETECTION, lambda c: boxes(c)[0].update(translation=[0.0, float("nan"), 1.0]), BOX_0),
    ("detection", DETECTION, lambda c: boxes(c)[0].update(size=[2.0, float("inf"), 1.0]), BOX_0),
    ("detection", DETECTION, lambda c: boxes(c)[0].update(detection_score=float("nan")), BOX_0),
    ("detection", DETECTION, add_frame, "frame c .* has no ground truth"),
    ("detection", DETECTION, rename, "another split"),
    ("tracking", TRACKING, lambda c: boxes(c)[0].update(tracking_name="barrier"), f"{BOX_0} .*'barrier'"),
    ("tracking", TRACKING, lambda c: boxes(c)[0].update(rotation=[float("nan")] * 4), BOX_0),
    ("tracking", TRACKING, lambda c: boxes(c)[0].update(tracking_score=-0.1), f"{BOX_0} .*-0.1"),
    ("tracking", TRACKING, lambda c: boxes(c)[1].update(tracking_id="7"), "frame a, box 1 .*tracking_id 7"),
    ("tracking", TRACKING, add_frame, "frame c .* has no ground truth"),
    ("tracking", TRACKING, rename, "another split"),
    ("motion", MOTION, lambda c: boxes(c)[0].update(detection_name="zebra"), f"{BOX_0}: .*'zebra'"),
    ("motion", MOTION, lambda c: boxes(c)[0].update(translation=[0.0, float("nan"), 1.0]), BOX_0),
    ("motion", MOTION, lambda c: boxes(c)[0].update(predict_traj=[[[float("nan"), 0.0]] * 12]), BOX_0),
    ("motion", MOTION, lambda c: boxes(c)[0].update(detection_score=1.5), f"{BOX_0}: .*1.5"),
    ("motion", MOTION, add_frame, "frame c .* has no ground truth"),
    ("motion", MOTION, rename, "another split"),
    ("map", MAPTR, lambda c: vectors(c)[0].update(cls_name="zebra"), f"{VECTOR_0}: .*'zebra'"),
    ("map", MAPTR, lambda c: vectors(c)[0].update(pts=[[0.0, float("nan")]] * 2), VECTOR_0),
    ("map", MAPTR, lambda c: vectors(c)[0].update(confidence_level=float("nan")), f"{VECTOR_0}: .*nan"),
    ("map", MAPTR, lambda c: vectors(c)[1].update(global_id=1), "frame a, vector 1: identity 1"),
    ("map", MAPTR, rename_frame, "another split"),
    ("map", STREAM, lambda c: lists(c)["labels"].__setitem__(0, 9), f"{VECTOR_0}: .*9"),
    ("map", STREAM, lambda c: lists(c)["vectors"].__setitem__(0, [[0.0, float("nan")]] * 2), VECTOR_0),
    ("map", STREAM, lambda c: lists(c)["scores"].__setitem__(0, float("inf")), f"{VECTOR_0}: .*inf"),
    ("map", STREAM, lambda c: lists(c)["global_ids"].__setitem__(1, 1), "frame a, vector 1: identity 1"),
    ("map", STREAM, add_frame, "frame c .* has no ground truth"),
]


def read(task: str, results: Path, truth: Path) -> object:
    if task == "map":
        return read_maps(results, truth)
    if task == "motion":
        return read_agents(results, truth)
    return read_objects(results, truth, "tracking" if task == "tracking" else "detection")


@pytest.mark.parametrize(("task", "content", "spoil", "told"), WRONG)
def test_a_wrong_entry_is_named(
    task: str, content: Content, spoil: Callable[[Content], object], told: str, tmp_path: Path
) -> None:
    """The same content is read before it is spoilt."""
    results, truth = tmp_path / "results.json", tmp_path / "truth.json"
    truth.write_text(json.dumps(TRUTHS[task]))
    results.write_text(json.dumps(content))
    read(task, results, truth)
    wrong = copy.deepcopy(content)
    spoil(wrong)
    results.write_text(json.dumps(wrong))
    with pytest.raises(InputError, match=told) as caught:
        read(task, results, truth)
    assert str(caught.value).startswith(f"{results}: ")
    assert "\n" not in str(caught.value)


KITTI = "Car 0 0 0.0 10 10 60 60 1.5 1.6 4.0 1.0 1.6 10.0 0.1 0.9"


@pytest.mark.parametrize(("old", "new"), [("4.0", "nan"), ("10.0", "far"), ("60 1.5", "nan 1.5")])
def test_a_wrong_line_of_kitti_is_named(old: str, new: str, tmp_path: Path) -> None:
    for kind, number, score in (("objects", "", score_kitti_boxes), ("tracks", "0 7 ", score_kitti_tracks)):
        for side, line in (("truth", KITTI), ("results", KITTI.replace(old, new))):
            folder = tmp_path / kind / side
            folder.mkdir(parents=True)
            (folder / "0.txt").write_text(f"{number}{line}\n")
        with pytest.raises(InputError, match=r"0\.txt: line 1 has") as caught:
            score(folder, tmp_path / kind / "truth")
        assert str(caught.value).startswith(str(folder))
