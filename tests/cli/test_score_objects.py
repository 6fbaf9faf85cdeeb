"""`foredrive score --task detection` and `--task tracking`: figures, and what wrong files are told."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from foredrive.cli.main import main
from foredrive.tasks.detection.kitti_boxes import score_kitti_boxes

Box = dict[str, Any]
Content = dict[str, list[Box]]
FRAMES = ("a0", "a1", "a2")
CARS = {"one": 5.0, "two": 15.0}


def box(x: float, name: str, task: str, **more: Any) -> Box:
    return {
        "translation": [x, 0.0, 1.0],
        "size": [2.0, 4.0, 1.5],
        "rotation": [1.0, 0.0, 0.0, 0.0],
        "velocity": [1.0, 0.0],
        f"{task}_name": name,
        **more,
    }


def true_box(x: float, name: str, identity: str, attribute: str) -> Box:
    return box(x, name, "detection", tracking_id=identity, attribute_name=attribute, num_pts=5)


def write(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content))
    return path


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    """Two cars and a pedestrian over three frames of one scene."""
    boxes = {
        frame: [
            *(
                box(x, "car", "detection", tracking_id=name, attribute_name="vehicle.moving", num_pts=5)
                for name, x in CARS.items()
            ),
            box(
                25.0,
                "pedestrian",
                "detection",
                tracking_id="p",
                attribute_name="pedestrian.standing",
                num_pts=1,
            ),
        ]
        for frame in FRAMES
    }
    samples = {
        frame: {"scene_token": "a", "timestamp": 500_000 * n, "ego_translation": [0.0, 0.0, 0.0]}
        for n, frame in enumerate(FRAMES)
    }
    return write(tmp_path / "truth.json", {"results": boxes, "samples": samples})


@pytest.fixture
def detections() -> Content:
    """Both cars 0.4 m off, with the attribute right for one of them; no pedestrian."""
    return {
        frame: [
            box(5.4, "car", "detection", detection_score=0.9, attribute_name="vehicle.moving"),
            box(15.4, "car", "detection", detection_score=0.8, attribute_name="vehicle.parked"),
        ]
        for frame in FRAMES
    }


@pytest.fixture
def tracks() -> Content:
    """One car throughout. The other is missed in the middle frame and has another identity afterwards."""
    first = {f: [box(5.4, "car", "tracking", tracking_score=0.9, tracking_id="x")] for f in FRAMES}
    for frame, identity in (("a0", "y"), ("a2", "z")):
        first[frame].append(box(15.0, "car", "tracking", tracking_score=0.9, tracking_id=identity))
    return first


def score(folder: Path, content: Content, truth: Path, task: str) -> dict[str, Any]:
    results = write(folder / "results.json", {"meta": {}, "results": content})
    out = folder / "out"
    assert main(["score", str(results), "--truth", str(truth), "--task", task, "--out", str(out)]) == 0
    assert "<table" in (out / "report.html").read_text()
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return summary


def test_detection_under_every_protocol(tmp_path: Path, truth: Path, detections: Content) -> None:
    """Cars have AP 1 at all four distances. The pedestrian is missed: errors 1. mAP is over ten classes."""
    figures = score(tmp_path, detections, truth, "detection")
    assert figures["detection.nuscenes.car.ap"] == pytest.approx(1.0)
    assert figures["detection.nuscenes.map"] == pytest.approx(0.1)
    assert figures["detection.nuscenes.car.ate_m"] == pytest.approx(0.4)
    assert figures["detection.nuscenes.ate_m"] == pytest.approx((9 + 0.4) / 10)
    # The surer half of the hits has the right attribute: the mean so far is 0 up to recall 1/2, then rises.
    assert 0.0 < figures["detection.nuscenes.car.aae"] < 0.5
    assert figures["detection.vad.car.ap"] == pytest.approx(1.0)
    assert figures["frames_without_results"] == 0
    assert figures["truth_lacks"] is None


def test_the_protocols_count_other_ground(tmp_path: Path, truth: Path, detections: Content) -> None:
    """A false car 35 m ahead, surer than all: nuScenes counts it, VAD does not."""
    for boxes in detections.values():
        boxes.append(box(35.0, "car", "detection", detection_score=0.95, attribute_name=""))
    figures = score(tmp_path, detections, truth, "detection")
    assert figures["detection.vad.car.ap"] == pytest.approx(1.0)
    assert figures["detection.nuscenes.car.ap"] < 0.7


def test_tracking_under_every_protocol(tmp_path: Path, truth: Path, tracks: Content) -> None:
    figures = score(tmp_path, tracks, truth, "tracking")
    assert figures["tracking.nuscenes.car.gt"] == 6
    assert (figures["tracking.nuscenes.ids"], figures["tracking.nuscenes.car.fn"]) == (1, 1)
    assert figures["tracking.nuscenes.car.recall"] == pytest.approx(5 / 6)
    assert figures["tracking.nuscenes.pedestrian.amotp_m"] == 2.0
    assert figures["tracking.nuscenes.recall"] == pytest.approx(5 / 12)  # of car and pedestrian
    # Matches without the switch are 4 of 6: 25 of 40 recalls are below 2/3, and no box is false.
    assert figures["tracking.nuscenes.car.amota"] == pytest.approx(25 / 40)


def test_frames_that_the_results_leave_out_are_told(
    tmp_path: Path, truth: Path, detections: Content, capsys: pytest.CaptureFixture[str]
) -> None:
    del detections["a1"]
    figures = score(tmp_path, detections, truth, "detection")
    assert (figures["frames_without_results"], figures["frames_counted"]) == (1, 3)
    assert figures["detection.nuscenes.car.ap"] < 0.7
    assert "1 of 3 frames are not in the results" in " ".join(capsys.readouterr().out.split())


def test_what_the_truth_lacks_is_not_judged(tmp_path: Path, detections: Content) -> None:
    bare = {f: [box(x, "car", "detection") for x in CARS.values()] for f in FRAMES}
    for boxes in bare.values():
        for each in boxes:
            del each["velocity"]
    figures = score(tmp_path, detections, write(tmp_path / "bare.json", {"results": bare}), "detection")
    assert figures["truth_lacks"] == "attribute, num_points, range, velocity"
    assert figures["detection.nuscenes.car.ap"] == pytest.approx(1.0)
    for key in ("nds", "ave_mps", "aae"):
        assert figures[f"detection.nuscenes.{key}"] is None
    assert figures["detection.nuscenes.car.ate_m"] == pytest.approx(0.4)


def test_results_without_points_do_not_count(tmp_path: Path, truth: Path, detections: Content) -> None:
    """As in the devkit, whose own files state points in every box: a third car has none and is dropped."""
    expected = score(tmp_path, detections, truth, "detection")
    for boxes in detections.values():
        boxes[1]["num_pts"] = 12
        unseen = {"detection_score": 0.95, "attribute_name": "vehicle.moving", "num_pts": 0}
        boxes.append(box(30.0, "car", "detection", **unseen))
    figures = score(tmp_path, detections, truth, "detection")
    assert figures["found"] == expected["found"] + 3
    for name in ("nuscenes", "vad"):
        assert figures[f"detection.{name}.car.ap"] == expected[f"detection.{name}.car.ap"]


@pytest.mark.parametrize("stated", [True, False])
def test_an_empty_frame_is_filtered_by_range_as_results_state_it(
    stated: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Only boxes tell where the ego vehicle is, and a frame of the truth has none: those of results do."""
    near = box(5.0, "car", "detection", ego_translation=[5.0, 0.0, 1.0], num_pts=5)
    far = box(70.0, "car", "detection", detection_score=0.95)
    if stated:
        far["ego_translation"] = [60.0, 0.0, 1.0]
    truth = write(tmp_path / "truth.json", {"a0": [near], "a1": [], "a2": []})
    found = {"a0": [{**near, "detection_score": 0.9}], "a1": [dict(far) for _ in range(6)]}
    figures = score(tmp_path, found, truth, "detection")
    told = "boxes of 1 of 3 frames are not filtered by range: no file states the ego vehicle's place there"
    assert caplog.messages == ([] if stated else [told])
    assert (figures["detection.nuscenes.car.ap"] == pytest.approx(1.0)) is stated


Edit = Callable[[Content], object]


def put(**values: Any) -> Edit:
    return lambda content: content["a1"][0].update(values)


def drop(key: str) -> Edit:
    return lambda content: content["a1"][0].pop(key)


FIRST = "frame a1, box 0"
WRONG: list[tuple[str, str, Edit]] = [
    ("tracking", f"{FIRST} has the unknown class 'tank'", put(tracking_name="tank")),
    ("tracking", f"{FIRST} has no tracking_name", drop("tracking_name")),
    ("tracking", f"{FIRST}: its translation is not finite", put(translation=[math.nan, 0, 0])),
    ("tracking", f"{FIRST} has no size of 3 number(s)", put(size=[1, 2])),
    ("tracking", f"{FIRST} has the size [-1.0, 2.0, 1.0]", put(size=[-1, 2, 1])),
    ("tracking", f"{FIRST} has the tracking_score 1.5, which is not in [0, 1]", put(tracking_score=1.5)),
    ("tracking", f"{FIRST} has no tracking_id", drop("tracking_id")),
    ("tracking", f"{FIRST} is no object", lambda content: content["a1"].__setitem__(0, "car")),  # type: ignore[call-overload]
    (
        "tracking",
        "frame a2, box 1 has the tracking_id x of another box of its frame",
        lambda content: content["a2"][1].update(tracking_id="x"),
    ),
    ("tracking", "frame b7 (1 of 4) has no ground truth in", lambda content: content.update(b7=[])),
    (
        "tracking",
        "frame a0 has 501 boxes, and 500 are allowed",
        lambda content: content["a0"].extend(content["a0"][:1] * 499),
    ),
    ("detection", f"{FIRST} has the unknown attribute_name 'parked'", put(attribute_name="parked")),
    ("detection", f"{FIRST}: its detection_score is not finite", put(detection_score=math.inf)),
]


@pytest.mark.parametrize(("task", "told", "edit"), WRONG)
def test_wrong_results_are_one_line(
    task: str,
    told: str,
    edit: Edit,
    tmp_path: Path,
    truth: Path,
    detections: Content,
    tracks: Content,
    capsys: pytest.CaptureFixture[str],
) -> None:
    content = tracks if task == "tracking" else detections
    edit(content)
    results = write(tmp_path / "wrong.json", {"results": content})
    assert main(["score", str(results), "--truth", str(truth), "--task", task, "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"foredrive: {results}: {told}")
    assert error.count("\n") == 1


def test_results_of_another_split_are_told_so(
    tmp_path: Path, truth: Path, detections: Content, capsys: pytest.CaptureFixture[str]
) -> None:
    results = write(
        tmp_path / "test.json", {"results": {f"test_{f}": each for f, each in detections.items()}}
    )
    arguments = ["score", str(results), "--truth", str(truth), "--task", "detection", "--out", str(tmp_path)]
    assert main(arguments) == 2
    assert "none of its 3 frames is in" in (error := capsys.readouterr().err)
    assert "(first: test_a0): results of another split?" in error


def test_tracking_needs_scenes_and_times(
    tmp_path: Path, truth: Path, tracks: Content, capsys: pytest.CaptureFixture[str]
) -> None:
    content = json.loads(truth.read_text())
    del content["samples"]["a1"]
    wrong = write(tmp_path / "wrong.json", content)
    results = write(tmp_path / "results.json", {"results": tracks})
    assert (
        main(["score", str(results), "--truth", str(wrong), "--task", "tracking", "--out", str(tmp_path)])
        == 2
    )
    assert capsys.readouterr().err.startswith(
        f"foredrive: {wrong}: frame a1 has no scene_token and timestamp"
    )


def test_folders_of_kitti(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two cars of one frame: one found 0.3 m off, the other 3 m. Tracks are those of the image boxes."""
    boxes = {"truth": (20.0, 30.0), "found": (20.3, 33.0)}
    for name, depths in boxes.items():
        for task, start in (("detection", ""), ("tracking", "0 {n} ")):
            folder = tmp_path / task / name
            folder.mkdir(parents=True)
            lines = [
                start.format(n=n) + f"Car 0 0 0 {100 * n} 100 {100 * n + 50} 150 1.5 1.6 4 0 1.6 {depth} 0"
                for n, depth in enumerate(depths)
            ]
            end = " 0.9" if name == "found" else ""
            (folder / "000000.txt").write_text("".join(f"{line}{end}\n" for line in lines))
    figures: dict[str, Any] = {}
    for task in ("detection", "tracking"):
        out = tmp_path / "out"
        folders = [str(tmp_path / task / name) for name in ("found", "truth")]
        assert main(["score", folders[0], "--truth", folders[1], "--task", task, "--out", str(out)]) == 0
        figures |= json.loads((out / "summary.json").read_text())
    assert figures["detection.kitti.car.ap_4m"] == pytest.approx(1.0)
    assert figures["detection.kitti.car.ap_0.5m"] < 0.5
    assert figures["tracking.kitti.car.hota"] == pytest.approx(1.0)
    assert "detection.kitti.ave_mps" not in figures
    wrong = tmp_path / "detection" / "found" / "000000.txt"
    wrong.write_text("Bus 0 0 0 0 100 50 150 1.5 1.6 4 0 1.6 20 0 7\n")
    folders = [str(wrong.parent), "--truth", str(tmp_path / "detection" / "truth")]
    capsys.readouterr()
    assert main(["score", *folders, "--task", "detection", "--out", str(tmp_path / "out")]) == 2
    said = f"{wrong.parent}: left out of 1: 1 boxes of other classes: nothing remains to be scored"
    assert capsys.readouterr().err == f"foredrive: {said}\n"


@pytest.mark.parametrize("scores", [(0.9, 0.1), (7.0, -2.5)])
def test_scores_of_detections_only_rank(scores: tuple[float, float], tmp_path: Path) -> None:
    """A car that is found, and one that is not there, of a lower score."""
    found, truth = tmp_path / "found", tmp_path / "truth"
    line = "Car 0 0 0 0 100 50 150 1.5 1.6 4 0 1.6 {depth} 0"
    for folder, lines in (
        (truth, [line.format(depth=20), line.format(depth=40).replace("Car", "Van")]),
        (found, [f"{line.format(depth=depth)} {s}" for depth, s in zip((20, 30), scores, strict=True)]
         + [f"{line.format(depth=10)} 9".replace("Car", "Bus")]),
    ):  # fmt: skip
        folder.mkdir()
        (folder / "000000.txt").write_text("\n".join(lines))
    figures = score_kitti_boxes(found, truth)
    assert figures["detection.kitti.car.ap"] > 0.99
    assert (figures["found"], figures["boxes_of_other_classes_left_out"]) == (2, 1)
