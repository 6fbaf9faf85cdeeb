"""Ground truth of objects from nuScenes' tables and from logs: the same figures as from a file of it."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from foredrive.data.boxes import read_boxes
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.scene import Category
from foredrive.tasks.detection.figures import score_objects
from foredrive.tasks.objects.nuscenes_tables import find_tables
from foredrive.tasks.objects.object_rows import DETECTION_CLASSES
from foredrive.tasks.objects.reading import read_log_truth, read_objects
from foredrive.tasks.tracking.score import score_tracks

if TYPE_CHECKING:
    from foredrive.data import LogPath

EGO = [1000.0, 500.0, 0.0]
STEP_US = 500_000


def rotation(yaw: float) -> list[float]:
    return [float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))]


def annotation(n: int, instance: str, x: float, **more: Any) -> dict[str, Any]:
    return {
        "token": f"{instance}{n}",
        "sample_token": f"s{n}",
        "instance_token": instance,
        "attribute_tokens": [],
        "translation": [EGO[0] + x, EGO[1], 1.0],
        "size": [2.0, 4.0, 1.5],
        "rotation": rotation(0.3),
        "prev": "",
        "next": "",
        "num_lidar_pts": 3,
        "num_radar_pts": 0,
        **more,
    }


@pytest.fixture
def tables(tmp_path: Path) -> Path:
    """Two scenes: a car that drives at 4 m/s through three samples, and a sample of another scene."""
    folder = tmp_path / "nuscenes" / "v1.0-mini"
    folder.mkdir(parents=True)
    car = [
        annotation(
            n, "car", 5.0 + 2.0 * n, attribute_tokens=["moving"],
            prev=f"car{n - 1}" if n else "", next=f"car{n + 1}" if n < 2 else "",
        )
        for n in range(3)
    ]  # fmt: skip
    rest = [
        annotation(1, "stroller", 9.0),
        annotation(1, "ghost", 20.0, num_lidar_pts=0),
        annotation(2, "rack", 12.0, size=[4.0, 4.0, 2.0]),
        annotation(2, "bike", 12.5, num_lidar_pts=0, num_radar_pts=1),
    ]
    categories = {
        "car": "vehicle.car", "stroller": "human.pedestrian.stroller", "ghost": "vehicle.truck",
        "rack": "static_object.bicycle_rack", "bike": "vehicle.bicycle",
    }  # fmt: skip
    samples = [("s0", "x", 0), ("s1", "x", 1), ("s2", "x", 2), ("other", "y", 9)]
    content: dict[str, list[dict[str, Any]]] = {
        "sample": [{"token": t, "scene_token": s, "timestamp": STEP_US * n} for t, s, n in samples],
        "sample_annotation": car + rest,
        "instance": [{"token": each, "category_token": f"c {each}"} for each in categories],
        "category": [{"token": f"c {each}", "name": name} for each, name in categories.items()],
        "attribute": [{"token": "moving", "name": "vehicle.moving"}],
        "sensor": [{"token": "lidar", "channel": "LIDAR_TOP"}, {"token": "cam", "channel": "CAM_FRONT"}],
        "calibrated_sensor": [{"token": f"at {s}", "sensor_token": s} for s in ("lidar", "cam")],
        "ego_pose": [{"token": "here", "translation": EGO}, {"token": "there", "translation": [0, 0, 0]}],
        "sample_data": [
            {
                "token": f"{sensor} {t}", "sample_token": t, "ego_pose_token": pose, "is_key_frame": True,
                "calibrated_sensor_token": f"at {sensor}",
            }
            for t, _, _ in samples
            for sensor, pose in (("lidar", "here"), ("cam", "there"))
        ],
    }  # fmt: skip
    for name, rows in content.items():
        (folder / f"{name}.json").write_text(json.dumps(rows))
    return folder


def write_results(path: Path, task: str, frames: dict[str, list[tuple[float, str]]]) -> Path:
    """Boxes (m ahead of the ego vehicle, identity) of cars that drive at 4 m/s."""
    content = {
        frame: [
            {
                "translation": [EGO[0] + x, EGO[1], 1.0], "size": [2.0, 4.0, 1.5], "rotation": rotation(0.3),
                "velocity": [4.0, 0.0], f"{task}_name": "car", f"{task}_score": 0.9,
                "tracking_id": identity, "attribute_name": "vehicle.moving",
            }
            for x, identity in boxes
        ]
        for frame, boxes in frames.items()
    }  # fmt: skip
    path.write_text(json.dumps({"meta": {}, "results": content}))
    return path


def test_boxes_without_size_are_left_out(
    tables: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As if they were not there, in tables, in a file of truth and in results; each file has a line."""
    results = write_results(tmp_path / "found.json", "tracking", {"s0": [(5.0, "a")], "s1": [(7.0, "a")]})
    figures = score_tracks(*read_objects(results, tables, "tracking"))
    found = json.loads(results.read_text())
    found["results"]["s1"].append({**found["results"]["s1"][0], "tracking_id": "flat", "size": [2.0, 4.0, 0]})
    results.write_text(json.dumps(found))
    file = tables / "sample_annotation.json"
    flat = annotation(1, "car", 8.0, token="flat", instance_token="bike", size=[0.0, 4.0, 1.5])
    file.write_text(json.dumps([*json.loads(file.read_text()), flat]))
    assert score_tracks(*read_objects(results, tables, "tracking")) == figures
    assert caplog.messages == [
        f"{tables}: left out of 7: 1 boxes without size",
        f"{results}: left out of 3: 1 boxes without size",
    ]
    detection = {"translation": [3.0, 0.0, 1.0], "rotation": rotation(0.0), "detection_name": "car"}
    sized, flat = ({**detection, "size": size} for size in ([2.0, 4.0, 1.5], [2.0, 4.0, 0.0]))
    (tmp_path / "gt.json").write_text(json.dumps({"s0": [flat, sized], "s1": []}))
    (tmp_path / "boxes.json").write_text(json.dumps({"s0": [{**sized, "detection_score": 0.5}]}))
    read = read_objects(tmp_path / "boxes.json", tmp_path / "gt.json", "detection")
    assert score_objects(*read)["detection.nuscenes.car.ap"] == pytest.approx(1.0)
    (tmp_path / "gt.json").write_text(json.dumps({"s0": [flat], "s1": []}))
    with pytest.raises(InputError, match="left out of 1: 1 boxes without size: nothing remains"):
        read_objects(tmp_path / "boxes.json", tmp_path / "gt.json", "detection")


def test_tables_of_nuscenes(tables: Path, tmp_path: Path) -> None:
    """All of the scene that results are of. A stroller is no pedestrian; the bicycle in the rack, and the
    truck without points, do not count.
    """
    results = write_results(tmp_path / "found.json", "detection", {"s0": [(5.0, "a")], "s2": [(9.0, "a")]})
    found, truth = read_objects(results, tables.parent, "detection")
    assert list(truth.names) == ["s0", "s1", "s2"]
    assert found.frames_without_results == 1
    labels = [DETECTION_CLASSES[label] for label in truth.boxes.label]
    assert labels == ["car", "car", "truck", "car", "bicycle"]
    cars = truth.boxes[truth.boxes.label == 0]
    assert cars.velocity == pytest.approx(np.tile([4.0, 0.0], (3, 1)))  # one-sided at the ends
    assert cars.from_ego[:, 0].tolist() == [5.0, 7.0, 9.0]
    assert np.isnan(truth.boxes.velocity[labels.index("bicycle")]).all()
    figures = score_objects(found, truth)
    assert figures["detection.nuscenes.car.ap"] == pytest.approx(((66 - 10) * 0.9 / 90 + 0) / 0.9, abs=0.01)
    assert figures["detection.nuscenes.car.ave_mps"] == pytest.approx(0.0, abs=1e-9)
    assert figures["detection.nuscenes.car.aae"] == 0.0
    assert not [key for key in figures if "bicycle.ap" in key or "truck.ap" in key]
    driven = {f"s{n}": [(5.0 + 2 * n, "a")] for n in range(3)}
    tracks = write_results(tmp_path / "tracks.json", "tracking", driven)
    figures = score_tracks(*read_objects(tracks, tables, "tracking"))
    assert figures["tracking.nuscenes.car.amota"] == pytest.approx(1.0)
    assert figures["frames_counted"] == 3


def test_tables_that_cannot_be_read_are_named(tables: Path, tmp_path: Path) -> None:
    results = write_results(tmp_path / "found.json", "detection", {"s9": []})
    with pytest.raises(InputError, match=r"found\.json: none of its 1 frames is in .*v1\.0-mini"):
        read_objects(results, tables, "detection")
    results = write_results(results, "detection", {"s0": []})
    (tables / "instance.json").write_text("[3]")
    with pytest.raises(InputError, match=r"instance\.json: not a table of nuScenes"):
        read_objects(results, tables, "detection")
    (tables.parent / "v1.0-trainval").mkdir()
    (tables.parent / "v1.0-trainval" / "sample.json").write_text("[]")
    with pytest.raises(InputError, match="several folders of tables"):
        find_tables(tables.parent)


def test_boxes_of_a_log_are_their_own_perfect_results(log: "LogPath", tmp_path: Path) -> None:
    """Written in the world's frame as results at every frame, they are all found."""
    opened = Log(log)
    content: dict[str, list[dict[str, Any]]] = {}
    for frame, t_us in enumerate(opened.t_us.tolist()):
        boxes, T = read_boxes(opened, frame), opened.T_world_ego[frame]
        if boxes is None:
            continue
        heading = np.arctan2(T[1, 0], T[0, 0])
        content[f"{log.name}@{t_us}"] = [
            {
                "translation": (T[:3, :3] @ boxes.centre[n].double().numpy() + T[:3, 3]).tolist(),
                "size": boxes.size_lwh[n][[1, 0, 2]].tolist(),
                "rotation": rotation(float(boxes.yaw[n]) + heading),
                "velocity": (T[:2, :2] @ boxes.velocity[n].double().numpy()).tolist(),
                "tracking_name": Category(int(boxes.category[n])).name.lower(),
                "tracking_score": 0.5,
                "tracking_id": int(boxes.track_id[n]),
            }
            for n in range(len(boxes.yaw))
            if Category(int(boxes.category[n])) in (Category.CAR, Category.PEDESTRIAN, Category.TRUCK)
        ]
    results = tmp_path / "tracks.json"
    results.write_text(json.dumps({"results": content}))
    root = log.folder.parents[2]
    figures = score_tracks(*read_objects(results, root, "tracking"))
    assert figures["frames_counted"] == len(content)
    assert figures["tracking.nuscenes.car.amota"] == pytest.approx(1.0)
    assert figures["tracking.nuscenes.car.ids"] == 0
    truth = read_log_truth(root, content, results, DETECTION_CLASSES)
    assert truth.frames.time_us.tolist() == sorted(truth.frames.time_us.tolist())
    with pytest.raises(InputError, match=r"frame none@5 \(1 of 2\) has no ground truth in"):
        read_log_truth(root, [next(iter(content)), "none@5"], results, DETECTION_CLASSES)
